"""The data that a bench shows: runs of a plant, or recorded logs as a whole with the blocks they are cut into."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np

from thruster_env.core.streams import filter_keys
from tuning.problems.check import data_of
from tuning.problems.data import Data, mask_of, only, padded
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Problem


class PageData(NamedTuple):
    """What is drawn, and what is counted: the same runs, unless they are logs."""

    drawn: Data  # of a plant the runs of some seeds; of logs each log as a whole
    counted: Data  # of a plant the same; of logs the training blocks
    held_out: Data | None  # of logs the held-out blocks; None of a plant


@lru_cache(maxsize=8)
def page_data(problem: Problem, seeds: int, seed: int, held_out: bool) -> PageData:
    """The data of a problem for a bench.

    Args:
        problem: what makes the data.
        seeds: number of seeds; logs are shown whole.
        seed: of the study whose training seeds, or held-out seeds, these are.
        held_out: whether they are those on which a study's choice is evaluated, as `thruster evaluate` does it.
    """
    if isinstance(problem, LogProblem):
        blocks = [
            data_of(problem, choose(seed, seeds)) for choose in (problem.training_seeds, problem.held_out_seeds)
        ]
        return PageData(_whole(problem), *blocks)
    choose = problem.held_out_seeds if held_out else problem.training_seeds
    data = data_of(problem, choose(seed, seeds))
    return PageData(data, data, None)


def _whole(problem: LogProblem) -> Data:
    """Each log from its first row to its last, with the random numbers of `thruster estimate`."""
    logs, model = problem.logs, problem.model()
    rows = max(len(log.measurements) for log in logs)
    data = Data(
        tuple(range(len(logs))),
        padded([log.inputs[: len(log.measurements) - 1] for log in logs], rows - 1, None),
        padded([log.measurements for log in logs], rows),
        np.repeat(filter_keys([0]), len(logs), axis=0),
        problem.first_scored_step,
        counted=mask_of([len(log.measurements) for log in logs], rows),
    )
    if problem.scale is None:
        return data.read_only()
    states = padded([truth for log in logs if (truth := log.true_states(model)) is not None], rows)
    known = only(data.counted, ~np.isnan(states).any(axis=-1))
    return data._replace(states=states, counted=known).read_only()
