"""Complete jobs: studies beside the same runs of FilterPy's filter and on Lorenz-96, and trainings of policies."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from time import perf_counter
from unittest import mock

import numpy as np

from benchmarks.steps import EnsembleStep, python_model
from benchmarks.timing import Measure, Row, Timing, alone, side_by_side
from filters.engine.batch import run
from tuning.evaluation import sizes
from tuning.experiments.lorenz96 import STEPS, problem
from tuning.likelihood import objective
from tuning.plants.thruster import Scenario, find_scenario
from tuning.policies.setup import TrainingConfiguration
from tuning.problems import data as in_parts
from tuning.problems.data import training_seeds
from tuning.search import parameters, trials
from tuning.search import plan as plans
from tuning.search.plan import TRAINING_SEEDS, Plan
from tuning.search.storage import quiet_optuna
from tuning.search.study import StudyResult, open_study, run_study

TRIALS = 200
SIZES, PEER_STEPS = (20, 200), 200  # FilterPy's time a step is a straight line over N
OUTSIDE_GOAL, RUNS_GOAL, STUDY_GOAL = 0.45, 1 / 100, 1 / 500
MEMORY_GOAL = 500.0  # [MB]
FILTERS_AND_SCORES = {  # what runs filters or rates their runs, where a study calls it; none calls another
    trials: ("metrics_of_all", "compute_metrics"),
    sizes: ("evaluate", "values_of"),
    objective: ("derivatives",),
}
WARM_UP = 25  # trials, with the first search of the likeliest Q and R
IN_A_PROCESS = """
from tuning.search.plan import Plan
from tuning.plants.thruster import find_scenario
from tuning.search.storage import quiet_optuna
from tuning.search.study import open_study, run_study
quiet_optuna()
plan = Plan("enkf", (find_scenario("nominal"),), {seed})
run_study(open_study("memory", plan, None), plan, {trials})
status = dict(line.split(":", 1) for line in open("/proc/self/status"))
print(status["VmHWM"].split()[0])
"""
INTERPRETER = "DAPPER_PYTHON"
LORENZ_TRIALS, SEEDS, LARGEST = 100, 8, 60
PEER_SIZES = (10, 35, 60)  # its time a run is a line over N
LORENZ_GOAL = 1 / 20


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure a study, then the share of it that is Optuna's, then what FilterPy would take for its runs."""
    count = _trials(quick)
    plan = Plan("enkf", (find_scenario("nominal"),), seed)
    _study(plan, min(WARM_UP, count))  # compiles
    total, in_filters, result = _timed(plan, count)
    what = f"study, {count} trials of an EnKF"
    peer = filterpy_seconds(plan.scenarios[0], result)
    timing = Timing(total, peer, total / peer)
    yield Row(what, "FilterPy's runs, extrapolated", timing, ratio_goal=RUNS_GOAL)
    rest = total - in_filters
    timing = Timing(rest, total, rest / total)
    yield Row("of it outside filters and scores", "the whole", timing, ratio_goal=OUTSIDE_GOAL)
    total, _, result = _timed(plan._replace(prune=False), count)
    peer = filterpy_seconds(plan.scenarios[0], result)
    timing = Timing(total, peer, total / peer)
    what = "all seeds in every trial"
    yield Row(what, "FilterPy's runs, extrapolated", timing, ratio_goal=STUDY_GOAL)


def _trials(quick: bool) -> int:
    return 15 if quick else TRIALS


def resident_memory(seed: int, quick: bool) -> float | None:
    """The most memory [MB] that a process keeps while it runs the study alone; None where the system tells not."""
    if not Path("/proc/self/status").exists():
        return None
    # Not of resource.getrusage: a child's begins with that of its parent.
    source = IN_A_PROCESS.format(seed=seed, trials=_trials(quick))
    done = subprocess.run([sys.executable, "-c", source], check=True, stdout=subprocess.PIPE, text=True)
    return int(done.stdout) * 1024 / 1e6


def memory_line(resident: float | None) -> str:
    """Memory of the study, in words."""
    if resident is None:
        return "Memory of the study: not measured, this system has no /proc."
    met = "met" if resident <= MEMORY_GOAL else "missed"
    return f"Memory: {resident:.0f} MB resident at most in the study; goal {MEMORY_GOAL:.0f} MB, {met}."


def _study(plan: Plan, count: int) -> StudyResult:
    quiet_optuna()
    return run_study(open_study("benchmark", plan, None), plan, count)


def _timed(plan: Plan, count: int) -> tuple[float, float, StudyResult]:
    """Seconds of a study, its seconds in filters and scores, and its result.

    Filters run in trials, in the search for the maximum-likelihood Q and R, and in the choice of the ensemble's
    size.
    """
    spent = [0.0]

    def clocked(function: Callable) -> Callable:
        def call(*arguments, **named):
            begin = perf_counter()
            result = function(*arguments, **named)
            spent[0] += perf_counter() - begin
            return result

        return call

    with ExitStack() as patches:
        for room, names in FILTERS_AND_SCORES.items():
            clocks = {name: clocked(getattr(room, name)) for name in names}
            patches.enter_context(mock.patch.multiple(room, **clocks))
        begin = perf_counter()
        result = _study(plan, count)
        return perf_counter() - begin, spent[0], result


def filterpy_seconds(scenario: Scenario, result: StudyResult) -> float:
    """Seconds of FilterPy's EnKF for the runs of a study; those that ended early count as they were."""
    data = scenario.data(range(2))
    a_step = []
    for size in SIZES:
        step = EnsembleStep(scenario.plant, size, python_model)
        step.reset()
        begin = perf_counter()
        for k in range(PEER_STEPS):
            step(float(data.inputs[0, k, 0]), data.measurements[0, k + 1])
        a_step.append((perf_counter() - begin) / PEER_STEPS)
    slope, fixed = np.polyfit(SIZES, a_step, 1)
    return sum(seeds * scenario.steps * (fixed + slope * size) for seeds, size in _runs(result))


def _runs(result: StudyResult) -> list[tuple[int, int]]:
    """Seeds and members of each trial, then of each size among which the study chose: training and fresh seeds."""
    tried = [(len(trial.intermediate_values) or TRAINING_SEEDS, trial.params["N"]) for trial in result.trials]
    return tried + [(TRAINING_SEEDS + row.seeds, row.size) for row in result.sizes]


# A study on Lorenz-96, forty states, beside the same runs of DAPPER's. It does not go with our versions of NumPy
# and SciPy, so it is run in an environment of its own: DAPPER_PYTHON is the path of that one's interpreter.


PEER = """
import json, sys
from time import perf_counter
import dapper.da_methods as methods
import dapper.tools.progressbar as bar
from dapper.mods.Lorenz96.sakov2008 import HMM
from dapper.tools.seeding import set_seed
bar.disable_progbar = True
HMM.tseq.Ko = int(sys.argv[1])
seconds = []
for size in [int(sys.argv[2])] + [int(size) for size in sys.argv[2:]]:
    set_seed(3)
    truth, measurements = HMM.simulate()
    filter_ = methods.EnKF("PertObs", N=size, infl=1.06)
    begin = perf_counter()
    filter_.assimilate(HMM, truth, measurements, liveplots=False)
    filter_.stats.average_in_time()
    seconds.append(perf_counter() - begin)
print(json.dumps(seconds[1:]))
"""


def assimilation_rows(seed: int, quick: bool) -> Iterator[Row]:
    """The study, and what DAPPER would take for its runs."""
    count, seeds = (3, 2) if quick else (LORENZ_TRIALS, SEEDS)
    ours, sizes = study_seconds(seed, count, seeds)
    what = f"study on Lorenz-96, {count} trials of an EnKF"
    if os.environ.get(INTERPRETER):
        peer = float(np.polyval(peer_line(100 if quick else STEPS), sizes).sum())
        yield Row(what, "DAPPER, extrapolated", Timing(ours, peer, ours / peer), ratio_goal=LORENZ_GOAL)
    else:
        yield Row(what, f"no DAPPER, {INTERPRETER} not set", Timing(ours, None, None))


def study_seconds(seed: int, count: int, seeds: int) -> tuple[float, list[int]]:
    """Seconds of a study of so many trials on so many seeds, without pruning, and the N of its runs."""
    quiet_optuna()
    few = mock.patch.multiple(plans, TRAINING_SEEDS=seeds, SIZE_SEEDS=seeds)
    limits = mock.patch.object(parameters, "KALMAN_SIZES", parameters.Sizes(30, 5, LARGEST))
    sizes: list[int] = []

    def counting(filter_, keys, *data, **noise):
        sizes.extend([filter_.size] * len(keys))
        return run(filter_, keys, *data, **noise)

    with few, limits, mock.patch.object(in_parts, "run", counting):
        plan = Plan("enkf", (problem,), seed, hold_r=True, prune=False)
        study = open_study("lorenz96", plan, None)
        plan.training_data()  # drawing the truth is no part of the study, nor of the peer's runs
        begin = perf_counter()
        run_study(study, plan, count)
        return perf_counter() - begin, sizes


def peer_line(steps: int) -> np.ndarray:
    """Slope and offset over N of the seconds that DAPPER takes for a run of 1000 analyses."""
    command = [os.environ[INTERPRETER], "-c", PEER, *map(str, (steps, *PEER_SIZES))]
    done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
    seconds = np.array(json.loads(done.stdout.splitlines()[-1])) * STEPS / steps
    return np.polyfit(PEER_SIZES, seconds, 1)


PASSES = 3  # through them in a step of gradient descent: the output, then slopes over weights and over inputs
COPIES = 64
GOAL = 0.60  # of the time that Stable-Baselines3 by itself takes
ACTING_GOAL = 0.12  # of the time that the envs alone take with DummyVecEnv


def training(setup: TrainingConfiguration, native: bool, rollouts: int) -> Measure:
    """Seconds a step of a short training, as `thruster train` learns."""
    from tuning.policies.environments import make_environments
    from tuning.policies.learn import learning, new_model

    model = new_model(setup, make_environments(setup, training_seeds(setup.seed, setup.num_envs), native=native))
    return _steps_of(model, lambda: learning(model), rollouts)


def by_hand(setup: TrainingConfiguration, rollouts: int) -> Measure:
    """The same by Stable-Baselines3 as its documentation has it: single envs one by one, VecNormalize, PPO.

    torch has one thread here, too.
    """
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    from thruster_env.core.parallel import one_thread
    from tuning.policies.environments import make_environments

    numbers = dict(setup.hyperparameters)
    envs = VecNormalize(
        make_environments(setup, training_seeds(setup.seed, setup.num_envs), native=False), gamma=numbers["gamma"]
    )
    return _steps_of(PPO("MlpPolicy", envs, seed=setup.seed, device="cpu", **numbers), one_thread, rollouts)


def _steps_of(model, settings: Callable[[], AbstractContextManager], rollouts: int) -> Measure:
    steps = rollouts * model.n_envs * model.n_steps

    def measure() -> float:
        with settings():
            begin = perf_counter()
            model.learn(steps)
            return (perf_counter() - begin) / steps

    return measure


def policy_rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    rounds, rollouts = (1, 1) if quick else (9, 2)
    setup = _setup("ekf", seed)
    ours, one_by_one = (training(setup, native, rollouts) for native in (True, False))
    peer = by_hand(setup, rollouts)
    timing = side_by_side(ours, peer, rounds)
    yield Row(
        f"a step of PPO on an EKF, {COPIES} copies",
        "Stable-Baselines3, DummyVecEnv",
        timing,
        ratio_goal=GOAL,
    )
    timing = side_by_side(ours, one_by_one, rounds)
    yield Row("the same, all but the VecEnv equal", "DummyVecEnv", timing)
    stepping = side_by_side(*(acting(seed, "ekf", native) for native in (True, False)), rounds)
    yield Row("of it env and EKF", "DummyVecEnv", stepping, ratio_goal=ACTING_GOAL)
    yield Row("of it env alone", None, alone(acting(seed, "raw", True), rounds))


def acting(seed: int, observe: str, native: bool, steps: int = 200) -> Measure:
    """Seconds a copy and step of the envs alone."""
    from tuning.policies.environments import make_environments

    envs = make_environments(_setup(observe, seed), training_seeds(seed, COPIES), native=native)
    actions = np.random.default_rng(seed).uniform(-1, 1, (steps, COPIES, 1)).astype(np.float32)

    def measure() -> float:
        envs.reset()
        begin = perf_counter()
        for action in actions:
            envs.step(action)
        return (perf_counter() - begin) / (steps * COPIES)

    return measure


def _setup(observe: str, seed: int):
    from tuning.policies.setup import make_configuration

    return make_configuration("manoeuvre", find_scenario("medium_noise"), observe, seed=seed, num_envs=COPIES)
