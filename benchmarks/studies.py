"""A whole study: what two hundred trials take, beside the same runs of FilterPy's filter."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from time import perf_counter
from unittest import mock

import numpy as np

from benchmarks.peers import EnsembleStep, python_model
from benchmarks.rows import Row
from benchmarks.timing import Timing
from tuning import trials
from tuning.plan import TRAINING_SEEDS, Plan
from tuning.scenarios import Scenario, find_scenario
from tuning.study import StudyResult, open_study, quiet_optuna, run_study

TRIALS = 200
SIZES, PEER_STEPS = (20, 200), 50  # FilterPy's time a step is a straight line over N
GOAL = 6.0  # [s]


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure a study, then the share of it that is Optuna's, then what FilterPy would take for its runs."""
    count = 15 if quick else TRIALS
    plan = Plan("enkf", (find_scenario("nominal"),), seed)
    _study(plan, 2)  # compiles
    total, own, result = _timed(plan, count)
    what = f"study, {count} trials of an EnKF"
    yield Row(what, None, Timing(total, None, None), time_goal=GOAL)
    yield Row("the same; all but filters and scores", None, Timing(total - own, None, None))
    peer = filterpy_seconds(plan.scenarios[0], result)
    yield Row(what, "FilterPy, extrapolated", Timing(total, peer, total / peer), ratio_goal=1 / 300)


def _study(plan: Plan, count: int) -> StudyResult:
    quiet_optuna()
    return run_study(open_study("benchmark", plan, None), plan, count)


def _timed(plan: Plan, count: int) -> tuple[float, float, StudyResult]:
    """Seconds of a study, seconds of it in our filters and scores, and what it found."""
    spent = [0.0]

    def clocked(function: Callable) -> Callable:
        def call(*arguments):
            begin = perf_counter()
            result = function(*arguments)
            spent[0] += perf_counter() - begin
            return result

        return call

    with mock.patch.multiple(trials, run=clocked(trials.run), judge=clocked(trials.judge)):
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
    runs = [(len(t.intermediate_values) or TRAINING_SEEDS, t.params["N"]) for t in result.trials]
    return sum(seeds * scenario.steps * (fixed + slope * size) for seeds, size in runs)
