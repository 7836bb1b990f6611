"""Objectives that a study minimises, and the constraint on the mean NIS.

Sources: for NEES and NIS, the normalised squares of estimation errors and innovations, Chen, Heckman, Julier,
Ahmed (2018), arXiv 1807.08855 (`nees`, `nis`), and Chen, Biggie, Ahmed, Julier, Heckman, arXiv 2306.07225
(`c-nees`, `c-nis`); Abbeel, Coates, Montemerlo, Ng, Thrun (2005), "Discriminative training of Kalman filters",
Robotics: Science and Systems (`mse`, `log-score`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

from thruster_env.core.checks import one_of
from tuning.evaluation.evaluate import Evaluation, mse

NIS_BAND = (0.8, 1.25)  # of the mean NIS over its expected value: a constrained study calls this consistent
MOST_PRICE = 0.05  # of the score, that a mean NIS within its band may cost
DIVERGENCE_PENALTY = 10.0  # added for each filter reset
LARGEST = 1e6  # larger errors are clipped to this: studies need finite numbers
OUTPUT = "output:"  # prefix of objectives on derived outputs
SCORE, MSE, LOG_SCORE, LIKELIHOOD = "score", "mse", "log-score", "likelihood"
PROPER = (
    LOG_SCORE,
    LIKELIHOOD,
)  # sums of logarithms, of which differences count: proper scores of mean and covariance
TRUTH, COVARIANCE, NEES, LOG_SCORES, VARIANCES = "truth", "covariance", "nees", "log scores", "variances"


class Objective(NamedTuple):
    """One number to minimise."""

    about: str
    value: Callable[[Evaluation, float], float]  # of an evaluation and its us/step
    needs: tuple[str, ...] = ()  # of TRUTH, COVARIANCE, NEES, LOG_SCORES, VARIANCES
    output: str = ""  # symbol of the derived output that it needs


def nis_ratio(evaluation: Evaluation) -> float:
    """The mean NIS over the mean number of measured channels: expected value 1; NaN without a covariance."""
    return evaluation.nis.value / evaluation.expected_nis


def nees_ratio(evaluation: Evaluation) -> float:
    """The mean NEES over the number of states: expected value 1; NaN without truth or without a covariance."""
    return evaluation.nees.value / len(evaluation.rmse)


def _from_one(*ratios: Callable[[Evaluation], float]) -> Callable[[Evaluation, float], float]:
    """The sum of |log| of ratios whose expected value is 1, as a function of an evaluation; infinite for none."""

    def value(evaluation: Evaluation, _: float) -> float:
        values = [ratio(evaluation) for ratio in ratios]
        return sum(abs(math.log(ratio)) for ratio in values) if all(ratio > 0.0 for ratio in values) else math.inf

    return value


def output_objective(symbol: str, about: str = "") -> Objective:
    """The RMSE of a derived output of the model, in its unit."""
    return Objective(
        about or f"RMSE of the output {symbol}",
        lambda evaluation, _: evaluation.output_rmse[symbol].value,
        (TRUTH,),
        symbol,
    )


OBJECTIVES = {
    SCORE: Objective(
        "mean over states of RMSE over the scenario's scale [-]", lambda e, _: e.score.value, (TRUTH,)
    ),
    MSE: Objective(
        "sum over states of mean square error over the scenario's scale squared [-]",
        lambda e, _: mse(e.mean_squares, e.scale, e.weights),
        (TRUTH,),
    ),
    LOG_SCORE: Objective(
        "negative log score of the true state, -log N(x; x^, P), mean a step [nat]",
        lambda e, _: -e.log_score.value,
        (TRUTH, COVARIANCE, LOG_SCORES),
    ),
    "thrust": output_objective("T", "RMSE of thrust [N]"),
    LIKELIHOOD: Objective(
        "negative log-likelihood of the innovations, a run", lambda e, _: -e.log_likelihood, (COVARIANCE,)
    ),
    "nis": Objective("|log(mean NIS / m)|", _from_one(nis_ratio), (COVARIANCE,)),
    "c-nis": Objective(
        "|log(mean NIS / m)| + |log(variance of the NIS / 2 m)|",
        _from_one(nis_ratio, lambda e: e.nis_variance),
        (COVARIANCE, VARIANCES),
    ),
    "nees": Objective("|log(mean NEES / n)|", _from_one(nees_ratio), (TRUTH, COVARIANCE, NEES)),
    "c-nees": Objective(
        "|log(mean NEES / n)| + |log(variance of the NEES / 2 n)|",
        _from_one(nees_ratio, lambda e: e.nees_variance),
        (TRUTH, COVARIANCE, NEES, VARIANCES),
    ),
    "consistency": Objective(
        "|log(mean NEES / n)| + |log(mean NIS / m)|",
        _from_one(nees_ratio, nis_ratio),
        (TRUTH, COVARIANCE, NEES),
    ),
    "cost": Objective("microseconds a step of one run, of one core", lambda _, microseconds: microseconds),
}


def find_objective(name: str) -> Objective:
    """An objective by name, "output:SYMBOL" for that of a derived output; ValueError for an unknown one."""
    if isinstance(name, str) and name.startswith(OUTPUT) and name != OUTPUT:
        return output_objective(name.removeprefix(OUTPUT))
    return OBJECTIVES[one_of("objective", name, (*OBJECTIVES, f"{OUTPUT}SYMBOL"))]


def reported(name: str, value: float) -> float:
    """The value of an objective in reports: log L and the log score themselves, not the minimised negative."""
    return -value if name in PROPER else value


def reported_name(name: str) -> str:
    """The name of what `reported` returns."""
    return {LIKELIHOOD: "log L", LOG_SCORE: "log score"}.get(name, name)


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
