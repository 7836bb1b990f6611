"""The wait in a fresh process: imports, the first call of cached code, and the first use of each filter.

`python -m benchmarks.first_use` prints the tables of docs/size.md in Markdown, by the size of the model and for
each model of the vehicle: processor time and memory. Every filter is measured in a process of its own, whose cache
is empty.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator

import numpy as np

from benchmarks.timing import Measure, Row, side_by_side
from filters import affine_model, make_filter
from filters.filter import Filter
from filters.registry import FILTERS, filter_type
from thruster_env.auv.model import MODELS, auv_model
from thruster_env.model.state_space import StateSpaceModel

FIRST_STEP = """
env = gymnasium.make("BowThruster-v0")
env.reset(seed=0)
env.step(env.action_space.high)
"""
TUNING_IMPORTS = """
from tuning.evaluation.evaluate import evaluate
from tuning.plants.thruster import find_scenario
from tuning.problems.data import training_seeds
from tuning.search.space import oracle_choice
"""
FIRST_EVALUATION = """
scenario = find_scenario("nominal")
data = scenario.data(training_seeds({seed}, 64))
evaluate(oracle_choice("enkf", scenario).with_size(50).filter(scenario), data, scenario.scale)
"""


FIRST_FILTER = """
import gymnasium
env = gymnasium.make("filters:BowThruster-EKF-v0")
env.reset(seed=0)
env.step(env.action_space.high)
"""
SMALL_FUNCTION = """
import numba, numpy
@numba.njit
def square_sum(x):
    total = 0.0
    for i in range(x.shape[0]):
        total += x[i] * x[i]
    return total
square_sum(numpy.ones(3))
"""
IMPORT_GOAL, STEP_GOAL = 2.6, 5.7  # of the time that Gymnasium's import takes, and that of numba's
EVALUATE_GOAL, COLD_GOAL = 0.6, 5.0  # [s]; a user waits for these, on whatever machine
SIZES = ((2, 1), (12, 4), (40, 40))
ON_AFFINE = ("kf", "kf-steady", "fuzzy")  # they would approximate another model
FEW_RULES = {"fuzzy": {"premises": [0, 5]}}  # u and r; twelve states would make 4096
WITH_POSITION = ("navigation", "current")  # of which there is no steady state unless a position is measured


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other; whoever calls this has run, and so compiled, all that is measured."""
    rounds = 1 if quick else 7
    ours, gymnasium = in_a_process("import thruster_env"), in_a_process("import gymnasium")
    timing = side_by_side(ours, gymnasium, rounds, warm_up=False)
    yield Row("import thruster_env", "import gymnasium", timing, ratio_goal=IMPORT_GOAL)
    numba = in_a_process("import numba", "import gymnasium")
    first = in_a_process(FIRST_STEP, "import gymnasium, thruster_env")
    timing = side_by_side(first, numba, rounds, warm_up=False)
    yield Row("first make, reset and step", "import numba", timing, ratio_goal=STEP_GOAL)
    first = in_a_process(FIRST_EVALUATION.format(seed=seed), TUNING_IMPORTS)
    timing = side_by_side(first, numba, rounds, warm_up=False)
    yield Row("first evaluate", "import numba", timing, time_goal=EVALUATE_GOAL)
    cold, small = processor_time(FIRST_FILTER), processor_time(SMALL_FUNCTION)
    timing = side_by_side(cold, small, 1 if quick else 3, warm_up=False)
    yield Row("cold first use of the EKF, processor time", "numba on one loop", timing, time_goal=COLD_GOAL)


def in_a_process(timed: str, before: str = "") -> Measure:
    """A measure of the seconds that source text takes in a fresh interpreter, after other, untimed text."""
    source = "\n".join(
        [
            before,
            "from time import perf_counter",
            "begin = perf_counter()",
            timed,
            "print(perf_counter() - begin)",
        ]
    )

    def measure() -> float:
        done = subprocess.run([sys.executable, "-c", source], check=True, stdout=subprocess.PIPE, text=True)
        return float(done.stdout.splitlines()[-1])

    return measure


def processor_time(source: str) -> Measure:
    """A measure of the processor time [s] of a fresh interpreter that runs a source, with no machine code kept."""

    def measure() -> float:
        with tempfile.TemporaryDirectory() as folder:
            environment, begin = {**os.environ, "NUMBA_CACHE_DIR": folder}, os.times()
            subprocess.run([sys.executable, "-c", source], check=True, env=environment)
            end = os.times()
        return end.children_user + end.children_system - begin.children_user - begin.children_system

    return measure


def lorenz_96(x, u, c):
    """One step of Euler's method; c = (step, forcing)."""
    after = np.empty(len(x))
    for i in range(len(x)):
        after[i] = x[i] + c[0] * ((x[(i + 1) % len(x)] - x[i - 2]) * x[i - 1] - x[i] + c[1])
    return after


def first_states(count: int):
    """Return h(x) = the first `count` states."""

    def observe(x, c):
        observed = np.empty(count)
        for i in range(count):
            observed[i] = x[i]
        return observed

    return observe


def model_of(name: str, n: int, m: int) -> StateSpaceModel:
    """A model of n states and m measurements for a filter."""
    noise = {"process_noise_cov": np.full(n, 0.1), "measurement_noise_cov": np.full(m, 0.5)}
    prior = {"prior_mean": np.zeros(n), "prior_cov": np.ones(n)}
    if name in ON_AFFINE:
        return affine_model(a=0.9 * np.eye(n), b=np.ones((n, 1)), c=np.eye(m, n), **noise, **prior)
    return StateSpaceModel(transition=lorenz_96, observe=first_states(m), constants=(0.01, 8.0), **noise, **prior)


def use_once(filter_: Filter) -> None:
    """Begin, predict, and update."""
    belief = filter_.predict(filter_.init(), np.zeros(filter_.model.inputs))
    filter_.update(belief, np.zeros(filter_.model.m))


def filter_of(name: str, n: int, m: int) -> Filter:
    """A filter on a model of n states and m measurements."""
    numbers = {"ensemble_size": 10} if filter_type(name).has_ensemble else {}
    return make_filter(name, model_of(name, n, m), **numbers)


def timed_use(filter_: Filter) -> tuple[float, float]:
    """Processor time [s] and growth of memory [MB] of a filter's first use."""
    import resource  # not on Windows

    memory, begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.process_time()
    use_once(filter_)
    spent = time.process_time() - begin
    return spent, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - memory) / 1024


def measured(*arguments: str) -> tuple[float, float]:
    """Processor time [s] and memory [MB] of a filter's first use in a process of its own, whose cache is empty."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "benchmarks.first_use", *arguments]
        environment = {**os.environ, "NUMBA_CACHE_DIR": folder}
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    return tuple(json.loads(done.stdout.splitlines()[-1]))


def vehicle_filter_of(name: str, states: str) -> Filter:
    """A filter on a model of the vehicle."""
    arguments = {"ensemble_size": 10} if filter_type(name).has_ensemble else {}
    if MODELS[states].count > 8:
        arguments |= FEW_RULES.get(name, {})
    sensors = "usbl" if name == "kf-steady" and states in WITH_POSITION else None
    return make_filter(name, auv_model(states=states, sensors=sensors), **arguments)


def main() -> None:
    """Print the tables, or measurements: n m FILTER... or STATES FILTER... as arguments."""
    if len(sys.argv) > 1:
        of_vehicle = sys.argv[1] in MODELS
        names = sys.argv[2 if of_vehicle else 3 :]
        for name in names:
            filter_ = (
                vehicle_filter_of(name, sys.argv[1]) if of_vehicle else filter_of(name, *map(int, sys.argv[1:3]))
            )
            print(json.dumps(timed_use(filter_)), flush=True)
        return
    of_sizes = {f"n = {n}, m = {m}": (str(n), str(m)) for n, m in SIZES}
    for columns in (of_sizes, {f"{name} ({MODELS[name].count})": (name,) for name in MODELS}):
        print(f"| filter | {' | '.join(columns)} |\n|---|" + "--:|" * len(columns))
        for name in FILTERS:
            uses = (measured(*arguments, name) for arguments in columns.values())
            cells = (f"{seconds:.1f} s, {megabytes:.0f} MB" for seconds, megabytes in uses)
            print(f"| {name} | {' | '.join(cells)} |", flush=True)


if __name__ == "__main__":
    main()
