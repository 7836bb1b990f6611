"""Named models of a column of numbers by maximum likelihood, with intervals, and the choice among them.

What counts are the innovations of a Kalman filter that begins without a prior. The record is cut into blocks: each
candidate is fitted once without the even ones and once without the odd ones, and compared by the likelihood of the
blocks that it did not see. Of the candidates that are not significantly worse than the best, the simplest is
chosen. An interval has the values at which the likelihood, with all other numbers at their likeliest, is within
e^-1.92 of its maximum, of a short record a little less.

Sources: Harvey (1989), Forecasting, Structural Time Series Models and the Kalman Filter, section 3.4; Durbin and
Koopman (2012), Time Series Analysis by State Space Methods, sections 5.2 and 7.2, for starts without a prior;
Pawitan (2001), In All Likelihood, section 2.6, for intervals.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import product
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from filters.engine.batch import Estimates, run
from filters.gaussian.kalman import KalmanFilter
from filters.models import Scales, Sum, named_model
from filters.signals import Signal
from thruster_env.core.streams import filter_keys
from thruster_env.model.affine import AffineModel
from tuning.likelihood.ascent import Ascent, climb
from tuning.series.column import Column
from tuning.series.likelihood import ColumnLikelihood
from tuning.series.recursion import Beginning, StepTables, filtered_runs

CANDIDATES = (
    "constant",
    "constant-velocity",
    "ornstein-uhlenbeck",
    "local-trend",
    "constant-acceleration",
    "oscillator",
)
BLOCKS = 20  # of the record, of which half are unseen at a time
EVIDENCE = 3.0  # log-likelihood by which a simpler model may always be behind the best one
OF_RETURN = 0.5 * 2.86**2  # the same of a walk behind a model that returns to the mean: Dickey and Fuller's 5 %
MOST_ROWS = 10_000  # on which models are compared
SHARES = 0.01, 0.2, 0.9  # R from which searches begin, in squares of the roughness
SEARCHES = 3
EXACT = 1e-8  # predicted rise of the log-likelihood at which the last search ends
NOISE = "variance of the measurement noise"
LEAST_DEGREES = 8.0  # of freedom, of Student's distribution
LINEAR = 0.01  # root of a fall less that of an end, from which on the profile is a line
FAR = 100.0  # root of a fall where the filter has no likelihood
PRECISION = 0.01  # of an interval's end, in coordinates, at most
NORMAL = 0.03  # standard error, in coordinates, below which the likelihood of a long record is normal
CHANCE = 0.05  # of the highest peak among those of noise


class Candidate(NamedTuple):
    """A named model with its likeliest numbers.

    Attributes:
        name: of the model.
        values: of the free numbers, and R.
        log_likelihood: of the rows that it was fitted on.
        held_out: log-likelihoods of blocks that it was not fitted on, (blocks,).
        in_sample: of all these blocks, fitted on all.
        size: how simple it is: free numbers, then states.
    """

    name: str
    values: dict[str, float]
    log_likelihood: float
    held_out: np.ndarray
    in_sample: float
    size: tuple[int, int]


class Fitted(NamedTuple):
    """A model's maximum of the likelihood, and the function that it is the maximum of."""

    model: Sum
    objective: ColumnLikelihood
    ascent: Ascent
    rivals: tuple[Ascent, ...]  # maxima to which searches led from elsewhere, perhaps the same one
    held_out: np.ndarray = np.zeros(BLOCKS - 1)  # (blocks,)
    in_sample: float = 0.0

    @property
    def mean(self) -> np.ndarray | None:
        """The mean about which the signal of each axis varies, (axes,), if it does."""
        return self.objective.level(self.ascent.at) if self.model.about_mean else None

    @property
    def candidate(self) -> Candidate:
        """What is left of it for the answer: plain data."""
        values = self.objective.coordinates.named(self.ascent.at)
        size = len(self.model.free), self.objective.states
        return Candidate(self.model.name, values, self.ascent.found.value, self.held_out, self.in_sample, size)


class Number(NamedTuple):
    """A number of the model with its 95 % interval."""

    name: str
    meaning: str
    value: float
    low: float
    high: float
    unit: str
    determined: bool  # False where an end of the interval is an end of the range


class Choice(NamedTuple):
    """The chosen model, all candidates, best first, and the chosen one's numbers."""

    chosen: Candidate
    candidates: tuple[Candidate, ...]
    numbers: tuple[Number, ...]
    level: np.ndarray | None  # the mean about which the signal of each axis varies, (axes,), if it does


def choose(
    column: Column,
    names: Sequence[str],
    progress: Callable[[str], None] = lambda name: None,
    further: Callable[[Candidate, np.ndarray | None], Sequence[str]] | None = None,
) -> Choice:
    """Fit named models and choose one: the simplest of those that are not significantly worse than the best.

    A record of more than `MOST_ROWS` rows is compared on its middle; the numbers are those of all rows.

    Args:
        column: the numbers.
        names: of the models, as `filters.models.named_model` takes them.
        progress: called with each name before it is fitted.
        further: names of models to be tried, too, by the chosen one and its mean, because it misses something.

    Raises:
        ValueError: for an unknown model, or one that has no likelihood.
    """
    models = [named_model(name) for name in names]
    column.check_noise()
    part, fitted = column.middle(MOST_ROWS), list[Fitted]()
    for again in (False, True):
        for model in models:
            progress(model.name)
            fitted.append(_fit(model, part, prove=len(names) > 1 or further is not None))
        fitted.sort(key=lambda result: -result.held_out.sum())
        candidates = tuple(result.candidate for result in fitted)
        tied = [i for i, candidate in enumerate(candidates) if _ties(candidate, candidates[0], len(part.values))]
        chosen = fitted[min(tied, key=lambda i: candidates[i].size)]
        if again or further is None:
            break
        models = [named_model(name) for name in further(chosen.candidate, chosen.mean)]
    if part is not column:
        progress(f"{chosen.model.name} on all rows")
        chosen = _on_all(chosen, column)
    return Choice(chosen.candidate, candidates, _numbers(chosen, column), chosen.mean)


def _fit(candidate: Sum, column: Column, *, prove: bool) -> Fitted:
    """The candidate with the likeliest numbers, and its likelihood on blocks that it was not fitted on.

    The first block counts for no candidate: there each filter still learns its state, one with few states sooner.
    """
    fitted = most_likely(candidate, column)
    if not prove:
        return fitted
    counts = np.cumsum(column.measured.any(axis=1))  # so that each block has as many rows with numbers
    blocks = np.maximum(counts - 1, 0) * BLOCKS // counts[-1]
    held_out, everything = np.empty(BLOCKS), ColumnLikelihood(candidate, column, rows=len(column.values))
    in_sample = float(everything.by_rows(fitted.ascent.at)[blocks > 0].sum())
    for fold in range(2):
        visible = replace(column, values=np.where((blocks % 2 == fold)[:, None], np.nan, column.table))
        values = most_likely(candidate, visible, column.scales).candidate.values
        densities = everything.by_rows(everything.coordinates.of(list(values.values())))
        held_out[fold::2] = np.bincount(blocks, weights=densities.sum(axis=1), minlength=BLOCKS)[fold::2]
    return fitted._replace(held_out=held_out[1:], in_sample=in_sample)


def most_likely(candidate: Sum, column: Column, scales: Scales | None = None) -> Fitted:
    """The candidate with the likeliest numbers for a column; of a part of one with the scales of that."""
    scales = scales or column.scales
    objective = ColumnLikelihood(candidate, column, scales=scales)
    ascents = [climb(objective, at) for at in _starts(objective, candidate, scales)]
    ascent = climb(objective, max(ascents, key=lambda end: end.found.value).at, enough=EXACT)
    if not math.isfinite(ascent.found.value):
        rule = f"{candidate.name} must have a likelihood on the data, but has none from any start"
        raise ValueError(f"{rule}: data that a model predicts to the last digit have neither Q nor R")
    return Fitted(candidate, objective, ascent, tuple(ascents))


def _on_all(chosen: Fitted, column: Column) -> Fitted:
    """A candidate that was fitted on a part of the record, on the whole of it."""
    objective = ColumnLikelihood(chosen.model, column)
    begin = objective.coordinates.of(list(chosen.candidate.values.values()))
    return chosen._replace(objective=objective, ascent=climb(objective, begin), rivals=())


def filtered(signal: Signal, model: AffineModel, column: Column) -> Estimates:
    """The estimates of the Kalman filter on a column, with the F and Q of each step's length.

    Args:
        signal: of one axis, of which the model is the one for the usual step.
        model: of all axes.
        column: the numbers.
    """
    if column.stamps is None:
        inputs = np.zeros((1, len(column.values) - 1, 0))
        return run(KalmanFilter(model=model), filter_keys([0]), inputs, column.table[None])
    axes, n, r = model.m, len(signal.output), float(model.measurement_noise_cov[0, 0])
    dts, index = np.unique(np.diff(column.stamps), return_inverse=True)
    f, noises = signal.steps(signal.slope, dts, column.dt)
    q = np.tensordot(np.diag(signal.densities)[list(signal.driven)], noises, 1)
    tables = StepTables(f, q, np.empty((0, 0, n, n)), np.empty((0, *q.shape)), np.empty(0))
    prior_covs = np.tile(model.prior_cov[:n, :n].ravel(), (axes, 1))
    priors = np.concatenate([model.prior_mean.reshape(axes, n), prior_covs], axis=1)
    begin = Beginning(np.zeros(axes), True, priors, np.empty((axes, 0, n + n * n)), np.zeros(axes))
    z, rows = (column.table - model.matrices()[4]).T, np.tile(np.append(0, index), (axes, 1))
    sums = filtered_runs(z, rows, tables, signal.output, r, np.empty(0), begin, each_row=True)
    v, s = sums.innovations[..., 0].T, np.maximum(sums.innovations[..., 1].T, r)  # less is a wide prior's rounding
    of_axes = sums.beliefs[..., n:].reshape(axes, -1, n, n)
    variances = np.einsum("i,akij,j->ka", signal.output, of_axes, signal.output) + r  # S without a measurement
    densities = -0.5 * (np.log(2.0 * math.pi * s) + v**2 / s)
    each, covs, all_s = np.arange(axes), np.zeros((len(v), axes, n, axes, n)), np.zeros((len(v), axes, axes))
    covs[:, each, :, each, :], all_s[:, each, each] = of_axes, np.where(np.isnan(s), variances, s)
    return Estimates(
        np.moveaxis(sums.beliefs[..., :n], 0, 1).reshape(1, len(v), axes * n),
        covs.reshape(1, len(v), axes * n, axes * n),
        np.nan_to_num(v)[None],
        all_s[None],
        np.nan_to_num(densities).sum(axis=1)[None],
        np.zeros(1),
    )


def _starts(objective: ColumnLikelihood, candidate: Sum, scales: Scales) -> list[np.ndarray]:
    """Points from which searches begin, of all combinations of values and shares of noise in the roughness.

    Each is scaled to its largest likelihood. They are the likeliest ones that differ in the first number: a
    likelihood may have several maxima along it.
    """
    first, *further = (number.values(scales) for number in candidate.free)
    noise = [share * scales.roughness**2 for share in SHARES]
    best = []
    for value in first:
        points = [objective.coordinates.of(point) for point in product([value], *further, noise)]
        best.append(max((objective.scaled(point) for point in points), key=lambda scaled: scaled[0]))
    return [at for _, at in sorted(best, key=lambda scaled: scaled[0])[-SEARCHES:]]


def behind(candidate: Candidate, best: Candidate) -> tuple[float, float]:
    """How much lower a candidate's likelihood on unseen blocks is, and the standard error of that."""
    if not np.isfinite(candidate.held_out).all():
        return math.inf, 0.0
    differences = best.held_out - candidate.held_out
    return float(differences.sum()), float(np.std(differences, ddof=1) * math.sqrt(len(differences)))


def _ties(candidate: Candidate, best: Candidate, rows: int) -> bool:
    """Whether a candidate's likelihood is as good as the best one's, on unseen blocks and on all with its size.

    Each fit to half of the blocks tells weak signals from noise less well than one to all of them, so Schwarz's
    criterion decides, too; of a frequency that is searched with the chance that it is the highest of noise.

    Sources: Breiman, Friedman, Olshen, Stone (1984), Classification and Regression Trees, section 3.4.3, for the
    standard error; Schwarz (1978), "Estimating the dimension of a model", Annals of Statistics 6(2); Kass, Raftery
    (1995), "Bayes factors", Journal of the American Statistical Association 90(430), for the evidence below which
    no model is preferred; Dickey, Fuller (1979), "Distribution of the estimators for autoregressive time series
    with a unit root", ibid. 74(366): a walk seems to return to the mean of its record.
    """
    loss, error = behind(candidate, best)
    model = named_model(best.name)
    returns = model.about_mean and not named_model(candidate.name).about_mean
    least = OF_RETURN if returns else EVIDENCE
    if any(number.is_searched for number in model.free):
        least = max(least, math.log(0.5 * rows / CHANCE))
    by_size = 0.5 * (best.size[0] - candidate.size[0]) * math.log(rows)
    return (
        loss <= max(error, OF_RETURN if returns else EVIDENCE)
        and best.in_sample - candidate.in_sample <= max(by_size, 0.0) + least
    )


def _numbers(fitted: Fitted, column: Column) -> tuple[Number, ...]:
    """Values with intervals by the profile of the likelihood."""
    coordinates, best = fitted.objective.coordinates, fitted.ascent
    meanings = {number.name: number.meaning for number in fitted.model.free}
    ends = np.array(
        [
            [_end(fitted, index, limits[index]) for index in range(len(best.at))]
            for limits in (coordinates.low, coordinates.high)
        ]
    )
    for part, is_size in _chance_peaks(fitted, column):
        ends[0, part] = coordinates.low[part]
        ends[1, part] = np.where(is_size, ends[1, part], coordinates.high[part])
    inside = (ends[0] > coordinates.low) & (ends[1] < coordinates.high)
    values, low, high = (coordinates.values(at) for at in (best.at, *ends))
    rows = zip(coordinates.free, values.tolist(), low.tolist(), high.tolist(), inside.tolist(), strict=True)
    return tuple(
        Number(number.name, meanings.get(number.name, NOISE), value, least, most, number.unit, known)
        for number, value, least, most, known in rows
    )


def _chance_peaks(fitted: Fitted, column: Column) -> list[tuple[slice, list[bool]]]:
    """Parts whose frequency may be that of a peak of noise: their numbers, and which of these are sizes.

    The data determine no such frequency, nor damping, nor more than the largest size. Of m frequencies, noise
    alone gains log(m/0.05) in log-likelihood at one of them with a chance of 5 %.

    Source: Davies (1987), "Hypothesis testing when a nuisance parameter is present only under the alternative",
    Biometrika 74(1).
    """
    parts, first, column = [], 0, column.middle(MOST_ROWS)
    for part in fitted.model.parts:
        numbers, first = slice(first, first + len(part.free)), first + len(part.free)
        if not any(number.is_searched for number in part.free):
            continue
        rest = tuple(other for other in fitted.model.parts if other is not part)
        without = (
            most_likely(Sum(" + ".join(other.name for other in rest), rest), column) if rest else _white(column)
        )
        densities = [
            ColumnLikelihood(model, column, rows=len(column.values)).by_rows(at)
            for model, at in ((fitted.model, fitted.ascent.at), (without.model, without.ascent.at))
        ]
        both = (densities[0] != 0.0) & (densities[1] != 0.0)
        if (densities[0] - densities[1])[both].sum() < math.log(0.5 * both.sum() / CHANCE):
            parts.append((numbers, ["U" in number.unit for number in part.free]))
    return parts


def _fall(fitted: Fitted, index: int, cov: np.ndarray) -> float:
    """The fall of the log-likelihood at the ends of a 95 % interval: t^2/2, with t of Student's distribution.

    A variance has as many degrees of freedom as independent squares would determine it equally well: 2 over the
    variance of its logarithm. The other numbers of a signal have those of its size.
    """
    powers, first = fitted.objective.amplitude, 0
    sizes = [len(powers) - 1]  # of R
    for part in fitted.model.parts:
        numbers, first = range(first, first + len(part.free)), first + len(part.free)
        if index in numbers:
            sizes = [j for j in numbers if powers[j] > 0.0]
    degrees = [2.0 * powers[j] ** 2 / max(float(cov[j, j]), 1e-12) for j in sizes]
    return 0.5 * float(stdtrit(max(min(degrees), LEAST_DEGREES), 0.975)) ** 2


def _white(column: Column) -> Fitted:
    """A level that stays, with white noise."""
    model = named_model("constant")
    objective = ColumnLikelihood(model, column)
    low, high = objective.coordinates.low, objective.coordinates.high
    ascent = climb(objective, np.array([low[0], high[1]]), fixed=np.array([True, False]))
    return Fitted(model, objective, ascent, ())


def _end(fitted: Fitted, index: int, limit: float) -> float:
    """The coordinate towards `limit` from which on the profile has fallen by `_fall`, or the limit.

    The search begins from the outermost maximum that is as likely: a profile may have several.
    """
    objective, best = fitted.objective, fitted.ascent
    coordinates, fixed = objective.coordinates, np.arange(len(best.at)) == index
    ends = coordinates.low[index], coordinates.high[index]
    cov = np.linalg.pinv(best.found.information)
    most = _fall(fitted, index, cov)
    likely = [best, *(rival for rival in fitted.rivals if best.found.value - rival.found.value < most)]
    outermost = min(likely, key=lambda maximum: abs(limit - maximum.at[index]))
    first, at = float(outermost.at[index]), outermost.at

    @cache
    def beyond(coordinate: float) -> float:
        """The root of the fall, nearly linear in the coordinate, less that of an end."""
        nonlocal at
        start = np.where(fixed, coordinate, at)
        profile = climb(objective, start, fixed=fixed, iterations=15)
        fall = best.found.value - profile.found.value
        if not math.isfinite(fall):
            return FAR
        at = profile.at
        return math.sqrt(max(fall, 0.0)) - math.sqrt(most)

    deviation = math.sqrt(max(float(cov[index, index]), 0.0))
    if 0.0 < deviation < NORMAL and objective.counted > MOST_ROWS:
        return float(np.clip(first + math.copysign(math.sqrt(2.0 * most) * deviation, limit - first), *ends))
    reach, outer = min(max(2.0 * deviation, PRECISION), 3.0), first
    precision = min(PRECISION, 0.05 * deviation or PRECISION)
    while outer != limit and beyond(outer) < 0.0:
        inner, outer = outer, min(first + reach, limit) if limit > first else max(first - reach, limit)
        if beyond(outer) > 0.0:
            return _root(beyond, inner, outer, precision)
        reach *= 2.0
    return outer


def _root(function: Callable[[float], float], below: float, above: float, precision: float) -> float:
    """Where a nearly linear function is zero, between points where it is negative and where it is positive."""
    low, high = function(below), function(above)
    while abs(above - below) > precision:
        share = min(max(low / (low - high), 0.1), 0.9)  # of the way, so that both ends move
        middle = below + share * (above - below)
        value = function(middle)
        if value < 0.0:
            below, low = middle, value
        else:
            above, high = middle, value
        if abs(value) < LINEAR:
            return middle - value * (above - below) / (high - low)
    return below + low / (low - high) * (above - below)
