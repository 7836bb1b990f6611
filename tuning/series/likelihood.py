"""The log-likelihood of a column of numbers under a named model, with gradient and Fisher information.

It is that of the innovations of a Kalman filter that begins without a prior: the first rows, from which it learns
its state, do not count. A long record is cut into runs, which are filtered side by side, as are several axes: they
are independent and have the same numbers.

Sources: Harvey (1989), Forecasting, Structural Time Series Models and the Kalman Filter, section 3.4, also for
the scale in closed form; Durbin and Koopman (2012), Time Series Analysis by State Space Methods, section 5.2, for
starts without a prior.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from filters.differentiated.recursion import EXTENDED, Wanted
from filters.differentiated.runs import ModelSlopes, RepeatedRuns, moves_of
from filters.models import Signal, Sum, in_unit
from filters.starts import Starts
from thruster_env.model.affine import AffineModel
from thruster_env.model.shape import number_offsets
from tuning.identification.objective import STEP, Evaluation
from tuning.problems.problem import Coordinates, Parameter, squared
from tuning.series.column import Column

RUN = 4096  # rows of a run, into which a long record is cut
R = "R"
R_ENDS = 1e-6, 1e1  # range of R, in squares of the roughness
SHARE = 0.2  # R from which searches begin, in squares of the roughness
WANTED = Wanted(information=True, constants=True, tails=False)


def model_of(candidate: Sum, column: Column, values: Mapping[str, float]) -> AffineModel:
    """The model of a column for values of a candidate's free numbers and R."""
    return candidate.model(
        {name: value for name, value in values.items() if name != R},
        values[R],
        column.dt,
        first=column.first,
        spread=column.scales.spread,
        offset=column.mean if candidate.about_mean else 0.0,
        quantities=column.quantities,
    )


class ColumnLikelihood:
    """The log-likelihood as a function of coordinates, the logarithms of the free numbers and of R, (p,).

    A model is not made for each point: of its numbers only A, Q and R change.

    Args:
        candidate: the named model.
        column: the numbers.

    Attributes:
        coordinates: of the free numbers and R, with their ranges.
        amplitude: (p,), along which Q and R grow by a common factor e: 1 for a variance, 1/2 for a deviation.
        states: n of one axis.
        counted: number of innovations that count.
    """

    def __init__(self, candidate: Sum, column: Column):
        scales, unit = column.scales, column.quantities[0].unit
        about = column.mean if candidate.about_mean else 0.0
        runs = np.concatenate([_runs(axis) for axis in (column.table - about).T])
        free = [
            Parameter(number.name, low, high, in_unit(number.unit, unit), default=number.values(scales)[0])
            for number in candidate.free
            for low, high in [number.range(scales)]
        ]
        low, high = (factor * scales.roughness**2 for factor in R_ENDS)
        start = SHARE * scales.roughness**2
        free.append(Parameter(R, low, high, squared(unit), default=start))
        self.coordinates = Coordinates(free)
        self.amplitude = np.array([*(_power(number.unit) for number in candidate.free), 1.0])
        self._candidate, self._dt = candidate, column.dt
        values = {parameter.name: parameter.start for parameter in free}
        noise = values.pop(R)
        self._model = candidate.model(values, noise, column.dt, spread=scales.spread)
        self.states = self._model.n
        self._numbers, self._layout = self._model.numbers, number_offsets(self._model.n, 1)
        starts = _starts(self._model, runs)
        measured = ~np.isnan(runs) & (np.arange(runs.shape[1]) >= starts.leads[:, None])
        self.counted = int(measured.sum())
        arrays = np.zeros((len(runs), runs.shape[1] - 1, 0)), runs[:, :, None]
        self._derivatives = RepeatedRuns(self._model, EXTENDED, WANTED, *arrays, starts=starts)

    def __call__(self, at: np.ndarray) -> Evaluation:
        """Log-likelihood, gradient and Fisher information at coordinates."""
        p, n, slopes = len(at), self._model.n, self._slopes(len(at))
        for j in range(p - 1):
            (a, q), (b, r) = (self._moments(side) for side in self.coordinates.neighbours(at, j, STEP))
            slopes.constants[j, : n * n] = (a - b).ravel() / (2 * STEP)
            slopes.process_noise_cov[j] = (q - r) / (2 * STEP)
        slopes.measurement_noise_cov[p - 1] = math.exp(at[-1])
        return self._evaluated(at, slopes)

    def value(self, at: np.ndarray) -> float:
        """Log-likelihood at coordinates; minus infinity where it is not finite."""
        return self._evaluated(at, self._slopes(0)).value

    def scaled(self, at: np.ndarray) -> tuple[float, np.ndarray]:
        """The largest log-likelihood along `amplitude`, and its coordinates within the range.

            log L(s) = log L - N/2 log s - c/2 (1/s - 1),  c = sum v^2/S,  s = c/N

        with Q, R times s: without a prior no estimate depends on s.
        """
        slopes = self._slopes(1)
        slopes.process_noise_cov[0] = self._moments(at)[1]
        slopes.measurement_noise_cov[0] = math.exp(at[-1])
        here = self._evaluated(at, slopes)
        squares = self.counted + 2.0 * float(here.gradient[0])
        if not squares > 0.0:  # nor NaN
            return -math.inf, at
        factor = squares / self.counted
        best = here.value - 0.5 * self.counted * math.log(factor) + 0.5 * (squares - self.counted)
        scaled = at + self.amplitude * math.log(factor)
        return best, np.clip(scaled, self.coordinates.low, self.coordinates.high)

    def _slopes(self, parameters: int) -> ModelSlopes:
        still = np.zeros((parameters, len(self._model.constants)))
        return ModelSlopes.of(self._model, parameters, constants=still)

    def _moments(self, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """F and Q of a step, at coordinates."""
        values = self.coordinates.named(at)
        del values[R]
        signal: Signal = self._candidate.signal(values)
        return signal.step(self._dt)

    def _evaluated(self, at: np.ndarray, slopes: ModelSlopes) -> Evaluation:
        numbers, n, layout = self._numbers.copy(), self._model.n, self._layout
        f, q = self._moments(at)
        numbers[layout.q : layout.q + n * n] = q.ravel()  # an extended Kalman filter reads no roots of them
        numbers[layout.r] = math.exp(at[-1])
        numbers[layout.constants : layout.constants + n * n] = f.ravel()
        own_slopes = np.zeros((len(slopes.constants), 0))
        out, information = self._derivatives(numbers, moves_of(slopes, own_slopes, self._model))
        parts = out.sum(axis=1)
        total = float(parts[:, 0].sum())
        value = total if math.isfinite(total) else -math.inf
        return Evaluation(value, parts[:, 1:].sum(axis=0), information.sum(axis=0), parts[:, 1:], parts[:, 0])


def _power(unit: str) -> float:
    """By which power of the factor on Q and R a number with a unit grows."""
    return 1.0 if unit.startswith("U^2") else 0.5 if unit.startswith("U") else 0.0


def _runs(values: np.ndarray) -> np.ndarray:
    """The numbers as runs (B, K) of equal length, NaN at the end of the last one."""
    count = max(1, round(len(values) / RUN))
    padded = np.full(count * -(-len(values) // count), np.nan)
    padded[: len(values)] = values
    return padded.reshape(count, -1)


def _starts(model: AffineModel, runs: np.ndarray) -> Starts:
    """Each run begins at its first number with the model's wide prior, and counts once the state is known."""
    count, measured = len(runs), ~np.isnan(runs)
    begins = np.where(measured.any(axis=1), runs[np.arange(count), measured.argmax(axis=1)], 0.0)
    means = np.zeros((count, model.n))
    means[:, int(model.matrices()[3][0].argmax())] = begins
    leads = np.array([np.searchsorted(rows, model.n) + 1 for rows in measured.cumsum(axis=1)])
    return Starts(np.ones(count, dtype=bool), means, np.tile(model.prior_cov, (count, 1, 1)), leads)
