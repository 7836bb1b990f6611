"""The result of identification: values, standard errors, and which parameters the data determine.

In order: likelihood-ratio tests of each free parameter against leaving it out; the result; and the file of
identified values, which commands take as the preset of `--model`:

    [values]            the model's arguments, named constants, Q11, Q22, ... and R11, ...
    [identified]        the origin of the values, for readers
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import finite, positive, short_repr
from thruster_env.core.files import as_toml, read_toml, write_whole
from thruster_env.logs.write import check_not_among
from thruster_env.model.continuous import noise_for_dt, same_dt
from thruster_env.model.state_space import StateSpaceModel
from tuning.likelihood.ascent import Ascent, climb
from tuning.likelihood.identifiability import COMPANION, KNOWN_WITHIN, TWO_SIDED
from tuning.likelihood.objective import Objective, lost_information
from tuning.likelihood.parametric import ModelFamily
from tuning.likelihood.recorded import CLOCK
from tuning.problems.problem import Coordinates

LEGS = 25  # iterations of the other parameters, at most
ROUNDS = 4  # of going on from a better place that a test has found, at most
BETTER = 1e-3  # rise in log-likelihood that counts as one
WIDEST = 0.5  # largest part of its range that the 95 % interval of a determined parameter may take
TRADED = 0.95  # correlation from which two parameters are reported to trade off
EQUAL = 0.25  # standard errors within which the determined parameters of two equal optima lie ...
EQUAL_VALUES = 0.01  # ... or difference of their log-likelihoods
LEVEL = 0.05  # of a test above which the data are as likely without a parameter
MOST_RUNS = 8  # whose numbers a sentence has
TABLES = ("values", "identified")


class NullTest(NamedTuple):
    """The likelihood of the runs with a parameter held at its null instead of free."""

    at: float  # zero where its range holds it, else where the search began
    is_zero: bool
    log_likelihood: float  # the largest with all other parameters free
    p: float  # probability of a fall at least as large, if that were the truth

    @property
    def said(self) -> str:
        """The probability, for a table."""
        return "< 0.001" if self.p < 1e-3 else f"{self.p:.2g}"


def null_of(coordinates: Coordinates, index: int, start: np.ndarray) -> tuple[float, bool]:
    """The coordinate at which a parameter is left out, and whether that is zero; otherwise it is the start."""
    parameter = coordinates.free[index]
    is_zero = not parameter.log and parameter.low <= 0.0 <= parameter.high
    return (0.0 if is_zero else float(start[index])), is_zero


def null_tests(
    objective: Objective,
    best: Ascent,
    start: np.ndarray,
    errors_of: Callable[[Ascent], tuple[np.ndarray, np.ndarray]],
    stop: Callable[[], bool],
) -> tuple[Ascent, dict[str, NullTest]]:
    """Hold each parameter at its null, maximise over the others, and compare; return the better maximum, too.

        D = 2 (log L - log L held)/lambda,  lambda = var(estimate)/(J^-1)

    is chi-squared with one degree of freedom if the null is true: with probability a half only, else zero, if the
    null is an end of the range. lambda is 1 where the model is right. If a search with a parameter held ends
    higher than the best one, the latter continues from there, and the tests start again.

    Args:
        objective: the log-likelihood.
        best: its maximum.
        start: coordinates (p,) of the start.
        errors_of: covariances (p, p) of the estimates at a maximum: those stated, and J^-1.
        stop: ends the tests, which are then none.

    Returns:
        The maximum, and the tests by name.

    Source: Kent (1982), "Robust properties of likelihood ratio tests", Biometrika 69(1); Chernoff (1954), "On the
    distribution of the likelihood ratio", for ends of ranges.
    """
    coordinates = objective.coordinates
    for _ in range(ROUNDS):
        cov, naive = errors_of(best)
        tests: dict[str, NullTest] = {}
        for index, name in enumerate(coordinates.names):
            if stop():
                return best, {}
            null, is_zero = null_of(coordinates, index, start)
            restricted = _held_at(objective, best, index, null, cov, stop)
            if restricted.found.value > best.found.value + BETTER:
                further = climb(objective, restricted.at, stop=stop)
                best = further if further.found.value > restricted.found.value else restricted
                break
            inflation = max(cov[index, index] / naive[index, index], 1.0)
            fall = max(best.found.value - restricted.found.value, 0.0)
            p = math.erfc(math.sqrt(fall / inflation))  # of 2 fall/inflation
            at_end = null <= coordinates.low[index] or null >= coordinates.high[index]
            value = float(coordinates.values(restricted.at)[index])
            tests[name] = NullTest(value, is_zero, restricted.found.value, p / 2 if at_end and fall > 0 else p)
        else:
            return best, tests
    return best, tests


def _held_at(objective: Objective, best: Ascent, index: int, null: float, cov: np.ndarray, stop) -> Ascent:
    """The maximum with a parameter held; the others begin in the direction of their correlation with it."""
    fixed = np.arange(len(best.at)) == index
    along = best.at + cov[:, index] / cov[index, index] * (null - best.at[index])
    starts = [objective.coordinates.clip(along), np.array(best.at)]
    for at in starts:
        at[index] = null
    at = max(starts, key=objective.value)
    return climb(objective, at, fixed=fixed, iterations=LEGS, stop=stop)


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
        return int(np.sum(getattr(self.objective.parts[0].data, "outliers", 0)))

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


def covariances_of(objective: Objective, best: Ascent) -> tuple[np.ndarray, np.ndarray]:
    """Covariances (p, p) of the estimates at a maximum: as stated, and by Fisher's information alone.

    Both include the information lost with the samples beyond a gate (`objective.lost_information`).
    """
    width = objective.coordinates.high - objective.coordinates.low
    lost = lost_information(objective.gate)
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


def write_values(
    path: str | Path, identification: Identification, logs: Sequence[str], dt: float | None = None
) -> None:
    """Write the identified values of a model, and the sample time of its logs [s], if that is known.

    Raises:
        ValueError: unless the path ends in .toml, lies beside no log of its name and can be written.
    """
    if not str(path).endswith(".toml"):
        raise ValueError(f"a file of values must end in .toml, but got {str(path)!r}")
    check_not_among(path)
    identified = {
        "logs": [Path(log).name for log in logs],
        "log_likelihood": identification.log_likelihood,
        "standard_errors": identification.standard_errors,
        "determined": identification.determined,
        **({} if dt is None else {"dt": float(dt)}),
    }
    tables: dict[str, Mapping] = {"values": identification.values, "identified": identified}
    write_whole(path, as_toml(tables, "Numbers of a model as `thruster identify` found them."))


def read_values(path: str | Path) -> dict[str, float]:
    """The values in such a file by name.

    Raises:
        ValueError: states the rule and the value, with the path.
    """
    content = read_toml(path, "a file of values")
    values = content.get("values")
    if not isinstance(values, dict) or not values or set(content) - set(TABLES):
        raise ValueError(
            f"a file of values must have the table [values], but {path} has {short_repr(sorted(content))}"
        )
    return {name: finite(f"{name} in {path}", value) for name, value in values.items()}


def values_in(path: str | Path) -> dict[str, float]:
    """Values of a model among those in a file."""
    return {name: value for name, value in read_values(path).items() if not name.startswith(CLOCK)}


def with_values(make: Callable | StateSpaceModel, path: str | Path) -> Callable[[float], StateSpaceModel]:
    """A function of the sample time that makes a model with the values in a file.

    Values belong to the sample time that the file says they were found at. At another one a function of `dt` makes
    the model, with variances in Q as `noise_for_dt` has them; any other model is refused.

    Args:
        make: the model, or a function that makes it, as for `ModelFamily`.
        path: path of the file.

    Raises:
        ValueError: if the file is damaged, or names a parameter that the model does not have; the function raises
            it for another sample time of a model that does not take one.
    """
    values, of = values_in(path), _dt_of(path)
    model_at = partial(_at_dt, make, values, of, str(path))
    try:
        model_at(1.0 if of is None else of)
    except ValueError as error:
        raise ValueError(f"{error} (in {path})") from None
    return model_at


def _dt_of(path: str | Path) -> float | None:
    """The sample time of the logs that values were found on [s]; None in a file that does not say."""
    table = read_toml(path, "a file of values").get("identified")
    dt = table.get("dt") if isinstance(table, dict) else None
    return None if dt is None else positive(f"dt in {path}", dt)


def _at_dt(
    make: Callable | StateSpaceModel, values: Mapping[str, float], of: float | None, path: str, dt: float
) -> StateSpaceModel:
    """The model with values of one sample time at another."""
    if of is not None and not same_dt(of, dt):
        takes = not isinstance(make, StateSpaceModel) and "dt" in inspect.signature(make).parameters
        if not takes:
            raise ValueError(
                f"the dt of a log must be that of {path}, {of:g} s, for a model that takes no dt, but is {dt:g} s"
            )
        q_variances = ModelFamily(make, (), noise=False, dt=dt).variances_of_q
        values = {n: float(noise_for_dt(v, of, dt)) if n in q_variances else v for n, v in values.items()}
    return valued(make, values, dt)


def valued(
    make: Callable | StateSpaceModel, values: Mapping[str, float], dt: float | None = None
) -> StateSpaceModel:
    """A model with other values of some parameters, by name; see `ModelFamily` for the names and errors."""
    return ModelFamily(make, tuple(values), noise=False, dt=dt).model(**values)
