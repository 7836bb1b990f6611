"""What a step of a filter costs, measured so that filters can be held against one budget."""

from __future__ import annotations

import math
import time

import numpy as np

from filters.engine.batch import run
from filters.filter import Filter
from tuning.problems.data import Data

RUNS, STEPS = 32, 200  # of each timed call
FEWEST, MOST = 3, 15  # timed calls, of which the median counts ...
ENOUGH_SECONDS = 0.1  # ... and which end early when they have taken so long
BUDGET = "cost a step over the budget"  # name of the constraint; at most zero is within
COST = "microseconds a step"  # trial attribute


def microseconds_a_step(filter_: Filter, data: Data) -> float:
    """Time of one core for a step of one run, in microseconds: the median of several calls over a batch.

    It is processor time, summed over the cores that the batch uses: waiting for other processes and workers does
    not count. A first short call, which may compile, is not timed.
    """
    run(filter_, *_part(data, 2, 2))
    part, seconds = _part(data, RUNS, STEPS), []
    while len(seconds) < FEWEST or (len(seconds) < MOST and sum(seconds) < ENOUGH_SECONDS):
        begin = time.process_time()
        run(filter_, *part)
        seconds.append(time.process_time() - begin)
    return 1e6 * float(np.median(seconds)) / part[2][..., 0].size


def _part(data: Data, runs: int, steps: int) -> tuple[np.ndarray, ...]:
    return data.filter_keys[:runs], data.inputs[:runs, :steps], data.measurements[:runs, : steps + 1]


def over_budget(microseconds: float, budget: float) -> float:
    """How far a cost is over its budget, in logarithms; at most zero within, as Optuna wants it."""
    return math.log(microseconds / budget)
