"""What residuals of the true states, or without these the innovations, say of a model."""

from __future__ import annotations

import numpy as np

from filters.consistency.intervals import Interval, span
from filters.consistency.verdicts import confidence, mean_sentence
from thruster_env.model.quantities import Quantity
from tuning.evaluation.evaluate import is_beyond
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.regression import is_far_below
from tuning.evaluation.residuals import noise_estimation
from tuning.problems.augmented import within
from tuning.problems.plant_packages import logs_package
from tuning.problems.problem import Problem

SMALL = 0.1  # of a mean over its deviation, or of a correlation: what is below says little of a model
STRONG = 0.5  # correlation of residuals with the next step, above which a headline says that the model is wrong
LARGE_NIS = 3.0  # mean NIS of the given Q and R over its expected value, above which the model is in doubt
MADE_UP = "made consistent by Q and R, not by the model"
JOINTLY = "consistent jointly, but not in each state"


def residual_sentences(problem: Problem, seed: int = 0) -> list[str]:
    """What noise estimation tells beside its Q and R, in a sentence; none where there is no truth.

    Of the process noise w = x' - f(x, u) and the measurement noise v = z - h(x) of the training runs it gives the
    mean over the deviation and the correlation with the next step, where one of these is above 0.1.
    """
    found = noise_estimation(problem, seed)
    if found.process_cov is None or found.measurement_cov is None:
        return []
    model = problem.quantities
    w = _told(model.states, found.process_cov, found.process_mean, found.process_correlation)
    v = _told(model.measurements, found.measurement_cov, found.measurement_mean, found.measurement_correlation)
    parts = [f"{what} {', '.join(some)}" for what, some in (("w of", w), ("v of", v)) if some]
    if not parts:
        return [
            "The residuals of the true states, w = x' - f(x, u) and v = z - h(x), look like white noise: each "
            f"mean over its standard deviation and each correlation with the next step is below {SMALL:g}."
        ]
    return [
        f"The residuals of the true states, w = x' - f(x, u) and v = z - h(x), are not zero-mean white noise: "
        f"{'; '.join(parts)} (mean over standard deviation; correlation with the next step). The model is wrong "
        "there, and no Q and R make up for it."
    ]


def _told(
    quantities: tuple[Quantity, ...], cov: np.ndarray, mean: np.ndarray | None, correlation: np.ndarray | None
) -> list[str]:
    deviations = np.sqrt(np.diag(cov))
    if mean is None or correlation is None or not deviations.any():
        return []
    relative = np.divide(mean, deviations, out=np.zeros_like(mean), where=deviations > 0)
    rows = zip(quantities, relative.tolist(), correlation.tolist(), strict=True)
    return [f"{one.symbol} ({a:+.2g}; {b:+.2g})" for one, a, b in rows if max(abs(a), abs(b)) > SMALL]


def model_doubts(problem: Problem, comparison: Comparison, seed: int = 0) -> list[str]:
    """Strong evidence against a model, in a list; empty if there is none.

    With truth, residuals of the training runs correlate by more than 0.5 with the next step. Without truth it is a
    question: the given Q and R have a mean NIS above three times the expected one, or the tuned filter predicts
    held-out measurements far worse than a linear regression, `tuning.evaluation.regression`.

    Args:
        problem: has the model.
        comparison: of the tuned filter on it.
        seed: of the study, whose training runs have the residuals.
    """
    given, over, reasons = comparison.given, comparison.over_regression, []
    if comparison.tuned.has_truth:
        return _correlation_doubt(problem, seed)
    if given is not None and given.nis.value > LARGE_NIS * given.expected_nis:
        reasons.append(
            f"with its own Q and R the mean NIS is {given.nis.value:.3g} where {given.expected_nis:.3g} is right"
        )
    if is_far_below(over):
        gained = span(Interval(-over.value, -over.high, -over.low), 2)
        reasons.append(
            f"a linear regression on past rows predicts with a log-likelihood {gained} higher a measurement"
        )
    said = "; ".join(reasons)
    return [f"Is {_model_of(problem)}? {said[:1].upper()}{said[1:]}."] if said else []


def _correlation_doubt(problem: Problem, seed: int) -> list[str]:
    """Residuals of the true states that strongly correlate with the next step, in a sentence in a list."""
    found, model = noise_estimation(problem, seed), problem.quantities
    if found.process_correlation is None or found.measurement_correlation is None:
        return []
    parts = (
        ("w of", model.states, found.process_correlation),
        ("v of", model.measurements, found.measurement_correlation),
    )
    strong = [
        f"{r:+.2g} ({what} {one.symbol})"
        for what, quantities, correlation in parts
        for one, r in zip(quantities, correlation.tolist(), strict=True)
        if abs(r) > STRONG
    ]
    if not strong:
        return []
    return [
        f"The residuals of the true states correlate with the next step: {', '.join(strong)}, where 0 is right. "
        "The model is wrong there or lacks a state, and no Q and R make up for it: correct it, or estimate a "
        "constant (--augment NAME)."
    ]


def _model_of(problem: Problem) -> str:
    """The model of logs as the user named it, with the options that name another one."""
    options = (within(problem).as_mapping() or {}).get("options")
    if options is None:
        return "this model the right one"
    if "model" in options:
        return f"{options['model']} the right model (--model)"
    preset = options.get("preset")
    named = f"{preset}" if preset else f"{logs_package().DEFAULT_PRESET}, the default,"
    return f"{named} the right preset (--preset, or --model)"


def consistency_of(comparison: Comparison) -> tuple[str, Interval, float, str]:
    """NEES, without truth NIS, of the tuned filter: its name, mean and expected value, and a verdict."""
    tuned = comparison.tuned
    if tuned.has_truth:
        name, mean, right = "NEES", tuned.nees, float(len(tuned.rmse))
    else:
        name, mean, right = "NIS", tuned.nis, tuned.expected_nis
    if mean.covers(right) and is_far_below(comparison.over_regression):
        return name, mean, right, MADE_UP
    if mean.covers(right) and any(map(is_beyond, tuned.scored_nees.values())):
        return name, mean, right, JOINTLY
    return name, mean, right, confidence(mean, right)


def consistency_sentence(comparison: Comparison) -> str:
    """The same in a sentence; a filter that predicts far worse than a regression is never called consistent."""
    name, mean, right, word = consistency_of(comparison)
    said = mean_sentence(name, mean, right)
    if word in (MADE_UP, JOINTLY):
        return f"{word[:1].upper()}{word[1:]}:{said.partition(':')[2]}"
    if not comparison.tuned.has_truth or said.startswith("Consistent"):
        return said
    return f"{said} RMSE and NIS do not fully test the covariance."
