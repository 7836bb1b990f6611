"""What tuning loses where nobody knows the true states: from logs of a simulation, and with its truth."""

from __future__ import annotations

from itertools import product
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval
from plants.logs.log import Log
from tuning.evaluation.evaluate import Evaluation, evaluate, score_ratio
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Problem
from tuning.search.plan import HELD_OUT_SEEDS, Plan
from tuning.search.space import Choice
from tuning.search.study import open_study, quiet_optuna, run_study

TRIALS = 60
RUNS, MANY_RUNS = 96, 300  # logs, of which two thirds are learnt from
FILTERS = ("kf", "ekf", "enkf")
CASES = (*product(("nominal", "outliers"), FILTERS), ("published_tunnel", "kf"))


class Hidden(NamedTuple):
    """Two studies of one filter on the same runs, both proved on the same held-out seeds with their truth."""

    seen: Choice  # of the study that saw the true states
    blind: Choice  # of the one that saw logs without them
    seen_evaluation: Evaluation
    blind_evaluation: Evaluation

    @property
    def ratio(self) -> Interval:
        """Score of the blind one over that of the seeing one, paired: 1 where the truth is worth nothing."""
        return score_ratio(self.blind_evaluation, self.seen_evaluation)

    @property
    def rmse_ratios(self) -> np.ndarray:
        """RMSE of the blind one over the other's, (n,), by state."""
        pairs = zip(self.blind_evaluation.rmse, self.seen_evaluation.rmse, strict=True)
        return np.array([blind.value / seen.value for blind, seen in pairs])


def logs_of(problem: Problem, seed: int = 0, count: int = RUNS) -> list[Log]:
    """Logs of runs with a problem's training seeds, its own study's first: inputs and measurements alone."""
    data, model = problem.data(problem.training_seeds(seed, count)), problem.model()
    return [
        Log(f"run{place}", problem.dt, inputs, measurements, model.input_quantities, model.measurements)
        for place, (inputs, measurements) in enumerate(zip(data.inputs, data.measurements, strict=True))
    ]


def hide_truth(
    filter_name: str,
    problem: Problem,
    trials: int = TRIALS,
    seed: int = 0,
    runs: int = RUNS,
    held_out: int = HELD_OUT_SEEDS,
) -> Hidden:
    """Tune a filter on a problem with its truth, and on logs of the same runs without it.

    Args:
        filter_name: of the filter.
        problem: with a truth.
        trials: of either study.
        seed: of both.
        runs: logs, of which every third is held out by their own problem; the problem's own study learns from 32.
        held_out: seeds of the problem on which both are proved.
    """
    quiet_optuna()
    blind_problem = LogProblem(logs_of(problem, seed, runs), problem.model(), blocks=1, name="logs")
    plans = Plan(filter_name, (problem,), seed), Plan(filter_name, (blind_problem,), seed, ("likelihood",))
    choices = []
    for plan in plans:
        study = open_study(f"hidden-{filter_name}", plan)
        choices.append(run_study(study, plan, trials).or_interrupted().choice)
    data = problem.data(problem.held_out_seeds(seed, held_out))
    found = [evaluate(choice.filter(problem), data, problem.scale) for choice in choices]
    return Hidden(*choices, *found)
