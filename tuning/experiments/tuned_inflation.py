"""Inflation tuned by a study like any other parameter, on problems whose published scores depend on it."""

from __future__ import annotations

from typing import NamedTuple

from filters.consistency.intervals import Interval, mean_interval
from filters.engine.batch import run
from tuning.evaluation.runs import state_errors
from tuning.experiments.benchmark import mean_of_roots
from tuning.problems.model_problem import ModelProblem
from tuning.problems.seeds import held_out_seeds
from tuning.search.plan import Plan
from tuning.search.space import Choice
from tuning.search.study import open_study, quiet_optuna, run_study


class Tuned(NamedTuple):
    """The choice of a study, and its score on held-out seeds."""

    choice: Choice
    score: Interval  # rmse.a


def tune_inflation(filter_name: str, problem: ModelProblem, trials: int, runs: int, seed: int = 0) -> Tuned:
    """Tune an ensemble filter's N, inflation and relaxation, with R held, and run it on held-out seeds.

    Args:
        filter_name: "enkf", "etkf", "ensrf" or "denkf".
        problem: a problem without process noise, so that Q is not tuned either.
        trials: number of trials of the study.
        runs: number of held-out seeds.
        seed: seed of the study.
    """
    quiet_optuna()
    plan = Plan(filter_name, (problem,), seed, hold_r=True)
    study = open_study("inflation", plan)
    choice = run_study(study, plan, trials).choice
    data, filter_ = problem.data(held_out_seeds(seed, runs)), choice.filter(problem)
    estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
    errors = state_errors(filter_, estimates, data)[:, data.late]
    return Tuned(choice, mean_interval(mean_of_roots(errors)))
