"""Objectives that a study minimises, and the constraint on the mean NIS.

NEES is the normalised estimation error squared, NIS the normalised innovation squared.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from typing import NamedTuple

from numerics.checks import one_of, shown
from tuning.evaluation.evaluate import Evaluation
from tuning.problems.problem import Problem

NIS_BAND = (0.8, 1.25)  # of the mean NIS over its expected value: a constrained study calls this consistent
DIVERGENCE_PENALTY = 10.0  # added for each filter reset
LARGEST = 1e6  # larger errors are clipped to this: studies need finite numbers
OUTPUT = "output:"  # prefix of objectives on derived outputs


class Objective(NamedTuple):
    """One number to minimise."""

    about: str
    value: Callable[[Evaluation, float], float]  # of an evaluation and its us/step
    needs_covariance: bool = False
    needs_truth: bool = False
    output: str = ""  # symbol of the derived output that it needs
    needs_nees: bool = False


def nis_ratio(evaluation: Evaluation) -> float:
    """The mean NIS over the mean number of measured channels: expected value 1; NaN without a covariance."""
    return evaluation.nis.value / evaluation.expected_nis


def _nis_inconsistency(evaluation: Evaluation, _: float) -> float:
    """|log(NIS / m)| of the mean."""
    return abs(math.log(nis_ratio(evaluation)))


def _inconsistency(evaluation: Evaluation, _: float) -> float:
    """|log(NEES / n)| + |log(NIS / m)| of the means: zero for a consistent filter."""
    of_errors = abs(math.log(evaluation.nees.value / len(evaluation.rmse)))
    return of_errors + _nis_inconsistency(evaluation, _)


def output_objective(symbol: str, about: str = "") -> Objective:
    """The RMSE of a derived output of the model, in its unit."""
    return Objective(
        about or f"RMSE of the output {symbol}",
        lambda evaluation, _: evaluation.output_rmse[symbol].value,
        needs_truth=True,
        output=symbol,
    )


OBJECTIVES = {
    "score": Objective(
        "mean over states of RMSE over the scenario's scale [-]",
        lambda evaluation, _: evaluation.score.value,
        needs_truth=True,
    ),
    "thrust": output_objective("T", "RMSE of thrust [N]"),
    "likelihood": Objective(
        "negative log-likelihood of the innovations, a run", lambda e, _: -e.log_likelihood, needs_covariance=True
    ),
    "nis": Objective("|log(mean NIS / m)|", _nis_inconsistency, needs_covariance=True),
    "consistency": Objective(
        "|log(mean NEES / n)| + |log(mean NIS / m)|",
        _inconsistency,
        needs_covariance=True,
        needs_truth=True,
        needs_nees=True,
    ),
    "cost": Objective("microseconds a step of one run, of one core", lambda _, microseconds: microseconds),
}


def find_objective(name: str) -> Objective:
    """An objective by name, "output:SYMBOL" for that of a derived output; ValueError for an unknown one."""
    if isinstance(name, str) and name.startswith(OUTPUT) and name != OUTPUT:
        return output_objective(name.removeprefix(OUTPUT))
    return OBJECTIVES[one_of("objective", name, (*OBJECTIVES, f"{OUTPUT}SYMBOL"))]


def check_objectives(names: Iterable[str], problem: Problem) -> None:
    """Raise ValueError if an objective needs the truth, or a derived output, that a problem does not have."""
    for name in names:
        objective = find_objective(name)
        if objective.needs_truth and problem.scale is None:
            free = ", ".join(known for known, one in OBJECTIVES.items() if not one.needs_truth)
            raise ValueError(
                f"an objective on {problem.name}, which has no truth, must be one of {free}, but got {shown(name)}"
            )
        outputs = tuple(problem.model().outputs) if objective.output else ()
        if objective.output and objective.output not in outputs:
            has = ", ".join(f"{OUTPUT}{symbol}" for symbol in outputs) or "none"
            raise ValueError(
                f"an objective on a derived output of {problem.name} must be one of {has}, but got {shown(name)}"
            )


def penalised(value: float, evaluation: Evaluation) -> float:
    """A finite value for a study; it is large for a filter that diverged."""
    value = min(value, LARGEST) if value == value else LARGEST
    return value + DIVERGENCE_PENALTY * evaluation.divergences


def nis_violation(evaluation: Evaluation) -> float:
    """Logarithmic distance of the mean NIS from its band; at most zero inside, as Optuna expects it."""
    low, high = NIS_BAND
    ratio = nis_ratio(evaluation)
    if not ratio > 0.0 or not math.isfinite(ratio):
        return LARGEST
    return max(math.log(low / ratio), math.log(ratio / high))
