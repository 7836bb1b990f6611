"""What a study makes small, and what it has to keep within bounds."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from numerics.checks import one_of
from tuning.evaluation.evaluate import Evaluation

NIS_BAND = (0.8, 1.25)  # of the mean NIS over the number of channels: what a constrained study calls consistent
DIVERGENCE_PENALTY = 10.0  # added for each run that had to restart
LARGEST = 1e6  # an error beyond this is this: studies want finite numbers


class Objective(NamedTuple):
    """One number to minimise."""

    about: str
    value: Callable[[Evaluation, float], float]  # of an evaluation and its microseconds a step
    needs_covariance: bool = False


def _inconsistency(evaluation: Evaluation, _: float) -> float:
    """|log(NEES / n)| + |log(NIS / m)| of the means: zero for a filter as sure of itself as it may be."""
    pairs = (evaluation.nees.value, len(evaluation.rmse)), (evaluation.nis.value, evaluation.channels)
    return sum(abs(math.log(value / expected)) for value, expected in pairs)


OBJECTIVES = {
    "score": Objective(
        "mean over states of RMSE over the scenario's scale [-]", lambda evaluation, _: evaluation.score.value
    ),
    "thrust": Objective("RMSE of thrust [N]", lambda evaluation, _: evaluation.thrust_rmse.value),
    "likelihood": Objective(
        "negative log-likelihood of the innovations, a run", lambda e, _: -e.log_likelihood, needs_covariance=True
    ),
    "consistency": Objective("|log(mean NEES / n)| + |log(mean NIS / m)|", _inconsistency, needs_covariance=True),
    "cost": Objective("microseconds a step of one run, of one core", lambda _, microseconds: microseconds),
}


def find_objective(name: str) -> Objective:
    """An objective by name; ValueError for an unknown one."""
    return OBJECTIVES[one_of("objective", name, tuple(OBJECTIVES))]


def penalised(value: float, evaluation: Evaluation) -> float:
    """A finite value for a study: that of a filter which diverged is large."""
    value = min(value, LARGEST) if value == value else LARGEST
    return value + DIVERGENCE_PENALTY * evaluation.divergences


def nis_ratio(evaluation: Evaluation) -> float:
    """The mean NIS over the number of channels: 1 is right, NaN without a covariance."""
    return evaluation.nis.value / evaluation.channels


def nis_violation(evaluation: Evaluation) -> float:
    """How far the mean NIS is outside its band, in logarithms; at most zero inside, as Optuna wants it."""
    low, high = NIS_BAND
    ratio = nis_ratio(evaluation)
    if not ratio > 0.0 or not math.isfinite(ratio):
        return LARGEST
    return max(math.log(low / ratio), math.log(ratio / high))
