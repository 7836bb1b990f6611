"""The result of identification: values, standard errors, and which parameters the data determine."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from tuning.identification.ascent import Ascent
from tuning.identification.gates import lost_information
from tuning.identification.null_tests import NullTest
from tuning.identification.objective import Objective
from tuning.likelihood.identifiability import COMPANION, KNOWN_WITHIN, TWO_SIDED
from tuning.problems.parameter import Coordinates

WIDEST = 0.5  # largest part of its range that the 95 % interval of a determined parameter may take
TRADED = 0.95  # correlation from which two parameters are reported to trade off
EQUAL = 0.25  # standard errors within which the determined parameters of two equal optima lie ...
EQUAL_VALUES = 0.01  # ... or difference of their log-likelihoods
LEVEL = 0.05  # of a test above which the data are as likely without a parameter
MOST_RUNS = 8  # whose numbers a sentence has


class Optimum(NamedTuple):
    """The result of one start."""

    start: dict[str, float]
    values: dict[str, float]
    log_likelihood: float
    iterations: int
    converged: bool


class Identification(NamedTuple):
    """The most likely values of p free parameters; covariances are in `objective.coordinates`."""

    names: tuple[str, ...]
    values: dict[str, float]
    start: dict[str, float]
    standard_errors: dict[str, float]  # of the values
    cov: np.ndarray  # (p, p)
    at: np.ndarray  # (p,), coordinates
    at_end: dict[str, bool]  # whether a value is at an end of its range
    determined: dict[
        str, bool
    ]  # by `is_narrow`, not at an end of the range, and zero is outside the 95 % interval
    log_likelihood: float
    start_log_likelihood: float
    optima: tuple[Optimum, ...]  # one for each start
    objective: Objective
    interrupted: bool
    seconds: float
    narrow: Mapping[str, bool] = {}  # `is_narrow`
    null_tests: Mapping[str, NullTest] = {}  # of each parameter against leaving it out; empty without

    @property
    def correlations(self) -> np.ndarray:
        """Correlations of the estimates, (p, p)."""
        scale = np.sqrt(np.diag(self.cov))
        return self.cov / np.outer(scale, scale)

    @property
    def agreement(self) -> int:
        """Number of starts that led to the best maximum, by log L or by all determined parameters."""
        coordinates, scale, near = self.objective.coordinates, np.sqrt(np.diag(self.cov)), 0
        best = max(self.optima, key=lambda optimum: optimum.log_likelihood)
        known = np.array([self.determined[name] for name in self.names])
        top = coordinates.of(list(best.values.values()))
        for optimum in self.optima:
            apart = np.abs(coordinates.of(list(optimum.values.values())) - top)
            close = best.log_likelihood - optimum.log_likelihood < EQUAL_VALUES
            near += bool(close or (known.any() and (apart < EQUAL * scale)[known].all()))
        return near

    @property
    def begun_elsewhere(self) -> tuple[int, ...]:
        """Places of the runs that do not begin as the model's prior says."""
        starts = self.objective.starts
        return () if starts is None else tuple(np.flatnonzero(starts.free).tolist())

    @property
    def left_out(self) -> int:
        """Number of samples that were left out as outliers."""
        return int(np.sum(getattr(self.objective.data, "outliers", 0)))

    @property
    def evaluations(self) -> int:
        """Number of evaluations of likelihood and gradient, for all starts together."""
        return self.objective.evaluations

    @property
    def traded(self) -> list[tuple[str, str, float]]:
        """Pairs of parameters that trade off, with their correlation."""
        correlations = self.correlations
        pairs = [(i, j) for i in range(len(correlations)) for j in range(i) if abs(correlations[i, j]) >= TRADED]
        return [(self.names[j], self.names[i], float(correlations[i, j])) for i, j in pairs]

    @property
    def least_determined(self) -> dict[str, float]:
        """The least determined direction: signed standard errors of its parameters, as fractions of their ranges.

        Parameters with less than a fifth of the largest component are left out.
        """
        width = self.objective.coordinates.high - self.objective.coordinates.low
        variances, axes = np.linalg.eigh(self.cov / np.outer(width, width))
        axis = axes[:, -1] * np.sign(axes[np.argmax(np.abs(axes[:, -1])), -1]) * np.sqrt(variances[-1])
        order = [i for i in np.argsort(-np.abs(axis)) if abs(axis[i]) >= COMPANION * np.abs(axis).max()]
        return {self.names[i]: float(axis[i]) for i in order}

    def _end_sentences(self) -> list[str]:
        """Which values are at an end of their range; an end at zero, as of a dead band's width, is separate."""
        sentences, free = (
            [],
            [parameter for parameter in self.objective.coordinates.free if self.at_end[parameter.name]],
        )
        gone = [
            parameter.name
            for parameter in free
            if 0.0 in (parameter.low, parameter.high)
            and abs(self.values[parameter.name]) <= 1e-5 * (parameter.high - parameter.low)
        ]
        elsewhere = [parameter.name for parameter in free if parameter.name not in gone]
        if gone:
            sentences.append(f"At zero, where the range ends: {', '.join(gone)}. The data require none of them.")
        if elsewhere:
            sentences.append(f"At an end of the range: {', '.join(elsewhere)}. A wider one may fit better.")
        return sentences

    def _needless(self) -> list[str]:
        """The effects that the data do not require, by the tests."""
        tests = self.null_tests.items()
        needless = [f"{name} (p = {test.p:.2g})" for name, test in tests if test.is_zero and test.p > LEVEL]
        if not needless:
            return []
        return [
            f"The data are as likely without {', '.join(needless)}: leave them out unless you know that they are "
            "present."
        ]

    def _starts_sentence(self) -> str:
        """Which runs do not begin as the prior says."""
        indices, starts = self.begun_elsewhere, self.objective.starts
        leads = () if starts is None else starts.leads
        numbers = ", ".join(str(index + 1) for index in indices[:MOST_RUNS])
        numbers += ", ..." if len(indices) > MOST_RUNS else ""
        rows = sorted({int(leads[index]) for index in indices})
        count = f"{rows[0]}" if len(rows) == 1 else f"{rows[0]} to {rows[-1]}"
        which = (
            f"Run {numbers} does" if len(indices) == 1 else f"{len(indices)} of {len(leads)} runs ({numbers}) do"
        )
        consequence = f"the first {count} rows only determine the initial state and are not scored"
        return f"{which} not begin as the model's prior says: {consequence}."

    def sentences(self) -> list[str]:
        """Sentences on which parameters the data determine."""
        sentences = []
        ends = [name for name in self.names if self.at_end[name]]
        loose = [name for name in self.names if not self.determined[name] and not self.at_end[name]]
        wide = [name for name in loose if not self.narrow[name]]
        zero = [name for name in loose if self.narrow[name]]
        if not ends and not loose:
            sentences.append("The data determine every free parameter.")
        if wide:
            rule = "a 95 % interval is as wide as a factor of ten, or as half the range"
            sentences.append(f"The data do not determine {', '.join(wide)}: {rule}.")
        if zero:
            sentences.append(
                f"The data do not distinguish {', '.join(zero)} from zero, which lies in a 95 % interval."
            )
        sentences += self._end_sentences() + self._needless()
        for first, second, correlation in self.traded:
            sentences.append(f"{first} and {second} trade off (correlation {correlation:.3f}).")
        if len(self.least_determined) > 1 and wide:
            parts = ", ".join(f"{name} {part:+.2g}" for name, part in self.least_determined.items())
            sentences.append(
                f"Least determined is a change of several together (as fractions of the ranges): {parts}."
            )
        if len(self.optima) > 1:
            sentences.append(f"{self.agreement} of {len(self.optima)} starts reached this maximum.")
        if self.begun_elsewhere:
            sentences.append(self._starts_sentence())
        if self.left_out:
            sentences.append(f"{self.left_out} samples beyond the gate were left out.")
        if self.interrupted:
            sentences.append("Interrupted: the best so far.")
        return sentences


def identification_of(
    objective: Objective,
    first: np.ndarray,
    best: Ascent,
    optima: tuple[Optimum, ...],
    tests: Mapping[str, NullTest] | None = None,
    *,
    interrupted: bool,
    seconds: float,
) -> Identification:
    """The result at the best maximum, with standard errors and which parameters are determined."""
    coordinates, at = objective.coordinates, best.at
    width = coordinates.high - coordinates.low
    cov, _ = covariances_of(objective, best)
    errors = np.sqrt(np.diag(cov))
    ends = (at <= coordinates.low + 1e-6 * width) | (at >= coordinates.high - 1e-6 * width)
    natural, values = errors * np.abs(coordinates.slopes(at)), coordinates.values(at)
    narrow, not_zero = is_narrow(cov, coordinates), np.abs(values) > TWO_SIDED * natural
    names = coordinates.names

    def by_name(values) -> dict:
        return dict(zip(names, np.asarray(values).tolist(), strict=True))

    return Identification(
        names=names,
        values=coordinates.named(at),
        start=coordinates.named(first),
        standard_errors=by_name(natural),
        cov=cov,
        at=at,
        at_end=by_name(ends),
        determined=by_name(narrow & ~ends & not_zero),
        narrow=by_name(narrow),
        log_likelihood=best.found.value,
        start_log_likelihood=objective.value(first),
        optima=optima,
        objective=objective,
        interrupted=interrupted,
        seconds=seconds,
        null_tests=tests or {},
    )


def covariances_of(objective: Objective, best: Ascent) -> tuple[np.ndarray, np.ndarray]:
    """Covariances (p, p) of the estimates at a maximum: as stated, and by Fisher's information alone.

    Both include the information lost with the samples beyond a gate (`gates.lost_information`).
    """
    width, lost = objective.coordinates.high - objective.coordinates.low, lost_information(objective.gate)
    information, scores = best.found.information, best.found.scores
    return lost * covariance(information, scores, width), lost * covariance(information, scores[:0], width)


def is_narrow(cov: np.ndarray, coordinates: Coordinates) -> np.ndarray:
    """Whether the 95 % interval of each parameter takes less than half its range, (p,) bool.

    On a logarithmic scale it must also be within a factor of ten, because the range of a variance is wide.
    """
    reach = TWO_SIDED * np.sqrt(np.diag(cov))
    known = ~coordinates.log | (reach < KNOWN_WITHIN)
    return known & (2 * reach < WIDEST * (coordinates.high - coordinates.low))


def covariance(information: np.ndarray, scores: np.ndarray, width: np.ndarray) -> np.ndarray:
    """Covariance of estimates (p, p): J^-1 (sum_b g_b g_b') J^-1, or J^-1 in directions where that is larger.

    J is the Fisher information, g_b the scores of B nearly independent runs, or of blocks where there are few
    runs. The first holds for a wrong model, too; the second is for directions in which the scatter is too small.
    In a direction on which the data have no information the standard deviation is larger than the range.

    Args:
        information: J, (p, p).
        scores: (B, p); fewer than two have no scatter.
        width: widths of the parameters' ranges, (p,), in the same coordinates.

    Source: Huber (1967), "The behavior of maximum likelihood estimates under nonstandard conditions".
    """
    scale = np.outer(width, width)
    values, axes = np.linalg.eigh(information * scale)
    values = np.maximum(values, 1.0 / 12.0)  # the prior: the variance of a uniform density is a twelfth
    if len(scores) < 2:
        return axes / values @ axes.T * scale
    along = scores * width @ axes / values
    along -= along.mean(axis=0)
    count = len(along)
    scatter = along.T @ along * (count / (count - 1))
    roots = 1.0 / np.sqrt(values)
    # In units of J's own errors: the larger of the two in each principal direction of the scatter.
    ratios, turns = np.linalg.eigh(scatter / np.outer(roots, roots))
    wide = turns * np.maximum(ratios, 1.0) @ turns.T * np.outer(roots, roots)
    return axes @ wide @ axes.T * scale
