"""The log-likelihood of a column of numbers under a named model, with gradient and Fisher information.

It is that of the innovations of a Kalman filter whose stationary states begin with their stationary covariance.
Its other states begin anywhere, and so does the mean of a signal that varies about it: as many first numbers as
there are such states determine them and do not count. A long record is cut into runs, which are filtered side by
side, as are several axes: they are independent and have the same numbers. Each step has the F and Q of its length.

Sources: Harvey (1989), Forecasting, Structural Time Series Models and the Kalman Filter, section 3.4, also for
the scale in closed form; de Jong (1991), "The diffuse Kalman filter", Annals of Statistics 19(2), for states that
begin anywhere: the first numbers are solved for them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from filters.models import Scales, Sum, in_unit
from filters.signals import Signal, added, anywhere
from thruster_env.model.affine import AffineModel
from tuning.likelihood.ascent import Evaluation
from tuning.problems.problem import STEP, Coordinates, Parameter, squared
from tuning.series.column import Column
from tuning.series.recursion import Beginning, StepTables, Sums, filtered_runs

RUN = 4096  # rows of a run, into which a long record is cut
R = "R"
R_ENDS = 1e-6, 1e1  # range of R, in squares of the roughness
SHARE = 0.2  # R from which searches begin, in squares of the roughness
ILL = 1e7  # condition of the first numbers as a function of the state, above which a wide prior is taken
DIGITS = 9  # of steps in sample times, so that equal ones are that
NUMBERS = 4_000_000  # of tables of steps at once


def model_of(
    candidate: Sum, column: Column, values: Mapping[str, float], level: np.ndarray | None = None
) -> AffineModel:
    """The model of a column for values of a candidate's free numbers and R.

    Args:
        candidate: the named model.
        column: the numbers.
        values: of the free numbers, and R.
        level: the mean about which the signal varies, of each axis; that of the numbers if None.
    """
    mean = column.mean if level is None else level
    return candidate.model(
        {name: value for name, value in values.items() if name != R},
        values[R],
        column.dt,
        first=column.first,
        spread=column.scales.spread,
        offset=mean if candidate.about_mean else 0.0,
        quantities=column.quantities,
    )


class Points(NamedTuple):
    """Numbers of signals at g points, of which the first is in the middle and the others are pairs beside it."""

    slopes: np.ndarray  # A of points with different ones, (g', n, n)
    of_slopes: np.ndarray  # (g,), which of these a point has
    densities: np.ndarray  # of the driven states, (g, d)
    first: np.ndarray  # covariances of the first state, (g, n, n)
    noises: np.ndarray  # R, (g,)


def with_level(signal: Signal) -> Signal:
    """A signal about a level that stays, its last state."""
    zero = np.zeros((1, 1))
    return added([signal, Signal(zero, zero, np.ones(1), (("mean", "U"),), (0,), anywhere(1))])


class ColumnLikelihood:
    """The log-likelihood as a function of coordinates, the logarithms of the free numbers and of R, (p,).

    Args:
        candidate: the named model.
        column: the numbers.
        rows: of a run.
        scales: of the ranges, where the column is a part of the one that they are of.

    Attributes:
        coordinates: of the free numbers and R, with their ranges.
        amplitude: (p,), along which Q and R grow by a common factor e: 1 for a variance, 1/2 for a deviation.
        states: n of one axis, without the mean.
        counted: number of innovations that count.
    """

    def __init__(self, candidate: Sum, column: Column, rows: int = RUN, scales: Scales | None = None):
        scales, unit = scales or column.scales, column.quantities[0].unit
        self._candidate, self._mean, self._rows, self._dt = candidate, column.mean, len(column.table), column.dt
        free = [
            Parameter(
                number.name,
                low,
                high,
                in_unit(number.unit, unit),
                log=number.log,
                default=number.values(scales)[0],
            )
            for number in candidate.free
            for low, high in [number.range(scales)]
        ]
        low, high = (factor * scales.roughness**2 for factor in R_ENDS)
        start = SHARE * scales.roughness**2
        free.append(Parameter(R, low, high, squared(unit), default=start))
        self.coordinates = Coordinates(free)
        self.amplitude = np.array([*(_power(number.unit) for number in candidate.free), 1.0])
        first = self._signal([parameter.start for parameter in free])
        candidate.check_harmonics(first, column.dt)
        candidate.check_steps(np.unique(np.diff(column.times)))
        self._n, self.states = len(first.output), len(first.output) - candidate.about_mean
        self._anywhere = np.flatnonzero(np.isinf(np.diag(first.first)))
        self._wide = first.start(scales.spread, column.dt)
        self._rates_move, self._last_steps = self._moving_rates(), dict[int, Any]()
        count, axes, needed = max(1, round(self._rows / rows)), len(column.mean), max(len(self._anywhere), 1)
        z = np.concatenate([_runs(axis, count) for axis in (column.table - column.mean).T])
        has_enough = (~np.isnan(z)).sum(axis=1) >= needed
        if not has_enough.any():
            raise ValueError(f"{candidate.name} must have more than {needed} numbers, but has {self._rows} rows")
        self._z, self._axes = z[has_enough], np.repeat(range(axes), count)[has_enough]
        self._begin_at = np.argsort(np.isnan(self._z), axis=1, kind="stable")[:, :needed]
        self._counts = ~np.isnan(self._z) & (np.arange(self._z.shape[1]) > self._begin_at[:, -1:])
        self.counted = int(self._counts.sum())
        times = np.tile(_runs(column.times, count), (axes, 1))[has_enough]
        self._begin_times = np.take_along_axis(times, self._begin_at, axis=1)
        self._begin_z = np.take_along_axis(self._z, self._begin_at, axis=1)
        begin_dts = np.diff(self._begin_times, axis=1)
        lengths, of_lengths = np.unique(begin_dts, return_inverse=True)
        self._begin_steps = lengths, of_lengths.reshape(begin_dts.shape)
        dts, kinds = np.unique(np.round(np.diff(column.times) / column.dt, DIGITS), return_inverse=True)
        index = np.tile(_runs(np.append(0, kinds), count), (axes, 1))[has_enough]
        self._parts = self._in_parts(dts * column.dt, np.nan_to_num(index).astype(np.int64))
        self._is_exact = self._determines_start(first)

    def __call__(self, at: np.ndarray) -> Evaluation:
        """Log-likelihood, gradient and Fisher information at coordinates."""
        sums = self._summed(at, range(len(at)))
        value = float(sums.values.sum())
        value = value if math.isfinite(value) else -math.inf
        gradient, information = sums.gradients.sum(axis=0), sums.information.sum(axis=0)
        return Evaluation(value, gradient, information, sums.gradients, sums.values)

    def value(self, at: np.ndarray) -> float:
        """Log-likelihood at coordinates; minus infinity where it is not finite."""
        value = float(self._summed(at, ()).values.sum())
        return value if math.isfinite(value) else -math.inf

    def scaled(self, at: np.ndarray) -> tuple[float, np.ndarray]:
        """The largest log-likelihood along `amplitude`, and its coordinates within the range.

            log L(s) = log L - N/2 log s - c/2 (1/s - 1),  c = sum v^2/S,  s = c/N

        with Q, R times s: no estimate depends on s.
        """
        sums = self._summed(at, ())
        value, squares = float(sums.values.sum()), float(sums.squares.sum())
        if not (math.isfinite(value) and squares > 0.0):
            return -math.inf, at
        factor = squares / self.counted
        best = value - 0.5 * self.counted * math.log(factor) + 0.5 * (squares - self.counted)
        scaled = at + self.amplitude * math.log(factor)
        return best, self.coordinates.clip(scaled)

    def by_rows(self, at: np.ndarray) -> np.ndarray:
        """Log densities of the innovations that count, (K, axes), 0 elsewhere; the record must be one run."""
        sums = self._summed(at, (), each_row=True)
        v, s = sums.innovations[..., 0], sums.innovations[..., 1]
        with np.errstate(all="ignore"):  # S may be negative, by rounding, for a deviation far above the noise's
            densities = np.where(s > 0.0, -0.5 * (np.log(2.0 * math.pi * s) + v**2 / s), -math.inf)
        return np.where(self._counts, densities, 0.0).T

    def level(self, at: np.ndarray) -> np.ndarray:
        """The mean about which the signal of each axis varies, by generalised least squares, (axes,)."""
        n, last, beliefs = self._n, self._n - 1, self._summed(at, ()).beliefs[:, 0]
        weights = 1.0 / beliefs[:, n + last * n + last]  # of each run
        sums, totals = (
            np.bincount(self._axes, part, len(self._mean)) for part in (weights, weights * beliefs[:, last])
        )
        return self._mean + totals / sums

    def _signal(self, values: Sequence[float]) -> Signal:
        """The signal, with the mean as a last state if it varies about that."""
        signal = self._candidate.signal_of(values[: len(self.coordinates.names) - 1])
        return with_level(signal) if self._candidate.about_mean else signal

    def _summed(self, at: np.ndarray, along: Sequence[int], *, each_row: bool = False) -> Sums:
        """The filter over all runs at coordinates, with derivatives along parameters."""
        r, here = math.exp(at[-1]), self._signal(self.coordinates.values(at).tolist())
        signals, noises = [here], [r]
        for j in along:
            for point in self.coordinates.neighbours(at, j):
                is_noise = j == len(at) - 1
                signals.append(here if is_noise else self._signal(self.coordinates.values(point).tolist()))
                noises.append(r * math.exp(point[j] - at[j]) if is_noise else r)
        r_slopes = np.array([r if j == len(at) - 1 else 0.0 for j in along])
        moving = [j in self._rates_move for j in along]
        is_apart = [True, *(moves for moves in moving for _ in range(2))]
        points = Points(
            np.array([signal.slope for signal, apart in zip(signals, is_apart, strict=True) if apart]),
            np.where(is_apart, np.cumsum(is_apart) - 1, 0),
            np.array([np.diagonal(signal.densities)[list(here.driven)] for signal in signals]),
            np.array([signal.first for signal in signals]),
            np.array(noises),
        )
        begin, parts = self._beginning(here, points), []
        for part, (runs, dts, index) in enumerate(self._parts):
            tables = self._tables(here, points, moving, part, dts)
            arguments = self._z[runs], index, tables, here.output, r, r_slopes, begin.of(runs)
            parts.append(filtered_runs(*arguments, each_row=each_row))
        return parts[0] if len(parts) == 1 else Sums(*map(np.concatenate, zip(*parts, strict=True)))

    def _steps(self, here: Signal, slopes: np.ndarray, key: int, dts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F and Q of steps for rates, again where rates are those of the last call."""
        rates = slopes.tobytes()
        if self._last_steps.get(key, (b"",))[0] != rates:
            self._last_steps[key] = rates, here.steps(slopes, dts, self._dt)
        return self._last_steps[key][1]

    def _tables(
        self, here: Signal, points: Points, moving: Sequence[bool], part: int, dts: np.ndarray
    ) -> StepTables:
        """F and Q of the steps, and their slopes along parameters, each of which has two neighbouring points."""
        fs, noises = self._steps(here, points.slopes, part, dts)
        p, (u, n) = len(moving), fs.shape[1:3]
        f_slopes = np.zeros((p, u * any(moving), n, n))
        q_slopes = np.empty((p, u, n, n))
        flat = noises.reshape(*noises.shape[:2], u * n * n)
        for j, moves in enumerate(moving):
            above, below = 1 + 2 * j, 2 + 2 * j
            if moves:
                a, b = points.of_slopes[above], points.of_slopes[below]
                f_slopes[j] = (fs[a] - fs[b]) / (2.0 * STEP)
                q_slope = points.densities[above] @ flat[a] - points.densities[below] @ flat[b]
            else:
                q_slope = (points.densities[above] - points.densities[below]) @ flat[0]
            q_slopes[j] = q_slope.reshape(u, n, n) / (2.0 * STEP)
        q = (points.densities[0] @ flat[0]).reshape(u, n, n)
        return StepTables(fs[0], q, f_slopes, q_slopes, np.array(moving, dtype=np.float64))

    def _in_parts(self, dts: np.ndarray, index: np.ndarray) -> list[tuple[slice, np.ndarray, np.ndarray]]:
        """Runs that are filtered at once, the lengths of their steps, and which of these leads to each row."""
        size = len(self.coordinates.names) * 2 * self._n**2
        if len(dts) * size <= NUMBERS:
            return [(slice(None), dts, index)]
        at_once, parts = max(1, NUMBERS // (size * index.shape[1])), []
        for first in range(0, len(index), at_once):
            part = slice(first, first + at_once)
            kinds, of_part = np.unique(index[part], return_inverse=True)
            parts.append((part, dts[kinds], of_part.reshape(index[part].shape)))
        return parts

    def _moving_rates(self) -> frozenset[int]:
        middle = 0.5 * (self.coordinates.low + self.coordinates.high)
        moving = []
        for j in range(len(middle) - 1):
            above, below = self.coordinates.neighbours(middle, j)
            first, other = (self._signal(self.coordinates.values(side).tolist()).slope for side in (above, below))
            moving += [j] * (not np.array_equal(first, other))
        return frozenset(moving)

    # Where each run begins: after the numbers that determine the states that may begin anywhere.

    def _determines_start(self, signal: Signal) -> bool:
        """Whether the first numbers of each run determine its states well."""
        anywhere = self._anywhere
        if not len(anywhere):
            return False
        observed, *_ = self._observed(signal, signal.slope[None])
        units = (np.ptp(self._begin_times, axis=1).min() or 1.0) ** np.array(signal.orders)[anywhere]
        return bool((np.linalg.cond(observed[0] / units) < ILL).all())

    def _observed(self, here: Signal, slopes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """How the first numbers depend on the d states, Z (g, B, d, d), and the last state, X (g, B, n, d).

        Also F and noises of unit density of the steps between them.
        """
        anywhere, d, runs = self._anywhere, len(self._anywhere), len(self._z)
        kinds, index = self._begin_steps
        f, noises = self._steps(here, slopes, -1, kinds) if d > 1 else (np.empty(0), np.empty(0))
        phi = np.broadcast_to(np.eye(self._n)[:, anywhere], (len(slopes), runs, self._n, d))
        observed = np.empty((len(slopes), runs, d, d))
        for j in range(d):
            phi = f[:, index[:, j - 1]] @ phi if j else phi
            observed[:, :, j] = here.output @ phi
        return observed, phi, f, noises

    def _beginning(self, here: Signal, points: Points) -> Beginning:
        """The belief of each run after the numbers that determine it, with slopes by pairs of neighbouring points.

            x = X d + e,  z = Z d + w;  x^ = X Z^-1 z,  P = cov(e - X Z^-1 w)

        where d are the states that begin anywhere, e and w the stationary states and noise since then.
        """
        n, d, count, g = self._n, len(self._anywhere), len(self._z), len(points.noises)
        known = np.isfinite(points.first)
        if not self._is_exact:
            covs = np.where(known, points.first, self._wide)
            covs = np.broadcast_to(covs[:, None], (g, count, n, n))
            return self._as_beginning(np.zeros((g, count, n)), covs, self._begin_at[:, 0], is_prediction=True)
        observed, phi, f, noises = self._observed(here, points.slopes)
        (_, index), of = self._begin_steps, points.of_slopes
        p = np.where(known, points.first, 0.0)
        p = np.broadcast_to(p[:, None], (g, count, n, n))
        across, among = np.zeros((g, count, d, n)), np.zeros((g, count, d, d))
        for j in range(d):
            if j:
                transition = f[of][:, index[:, j - 1]]
                back = np.swapaxes(transition, -1, -2)
                unit_noises = noises[of][:, :, index[:, j - 1]]
                p = transition @ p @ back + (points.densities[:, :, None, None, None] * unit_noises).sum(axis=1)
                across = across @ back
            among[:, :, j, :j] = among[:, :, :j, j] = across[:, :, :j] @ here.output
            across[:, :, j] = p @ here.output
            among[:, :, j, j] = across[:, :, j] @ here.output + points.noises[:, None]
        solved = np.linalg.solve(np.swapaxes(observed, -1, -2), np.swapaxes(phi, -1, -2))
        gain = np.swapaxes(solved, -1, -2)[of]
        cross = gain @ across
        covs = p - cross - np.swapaxes(cross, -1, -2) + gain @ among @ np.swapaxes(gain, -1, -2)
        means = (gain @ self._begin_z[:, :, None])[..., 0]
        return self._as_beginning(means, covs, self._begin_at[:, -1], is_prediction=False)

    def _as_beginning(
        self, means: np.ndarray, covs: np.ndarray, rows: np.ndarray, *, is_prediction: bool
    ) -> Beginning:
        beliefs = np.concatenate([means, covs.reshape(*means.shape[:2], -1)], axis=-1)
        slopes = np.swapaxes(beliefs[1::2] - beliefs[2::2], 0, 1) / (2.0 * STEP)
        return Beginning(rows, is_prediction, beliefs[0], slopes, self._begin_at[:, -1] + 1)


def _power(unit: str) -> float:
    """By which power of the factor on Q and R a number with a unit grows."""
    return 1.0 if unit.startswith("U^2") else 0.5 if unit.startswith("U") else 0.0


def _runs(values: np.ndarray, count: int) -> np.ndarray:
    """The numbers as runs (B, K) of equal length, NaN at the end of the last one."""
    padded = np.full(count * -(-len(values) // count), np.nan)
    padded[: len(values)] = values
    return padded.reshape(count, -1)
