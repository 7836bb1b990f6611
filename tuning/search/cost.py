"""The cost of a step of a filter, measured so that filters can be compared with a budget."""

from __future__ import annotations

import math
import time

import numpy as np

from filters.engine.batch import run
from filters.filter import Filter
from tuning.problems.data import Data

RUNS, STEPS = 32, 200  # of each timed call
FEWEST, MOST = 3, 15  # timed calls, of which the median is taken ...
ENOUGH_SECONDS = 0.1  # ... and which end early after this time
BUDGET = "cost a step over the budget"  # name of the constraint; at most zero within
COST = "microseconds a step"  # trial attribute


def microseconds_a_step(filter_: Filter, data: Data) -> float:
    """Time of one core for a step of one run [us/step]: the median of several calls over a batch.

    It is processor time, summed over the cores that the batch uses: waiting for other processes and workers is
    not included. A first short call, which may compile, is not timed.
    """
    run(filter_, *_part(data, 2, 2))
    part = _part(data, RUNS, STEPS)
    seconds: list[float] = []
    while len(seconds) < FEWEST or (len(seconds) < MOST and sum(seconds) < ENOUGH_SECONDS):
        begin = time.process_time()
        run(filter_, *part)
        seconds.append(time.process_time() - begin)
    return 1e6 * float(np.median(seconds)) / part[2][..., 0].size


def _part(data: Data, runs: int, steps: int) -> tuple[np.ndarray, ...]:
    data = data.slice(0, runs).seen
    return data.filter_keys[:runs], data.inputs[:runs, :steps], data.measurements[:runs, : steps + 1]


def over_budget(microseconds: float, budget: float) -> float:
    """Logarithm of the cost over the budget; at most zero within the budget, as Optuna expects it."""
    return math.log(microseconds / budget)
