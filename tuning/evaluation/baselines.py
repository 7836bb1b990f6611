"""The baselines of a tuned filter: given, scaled default, rule of thumb, noise estimation and oracle.

A linear regression of the measurements, which assumes no model, tests whether the model fits the logs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from filters.consistency.nees import Interval
from filters.registry import filter_type
from tuning.evaluation.evaluate import values_of
from tuning.evaluation.residuals import noise_estimation
from tuning.problems.assumed import as_argument, rows_argument
from tuning.problems.check import data_of
from tuning.problems.data import Data
from tuning.problems.problem import Coordinates, Problem
from tuning.search.parameters import ensemble_sizes_of
from tuning.search.plan import LARGEST, TRAINING_SEEDS, nis_ratio
from tuning.search.space import Choice, given_choice, oracle_choice, untuned_choice

# Their names in tables, sentences and pictures.
GIVEN, SCALED, RULE, NOISE, ORACLE = "given", "scaled default", "rule of thumb", "noise estimation", "oracle"
FULL_Q, FULL_QR = "noise estimation with a full Q", "noise estimation with a full Q and R"  # beside own parameters
TUNED, OWN = "tuned", "own numbers"  # OWN: those that a user brings to an evaluation
BY_IMPORTANCE = (GIVEN, SCALED, RULE, NOISE, ORACLE)  # the first that there is is the one that a headline names
NO_RANGES = f"No ranges: the model's Q is taken in place of a {RULE}; give the model state_low and state_high."
DECADES = 4  # powers of ten, up and down, within which the factor on Q is searched: no engineer goes further
DIGITS = 4  # to which the factor is rounded, so that the printed factor is the one in use
FLOOR = 1e-6  # of each variance, which is added to singular covariances before they are compared
UNMOVED = 1e-9  # of a coordinate, within which a parameter has not moved
BEYOND = 1e200  # in place of an infinite divergence
CLOSE = 0.02  # tolerance of the mean NIS about 1: that of an ensemble need not be continuous in Q

# Of the regression.
ORDERS = (1, 2, 3, 5, 8)  # numbers of past rows, among which the training runs choose
MOST_NUMBERS = 1_000_000  # of the matrix of regressors
LEAST_VARIANCE = 1e-12  # of the residuals, over that of the channel: what is below is rounding
FEWEST = 10  # rows for each weight
FAR = 0.1  # log-likelihood of a measurement by which a filter is far below: its innovations are 10 % larger


class Scaled(NamedTuple):
    """The scaled default of a filter, or the reason why there is none."""

    choice: Choice | None
    factor: float | None  # on the rule of thumb's Q
    nis: float | None  # mean NIS over the channels on the training runs, with that factor
    reason: str = ""  # why there is none; empty where there is one


def called(name: str) -> str:
    """A baseline in a sentence, after "the"."""
    return "given filter" if name == GIVEN else name


def rule_of_thumb(name: str, scenario: Problem) -> Choice:
    """R from the sensor's data sheet, Q = diag((1 % of each state's range)^2), N = 30 (particles: 1000)."""
    return untuned_choice(name, scenario)


def given_noise(name: str, scenario: Problem) -> Choice | None:
    """The filter with the given Q and R of the problem's model, which may be the plant's; None without."""
    return given_choice(name, scenario) if filter_type(name).has_covariance else None


def rule_label(scenario: Problem) -> str:
    """The name of the rule of thumb on a problem: "given" if it equals the model's given values."""
    return GIVEN if scenario.given is not None and _same_values(scenario.given, scenario.untuned) else RULE


def noise_estimated(name: str, scenario: Problem, seed: int = 0) -> Choice | None:
    """The filter with the sample covariances of its model's residuals on the truth; None if there are none.

    Of a problem with parameters of its own it has the parameters whose Q and R are `nearest` to these covariances.
    """
    if not filter_type(name).has_covariance:
        return None
    estimated = noise_estimation(scenario, seed)
    if estimated.process_cov is None or estimated.measurement_cov is None:
        return None
    rule = rule_of_thumb(name, scenario)
    if scenario.parameters is None:
        return with_covariances(rule, estimated.process_cov, estimated.measurement_cov)
    projected = rule._replace(
        model={**rule.model, **nearest(scenario, estimated.process_cov, estimated.measurement_cov)}
    )
    return None if same_filter(projected, rule) else projected


def full_noise(name: str, scenario: Problem, seed: int = 0, *, with_r: bool = False) -> Choice | None:
    """Noise estimation of a problem with own parameters, and a full Q, or Q and R, which they cannot express."""
    estimated, projected = noise_estimation(scenario, seed), noise_estimated(name, scenario, seed)
    if scenario.parameters is None or estimated.process_cov is None:
        return None
    start = _with_noise(projected or rule_of_thumb(name, scenario), scenario)
    return with_covariances(start, estimated.process_cov, estimated.measurement_cov if with_r else None)


def nearest(scenario: Problem, q: np.ndarray, r: np.ndarray) -> dict[str, float]:
    """The parameters of a problem's own whose Q and R are nearest to some others, by Kullback and Leibler.

        theta = argmin D(Q, Q(theta)) + D(R, R(theta)),   D(S, C) = (tr(C^-1 S) - log det(C^-1 S) - n) / 2

    D is the divergence of N(0, C) from N(0, S). If Q and R are sample covariances of residuals, theta is their
    maximum-likelihood estimate. A millionth of each variance is added to both matrices, because a Q of fewer
    noises than states is singular. Whole numbers, and parameters that change neither Q nor R, stay what they are.

    Args:
        scenario: a problem with parameters of its own.
        q: (n, n).
        r: (m, m).

    Source: Kullback, Leibler (1951), "On information and sufficiency", Annals of Mathematical Statistics 22(1).
    """
    from scipy.optimize import minimize  # loads half of SciPy, for this line

    start = {parameter.name: float(scenario.untuned[parameter.name]) for parameter in scenario.parameters or ()}
    space = Coordinates([parameter for parameter in scenario.parameters or () if not parameter.integer])
    first = scenario.model(**scenario.untuned)
    pairs = ((q, first.process_noise_cov), (r, first.measurement_noise_cov))
    floors = [FLOOR * np.where(np.diag(s) > 0, np.diag(s), np.diag(c)) for s, c in pairs]

    def divergence(point: np.ndarray) -> float:
        try:
            model = scenario.model(**{**scenario.untuned, **space.named(point)})
        except ValueError:  # of a user's function
            return BEYOND
        covs = model.process_noise_cov, model.measurement_noise_cov
        total = sum(map(_divergence, (q, r), covs, floors))
        return total if total < BEYOND else BEYOND

    at = space.start({name: value for name, value in start.items() if name in space.names})
    ends = list(zip(space.low, space.high, strict=True))
    optimum = minimize(divergence, at, method="L-BFGS-B", bounds=ends, options={"ftol": 1e-13, "gtol": 1e-7})
    changed = dict(zip(space.names, np.abs(optimum.x - at) > UNMOVED, strict=True))
    return start | {name: value for name, value in space.named(optimum.x).items() if changed[name]}


def _divergence(s: np.ndarray, c: np.ndarray, floor: np.ndarray) -> float:
    """tr(C^-1 S) + log det C of matrices (n, n) with a floor (n,), in units of S, from which D differs by no C."""
    rows = floor > 0  # a state without noise in either
    scale = np.sqrt(floor[rows] / FLOOR)
    s, c = (matrix[np.ix_(rows, rows)] / np.outer(scale, scale) + FLOOR * np.eye(len(scale)) for matrix in (s, c))
    try:
        factor = np.linalg.cholesky(c)
    except np.linalg.LinAlgError:
        return BEYOND
    half = np.linalg.solve(factor, s)
    return float(np.trace(np.linalg.solve(factor, half.T)) + 2.0 * np.log(np.diag(factor)).sum())


def with_covariances(choice: Choice, q: np.ndarray | None, r: np.ndarray | None) -> Choice:
    """The same choice with another Q (n, n) and R (m, m), unchanged if None."""
    noise = {} if q is None else {"process_noise_cov": rows_argument(q)}
    noise |= {} if r is None else {"measurement_noise_cov": as_argument(r)}
    return choice._replace(model={**choice.model, **noise})


def oracle(name: str, scenario: Problem) -> Choice | None:
    """The filter with the plant's own Q and R and the rule of thumb's N; None if they are unknown."""
    return oracle_choice(name, scenario)


def baseline_size(choice: Choice) -> int | None:
    """N of the baselines beside a choice: its own, or that of the rule of thumb if that is larger; None without.

    With fewer members than the choice a baseline would lose by their number alone.
    """
    kind = filter_type(choice.name)
    if not kind.has_ensemble:
        return None
    usual = ensemble_sizes_of(kind).untuned
    return max(usual, choice.numbers.get("ensemble_size", usual))


@lru_cache(maxsize=64)
def scaled_default(name: str, scenario: Problem, seed: int = 0, ensemble_size: int | None = None) -> Scaled:
    """The rule of thumb with one factor on its Q, so that the mean NIS on the training runs is as expected.

        mean of nu' S(c Q, R)^-1 nu over runs and scored steps = m,  solved for log c

    An engineer would do the same after one look at the innovations. R is unchanged. The runs are the training runs
    of a study with this seed, with the same random numbers for each c, so the same arguments give the same factor.

    Args:
        name: name of the filter.
        scenario: generates the training runs, and defines the model that the filter assumes.
        seed: seed of the study.
        ensemble_size: with which the factor is found; that of the rule of thumb if None.

    Returns:
        The choice with its factor and mean NIS; or the reason why there is none: the filter has no NIS, or no
        factor from 1e-4 to 1e4 brings its mean NIS to 1. (Any tuned filter is far better than such a baseline.)
    """
    if not rule_of_thumb(name, scenario).filter(scenario).has_covariance:
        return Scaled(None, None, None, f"{name} has no NIS by which its Q could be scaled")
    data = data_of(scenario, scenario.training_seeds(seed, TRAINING_SEEDS))
    rule, right = _with_size(rule_of_thumb(name, scenario), ensemble_size), 1.0

    def nis_at(factor: float) -> float:
        nonlocal right
        evaluation = values_of(scaled_rule(rule, scenario, factor).filter(scenario), data, scenario.scale)
        ratio, right = nis_ratio(evaluation), evaluation.expected_nis
        return ratio if 0.0 < ratio < LARGEST else LARGEST

    def fails(factors: str, ends: str) -> Scaled:
        return Scaled(None, None, None, f"{factors} brings the mean NIS of {name} to {right:.3g}: it {ends}")

    def excess(exponent: float) -> float:
        return math.log(nis_at(10.0**exponent))

    first, exponent = excess(0.0), 0
    if not np.any(scenario.model(**rule.model).process_noise_cov):
        return fails("no factor on a Q of zero", f"is {right * math.exp(first):.3g}")
    step = 1 if first > 0 else -1  # a larger Q lowers the NIS
    last = first
    while last * first > 0 and abs(exponent) < DECADES:
        exponent += step
        last = excess(exponent)
    if last * first > 0:
        ends = [f"{right * math.exp(end):.3g}" for end in (first, last)]
        factors = f"no factor on Q from {10.0**-DECADES:g} to {10.0**DECADES:g}"
        return fails(factors, f"is {ends[0]} with a factor of 1 and {ends[1]} with {10.0**exponent:g}")
    from scipy.optimize import brentq  # loads half of SciPy, for this line

    root = brentq(excess, *sorted((exponent - step, exponent)), xtol=1e-3, rtol=1e-3) if exponent else 0.0
    factor = float(f"{10.0**root:.{DIGITS}g}")
    nis = nis_at(factor)
    if abs(nis - 1.0) > CLOSE:
        return fails("no factor on Q", f"jumps to {right * nis:.3g} with {factor:g}")
    return Scaled(scaled_rule(rule, scenario, factor), factor, nis)


def scaled_rule(rule: Choice, scenario: Problem, factor: float) -> Choice:
    """A rule of thumb with a factor on its Q; of a problem's own parameters those that are `nearest` to that."""
    larger = scaled(_with_noise(rule, scenario), factor)
    if scenario.parameters is None:
        return larger
    model = scenario.model(**larger.model)
    parameters = nearest(scenario, model.process_noise_cov, model.measurement_noise_cov)
    return rule._replace(model={**rule.model, **parameters})


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


def _with_size(choice: Choice, ensemble_size: int | None) -> Choice:
    return choice if ensemble_size is None else choice.with_size(ensemble_size)


def baselines(
    name: str, scenario: Problem, seed: int = 0, default: Scaled | None = None, ensemble_size: int | None = None
) -> dict[str, Choice]:
    """All existing baselines of a filter by name, the most important one first.

    If the model's given values are the rule of thumb, there is one baseline for both, called "given".

    Args:
        name: name of the filter.
        scenario: the problem.
        seed: of the study.
        default: the scaled default with this seed and N; computed if None.
        ensemble_size: N of all of them, `baseline_size` beside a choice; that of the rule of thumb if None.
    """
    scaled = (scaled_default(name, scenario, seed, ensemble_size) if default is None else default).choice
    choices = {GIVEN: given_noise(name, scenario), SCALED: scaled, RULE: rule_of_thumb(name, scenario)}
    if choices[GIVEN] is not None and rule_label(scenario) == GIVEN:
        del choices[RULE]
    choices |= {NOISE: noise_estimated(name, scenario, seed), ORACLE: oracle(name, scenario)}
    return {key: _with_size(choice, ensemble_size) for key, choice in choices.items() if choice is not None}


def competing_baselines(
    name: str, scenario: Problem, seed: int = 0, ensemble_size: int | None = None
) -> dict[str, Choice]:
    """The baselines that trials compete with: all but the oracle, whether it is called so or "given".

    A model that came with the plant's own Q and R is compared with, held out, but a study does not know them.
    """
    choices = baselines(name, scenario, seed, ensemble_size=ensemble_size)
    known = choices.pop(ORACLE, None)
    if known is not None and RULE in choices and GIVEN in choices and same_filter(choices[GIVEN], known):
        del choices[GIVEN]
    return choices


def same_filter(a: Choice, b: Choice) -> bool:
    """Whether two choices are the same filter."""
    return a.name == b.name and _same_values(a.model, b.model) and _same_values(a.numbers, b.numbers)


def _same_values(a: Mapping, b: Mapping) -> bool:
    return a.keys() == b.keys() and all(np.array_equal(a[key], b[key]) for key in a)


def is_far_below(gained: Interval) -> bool:
    """Whether a filter predicts far worse than the regression: significantly, and by more than `FAR`."""
    return bool(gained.high < 0.0 and gained.value < -FAR)


def log_densities(training: Data, data: Data, angles: np.ndarray) -> np.ndarray:
    """Log density of each measurement given all before it, by least squares for each channel, (B, K + 1, m).

        z_k,i = a + sum over l = 1..p of (b_l z_{k-l} + c_l u_{k-l}) + sum over j < i of d_j z_k,j + e
        e ~ N(0, s^2)

    A channel that is not measured has its last value. The least BIC on the training runs chooses p. Where a run
    has no p rows yet, the density is that of the training runs' mean and variance. NaN where nothing is measured;
    everywhere if the training runs have too few rows.

    Args:
        training: runs for the fit.
        data: runs whose densities are returned.
        angles: (m,) bool, which channels are angles.
    """
    observed, m = training.seen, training.measurements.shape[-1]
    (z_mean, z_std), (u_mean, u_std) = map(_mean_and_std, (observed.measurements, observed.inputs))

    def rows_of(runs: Data) -> list[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        z, u = _continued(runs.seen.measurements, angles), runs.seen.inputs
        z, u = (z - z_mean) / z_std, (u - u_mean) / u_std
        return [
            (_past(z_run, u_run), z_run, ~np.isnan(measured))
            for z_run, u_run, measured in zip(z, u, runs.seen.measurements, strict=True)
        ]

    known, rows, densities = rows_of(training), rows_of(data), np.full(data.measurements.shape, np.nan)
    for i in range(m):
        regression = _fitted(known, i)
        if regression is None:
            return np.full(densities.shape, np.nan)
        columns, weights, variance = regression
        for b, (past, z, measured) in enumerate(rows):
            expected = np.hstack([past, z[:, :i]])[:, columns] @ weights
            begun = np.isfinite(expected)
            squares = np.where(begun, (z[:, i] - expected) ** 2 / variance, z[:, i] ** 2)
            logarithm = math.log(2.0 * math.pi * z_std[i] ** 2) + np.where(begun, math.log(variance), 0.0)
            densities[b, :, i] = np.where(measured[:, i], -0.5 * (logarithm + squares), np.nan)
    return densities


def _mean_and_std(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and standard deviation of each column of values (B, T, n); 0 and 1 where there is neither."""
    known = np.isfinite(values)
    counts = np.maximum(known.sum(axis=(0, 1)), 1)
    mean = np.where(known, values, 0.0).sum(axis=(0, 1)) / counts
    std = np.sqrt((np.where(known, values - mean, 0.0) ** 2).sum(axis=(0, 1)) / counts)
    return mean, np.where(std > 0.0, std, 1.0)


def _continued(z: np.ndarray, angles: np.ndarray) -> np.ndarray:
    """Measurements (B, T, m), the last value where one is missing, NaN before the first; angles without jumps."""
    times = np.where(np.isnan(z), -1, np.arange(z.shape[1])[:, None])
    last = np.maximum.accumulate(times, axis=1)
    continued = np.where(last < 0, np.nan, np.take_along_axis(z, np.maximum(last, 0), axis=1))
    for i in np.flatnonzero(angles):
        continued[..., i] = np.where(last[..., i] < 0, np.nan, np.unwrap(np.nan_to_num(continued[..., i]), axis=1))
    return continued


def _past(z: np.ndarray, u: np.ndarray) -> np.ndarray:
    """1, then z and u of the last rows, (T, 1 + 8 (m + p)), from z (T, m) and u (T - 1, p); NaN before these."""
    lagged = np.full((len(z), ORDERS[-1], z.shape[1] + u.shape[1]), np.nan)
    for lag in range(1, ORDERS[-1] + 1):
        lagged[lag:, lag - 1] = np.hstack([z[:-lag], u[: max(len(u) + 1 - lag, 0)]])
    return np.hstack([np.ones((len(z), 1)), lagged.reshape(len(z), -1)])


def _fitted(runs: list, i: int) -> tuple[list[int], np.ndarray, float] | None:
    """Columns, weights and residual variance of the regression of channel i; None if there are too few rows."""
    parts, count = [], 0
    for past, z, measured in runs:
        rows = np.hstack([past, z[:, : i + 1]])
        parts.append(rows[np.isfinite(rows).all(axis=1) & measured[:, i]])
        count += parts[-1].size
        if count > MOST_NUMBERS:
            break
    rows = np.concatenate(parts)
    width, best = (rows.shape[1] - 2 - i) // ORDERS[-1], None
    if len(rows) == 0:
        return None
    # Sums of squares of all these regressions are those of the triangle's columns.
    triangle: Any = np.linalg.qr(rows, mode="r")
    for order in ORDERS:
        columns = [*range(1 + order * width), *range(rows.shape[1] - 1 - i, rows.shape[1] - 1)]
        if len(rows) < FEWEST * len(columns):
            break
        weights = np.linalg.lstsq(triangle[:, columns], triangle[:, -1], rcond=1e-10)[0]
        squares = ((triangle[:, columns] @ weights - triangle[:, -1]) ** 2).sum()
        variance = max(squares / (len(rows) - len(columns)), LEAST_VARIANCE)
        bic = len(rows) * math.log(variance) + len(columns) * math.log(len(rows))
        if best is None or bic < best[0]:
            best = bic, columns, weights, float(variance)
    return None if best is None else best[1:]
