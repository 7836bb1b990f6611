"""The machine code of a study's filter types, compiled on several cores before its first trial.

Each type takes some tenths of a second on its first use, on one core, and seconds for a large model. If that turns
out to be so, other processes compile the last of the types meanwhile, into the cache that all processes of a user
share.
"""

from __future__ import annotations

import subprocess
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

import numpy as np

from filters.engine.batch import run
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.threads import cores
from tuning.problems.data import Data
from tuning.search.plan import TRAINING_SEEDS, Plan
from tuning.search.space import untuned_choice
from tuning.search.workers import end, orders_of, parent_says_stop, plan_of, read_orders, start

MODULE = "tuning.search.compiling"
MOST_HELPERS = 3  # each takes some 300 MB
SILENT = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}  # the parent prints what there is to print
COMPILED = 0.4  # seconds above which a filter was compiled and not read from the cache


def compile_filters(
    plan: Plan, names: Sequence[str], on_filter: Callable[[str], None] = lambda name: None
) -> None:
    """Compile what trials of some filter types run, or read it from the cache; what fails is left to the trials.

    Args:
        plan: of a study.
        names: of its filter types.
        on_filter: called with each name before that type is compiled.
    """
    if is_interpreting():
        return
    data = _steps(plan)
    helpers: list[subprocess.Popen] | None = None
    try:
        for index, name in enumerate(names):
            on_filter(name)
            started = time.perf_counter()
            _compile(plan, name, data)
            if helpers is None and time.perf_counter() - started > COMPILED:
                helpers = _helpers(plan, names[index + 1 :])
    finally:
        for process in helpers or ():
            end(process)


def _steps(plan: Plan) -> list[Data]:
    """As many runs of each problem as a trial has, of one step and all the same: different ones may take long."""
    steps = []
    for problem in plan.scenarios:
        seeds = problem.training_seeds(plan.seed, TRAINING_SEEDS)
        first_run = problem.data(seeds[:1]).seen
        parts = first_run.filter_keys, first_run.inputs[:, :1], first_run.measurements[:, :2]
        keys, inputs, measurements = (np.repeat(part, len(seeds), axis=0) for part in parts)
        steps.append(Data(tuple(seeds), inputs, measurements, keys))
    return steps


def _compile(plan: Plan, name: str, data: Sequence[Data]) -> None:
    for problem, problem_data in zip(plan.scenarios, data, strict=True):
        with suppress(ValueError):
            filter_ = untuned_choice(name, problem).filter(problem)
            run(filter_, problem_data.filter_keys, problem_data.inputs, problem_data.measurements)


def _helpers(plan: Plan, names: Sequence[str]) -> list[subprocess.Popen]:
    """Processes that compile filter types from the last one on, while this one goes on with the first."""
    count = min(MOST_HELPERS, cores() - 1, len(names) // 2)
    with suppress(ValueError):  # a model that cannot be sent
        orders = orders_of(plan)
        shares = [[*reversed(names)][first::count] for first in range(count)]
        return [start(MODULE, {**orders, "names": share}, **SILENT) for share in shares]
    return []


def main() -> None:
    """Compile the filter types that standard input names, until all are or it is closed; no error matters."""
    orders = read_orders()
    plan = plan_of(orders)
    data = _steps(plan)
    for name in orders["names"]:
        if parent_says_stop():
            break
        _compile(plan, name, data)


if __name__ == "__main__":
    main()
