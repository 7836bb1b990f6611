"""The baselines of a tuned filter: given, scaled default, rule of thumb, noise estimation and oracle.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from filters.registry import filter_type
from tuning.evaluation.evaluate import values_of
from tuning.evaluation.residuals import noise_estimation
from tuning.problems.assumed import as_argument, rows_argument
from tuning.problems.check import data_of
from tuning.problems.problem import Problem
from tuning.search.objectives import LARGEST, nis_ratio
from tuning.search.plan import TRAINING_SEEDS
from tuning.search.space import Choice, given_choice, oracle_choice, untuned_choice

# Their names in tables, sentences and pictures.
GIVEN, SCALED, RULE, NOISE, ORACLE = "given", "scaled default", "rule of thumb", "noise estimation", "oracle"
TUNED, OWN = "tuned", "own numbers"  # OWN: those that a user brings to an evaluation
BY_IMPORTANCE = (GIVEN, SCALED, RULE, NOISE, ORACLE)  # the first that there is is the one that a headline names
NO_RANGES = f"No ranges: the model's Q is taken in place of a {RULE}; give the model state_low and state_high."
DECADES = 8  # powers of ten, up and down, within which the factor on Q is searched
DIGITS = 4  # to which the factor is rounded, so that the printed factor is the one in use
CLOSE = 0.02  # tolerance of the mean NIS about 1: that of an ensemble need not be continuous in Q


class Scaled(NamedTuple):
    """The scaled default of a filter, or the reason why there is none."""

    choice: Choice | None
    factor: float | None  # on the rule of thumb's Q
    nis: float | None  # mean NIS over the channels on the training runs, with that factor
    reason: str = ""  # why there is none; empty where there is one


def called(name: str) -> str:
    """A baseline in a sentence, after "the"."""
    return "given numbers" if name == GIVEN else name


def rule_of_thumb(name: str, scenario: Problem) -> Choice:
    """R from the sensor's data sheet, Q = diag((1 % of each state's range)^2), N = 30 (particles: 1000)."""
    return untuned_choice(name, scenario)


def given(name: str, scenario: Problem) -> Choice | None:
    """The filter with the given Q and R of the problem's model; None if there are none.

    A model with the plant's own Q and R is the oracle, not a given one.
    """
    return given_choice(name, scenario) if filter_type(name).has_covariance else None


def rule_label(scenario: Problem) -> str:
    """The name of the rule of thumb on a problem: "given" if it equals the model's given values."""
    return GIVEN if scenario.given is not None and _same_values(scenario.given, scenario.untuned) else RULE


def noise_estimated(name: str, scenario: Problem, seed: int = 0) -> Choice | None:
    """The filter with the sample covariances of its model's residuals on the truth; None if there are none."""
    if not filter_type(name).has_covariance:
        return None
    found = noise_estimation(scenario, seed)
    if found.process_cov is None or found.measurement_cov is None:
        return None
    return with_covariances(rule_of_thumb(name, scenario), found.process_cov, found.measurement_cov)


def with_covariances(choice: Choice, q: np.ndarray | None, r: np.ndarray | None) -> Choice:
    """The same choice with another Q (n, n) and R (m, m), unchanged if None."""
    noise = {} if q is None else {"process_noise_cov": rows_argument(q)}
    noise |= {} if r is None else {"measurement_noise_cov": as_argument(r)}
    return choice._replace(model={**choice.model, **noise})


def oracle(name: str, scenario: Problem) -> Choice | None:
    """The filter with the plant's own Q and R and the rule of thumb's N; None if they are unknown."""
    return oracle_choice(name, scenario)


@lru_cache(maxsize=64)
def scaled_default(name: str, scenario: Problem, seed: int = 0) -> Scaled:
    """The rule of thumb with one factor on its Q, so that the mean NIS on the training runs is as expected.

        mean of nu' S(c Q, R)^-1 nu over runs and scored steps = m,  solved for log c

    An engineer would do the same after one look at the innovations. R is unchanged. The runs are the training runs
    of a study with this seed, with the same random numbers for each c, so the same arguments give the same factor.

    Args:
        name: name of the filter.
        scenario: generates the training runs, and defines the model that the filter assumes.
        seed: seed of the study.

    Returns:
        The choice with its factor and mean NIS; or the reason why there is none: the filter has no NIS, or no
        factor between 1e-8 and 1e8 brings its mean NIS to 1.
    """
    if not rule_of_thumb(name, scenario).filter(scenario).has_covariance:
        return Scaled(None, None, None, f"{name} has no NIS by which its Q could be scaled")
    data = data_of(scenario, scenario.training_seeds(seed, TRAINING_SEEDS))
    start = _with_noise(rule_of_thumb(name, scenario), scenario)

    def nis_at(factor: float) -> float:
        ratio = nis_ratio(values_of(scaled(start, factor).filter(scenario), data, scenario.scale))
        return ratio if 0.0 < ratio < LARGEST else LARGEST

    def excess(exponent: float) -> float:
        return math.log(nis_at(10.0**exponent))

    first, exponent = excess(0.0), 0
    if not np.any(start.model["process_noise_cov"]):
        said = f"no factor on a Q of zero brings the mean NIS of {name} to 1: it is {math.exp(first):.3g}"
        return Scaled(None, None, None, said)
    step = 1 if first > 0 else -1  # a larger Q lowers the NIS
    last = first
    while last * first > 0 and abs(exponent) < DECADES:
        exponent += step
        last = excess(exponent)
    if last * first > 0:
        ends = f"{math.exp(first):.3g} with a factor of 1 and {math.exp(last):.3g} with {10.0**exponent:g}"
        return Scaled(None, None, None, f"no factor on Q brings the mean NIS of {name} to 1: it is {ends}")
    from scipy.optimize import brentq  # loads half of SciPy, for this line

    root = brentq(excess, *sorted((exponent - step, exponent)), xtol=1e-3, rtol=1e-3) if exponent else 0.0
    factor = float(f"{10.0**root:.{DIGITS}g}")
    nis = nis_at(factor)
    if abs(nis - 1.0) > CLOSE:
        said = f"no factor on Q brings the mean NIS of {name} to 1: it jumps to {nis:.3g} with {factor:g}"
        return Scaled(None, None, None, said)
    return Scaled(scaled(start, factor), factor, nis)


def scaled_rule(rule: Choice, scenario: Problem, factor: float) -> Choice:
    """A rule of thumb with a factor on its Q, even if Q follows from other parameters."""
    return scaled(_with_noise(rule, scenario), factor)


def scaled(choice: Choice, factor: float) -> Choice:
    """The same choice with the process noise covariance multiplied by a factor."""
    q = choice.model["process_noise_cov"]
    if np.ndim(q) == 1:
        larger = tuple(factor * variance for variance in q)
    else:
        larger = tuple(map(tuple, (factor * np.asarray(q)).tolist()))
    return choice._replace(model={**choice.model, "process_noise_cov": larger})


def _with_noise(choice: Choice, scenario: Problem) -> Choice:
    """The same choice with Q and R among its arguments, even where they follow from other parameters."""
    if "process_noise_cov" in choice.model:
        return choice
    model = scenario.model(**choice.model)
    q, r = rows_argument(model.process_noise_cov), as_argument(model.measurement_noise_cov)
    return choice._replace(model={**choice.model, "process_noise_cov": q, "measurement_noise_cov": r})


def baselines(name: str, scenario: Problem, seed: int = 0, default: Scaled | None = None) -> dict[str, Choice]:
    """All existing baselines of a filter by name, the most important one first.

    The scaled default is computed for the study's seed, unless it is given. If the model's given values are the
    rule of thumb, there is one baseline for both, called "given".
    """
    scaled = (scaled_default(name, scenario, seed) if default is None else default).choice
    found = {GIVEN: given(name, scenario), SCALED: scaled, RULE: rule_of_thumb(name, scenario)}
    if found[GIVEN] is not None and rule_label(scenario) == GIVEN:
        del found[RULE]
    found |= {NOISE: noise_estimated(name, scenario, seed), ORACLE: oracle(name, scenario)}
    return {key: choice for key, choice in found.items() if choice is not None}


def same_filter(a: Choice, b: Choice) -> bool:
    """Whether two choices are the same filter."""
    return a.name == b.name and _same_values(a.model, b.model) and _same_values(a.numbers, b.numbers)


def _same_values(a: Mapping, b: Mapping) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key]) for key in a)
