"""Linear signals in continuous time, and in equal steps: their rates, noises and first states.

    dx/dt = A x + w,  E[w(t) w(s)'] = S delta(t - s);   z = C x

A `Signal` gives F and Q of any step, so each step of a record may have its own length.

Sources: Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, sections 6.2
(kinematic models) and 8.2 (Singer's); Harvey (1989), Forecasting, Structural Time Series Models and the Kalman
Filter, sections 2.3 (local levels and trends, cycles); van Loan (1978) for Q.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

TERMS, LARGEST_TERM = 14, 0.5  # of the series of e^(A h), and the norm of A h from which on h is halved
WIDE = 100.0  # spreads of the data in the prior's deviation: a start that knows nothing


class Signal(NamedTuple):
    """A linear signal: A, S, C, and the symbols of its states with their units."""

    slope: np.ndarray  # A, (n, n)
    densities: np.ndarray  # S, (n, n), diagonal
    output: np.ndarray  # C, (n,)
    states: tuple[tuple[str, str], ...]  # symbol, and unit with U for the data's
    orders: tuple[int, ...]  # how often each state is differentiated by time: U/s^order
    first: np.ndarray  # covariance of the first state, (n, n); variances are infinite where it may be anything
    discrete: tuple[int, ...] = ()  # states in equal steps alone, whose A is F of a row, and S its Q

    def transition(self, dt: float) -> np.ndarray:
        """F = e^(A dt), (n, n)."""
        return self.step(dt)[0]

    def noise(self, dt: float) -> np.ndarray:
        """Q of a step of dt [s], (n, n)."""
        return self.step(dt)[1]

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """F and Q of a step of dt [s]."""
        transitions, noises = self.steps(self.slope, np.array([dt]), dt)
        return transitions[0], np.tensordot(np.diag(self.densities)[list(self.driven)], noises[:, 0], 1)

    def steps(self, slopes: np.ndarray, dts: np.ndarray, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """The results of `steps` for rates (..., n, n) of such a signal, and rows that are dt [s] apart.

        Raises:
            ValueError: for states in equal steps alone, if dt is no part of a step.
        """
        if not self.discrete:
            return steps(slopes, self.driven, self.orders, dts)
        counts, n, driven = np.round(dts / dt).astype(np.int64), len(self.output), self.driven
        if not np.allclose(counts * dt, dts, rtol=1e-6):
            rule = "an autoregression must have equal steps"
            raise ValueError(f"{rule}, but these are {dts.min():g} to {dts.max():g} s: take ornstein-uhlenbeck")
        f = np.zeros((*slopes.shape[:-2], len(dts), n, n))
        noises = np.zeros((*slopes.shape[:-2], len(driven), len(dts), n, n))
        for is_discrete in (False, True):
            states = np.array([i for i in range(n) if (i in self.discrete) == is_discrete])
            if not len(states):
                continue
            block: tuple[Any, ...] = (..., states[:, None], states)
            rates, of_block = slopes[block], [j for j, state in enumerate(driven) if state in states]
            within = [int(np.searchsorted(states, driven[j])) for j in of_block]
            orders = np.array(self.orders)[states]
            parts = _powers(rates, within, counts) if is_discrete else steps(rates, within, orders, dts)
            f[block] = parts[0]
            for position, j in enumerate(of_block):
                noises[..., j, :, :, :][block] = parts[1][..., position, :, :, :]
        return f, noises

    def start(self, spread: float, dt: float) -> np.ndarray:
        """Covariance of the first state, (n, n), with a hundred spreads of the data where it may be anything."""
        wide = (WIDE * spread / dt ** np.array(self.orders)) ** 2
        return np.where(np.isfinite(self.first), self.first, np.diag(wide))

    @property
    def driven(self) -> tuple[int, ...]:
        """Indices of the states that white noise drives."""
        return tuple(np.flatnonzero(np.diag(self.densities)).tolist())


def steps(
    slope: np.ndarray, driven: Sequence[int], orders: Sequence[int], dts: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """F of steps of different lengths, and Q of white noise of density 1 on each of some states.

        F(h) = sum_k A^k h^k/k!,  Q(h) = sum_k L^k(S) h^(k+1)/(k+1)!,  L(X) = A X + X A'
        F(2h) = F(h)^2,  Q(2h) = Q(h) + F(h) Q(h) F(h)'

    No term cancels another in Q, and only products of matrices are computed, for all lengths at once.

    Args:
        slope: A, (..., n, n).
        driven: indices of d states.
        orders: how often each state is differentiated by time, (n,): units in which A is well scaled.
        dts: lengths h [s], (u,).

    Returns:
        F, (..., u, n, n), and Q, (..., d, u, n, n).

    Source: van Loan (1978), "Computing integrals involving the matrix exponential", IEEE Transactions on Automatic
    Control 23(3); Moler, van Loan (2003), SIAM Review 45(1), method 3, for scaling and doubling.
    """
    n, unit = slope.shape[-1], float(dts.max())
    scale = unit ** np.asarray(orders, dtype=np.float64)  # of x in units of the data
    a = (slope * scale[:, None] / scale * unit)[..., None, :, :]  # an axis for what is driven
    terms = [np.broadcast_to(np.eye(n), a.shape)]
    while len(terms) < n and terms[-1].any():
        terms.append(a @ terms[-1] / len(terms))
    is_polynomial = not (a @ terms[-1]).any()
    count = 2 * n - 1 if is_polynomial else TERMS
    noise = np.zeros((len(driven), n, n))
    noise[range(len(driven)), driven, driven] = 1.0
    noises = [np.broadcast_to(noise, (*a.shape[:-3], *noise.shape))]
    for k in range(1, count):
        rate = a @ noises[-1]
        noises.append((rate + np.swapaxes(rate, -1, -2)) / (k + 1))
        if not is_polynomial and k >= len(terms):
            terms.append(a @ terms[-1] / k)
    doublings = np.zeros(len(dts), dtype=np.int64)
    if not is_polynomial:
        reach = float(np.abs(a).sum(axis=-1).max()) / LARGEST_TERM
        doublings = np.maximum(np.ceil(np.log2(np.maximum(reach * dts / unit, 1e-300))), 0.0).astype(np.int64)
    lengths = dts / unit * 0.5**doublings
    f = _polynomials(np.concatenate(terms, axis=-3), lengths)
    q = _polynomials(np.stack(noises, axis=-3), lengths) * lengths[:, None, None]
    for turn in range(int(doublings.max(initial=0))):
        now = doublings > turn
        part, of_noise = f[..., now, :, :], q[..., now, :, :]
        wide = part[..., None, :, :, :]
        q[..., now, :, :] = of_noise + wide @ of_noise @ np.swapaxes(wide, -1, -2)
        f[..., now, :, :] = part @ part
    q *= (unit ** (1.0 + 2.0 * np.asarray(orders, dtype=np.float64)))[list(driven), None, None, None]
    return f / scale[:, None] * scale, q / np.outer(scale, scale)


def _powers(transition: np.ndarray, driven: Sequence[int], counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`steps` of states in equal steps: F^k, and the sum of F^i S F'^i up to k - 1, for counts k (u,)."""
    n = transition.shape[-1]
    unit = np.zeros((len(driven), n, n))
    unit[range(len(driven)), driven, driven] = 1.0
    f, q = np.broadcast_to(np.eye(n), transition.shape), np.zeros((*transition.shape[:-2], *unit.shape))
    fs = np.empty((*transition.shape[:-2], len(counts), n, n))
    qs = np.empty((*transition.shape[:-2], len(driven), len(counts), n, n))
    wide = transition[..., None, :, :]
    for k in range(int(counts.max()) + 1):
        fs[..., counts == k, :, :], qs[..., counts == k, :, :] = f[..., None, :, :], q[..., None, :, :]
        f, q = transition @ f, wide @ q @ np.swapaxes(wide, -1, -2) + unit
    return fs, qs


def _polynomials(terms: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """sum_k terms_k h^k of matrices (..., k, n, n), for each length h (u,): (..., u, n, n)."""
    *leading, count, n, _ = terms.shape
    powers = lengths[:, None] ** np.arange(count)
    return (powers @ terms.reshape(*leading, count, n * n)).reshape(*leading, len(lengths), n, n)


def _integrators(count: int, densities: tuple[float, ...], symbols: tuple[str, ...]) -> Signal:
    """A chain x_1' = x_2, x_2' = x_3, ..., of which the first is measured."""
    units = ("U", "U/s", "U/s^2")
    states = tuple(zip(symbols, units[:count], strict=True))
    orders = tuple(range(count))
    return Signal(np.eye(count, k=1), np.diag(densities), np.eye(count)[0], states, orders, _anywhere(count))


def _anywhere(count: int) -> np.ndarray:
    """The first covariance of states that may begin anywhere."""
    return np.diag(np.full(count, np.inf))


def constant(drift: float) -> Signal:
    """A level that drifts as a random walk: the local level model.

        dx/dt = w,  Q = drift dt

    Args:
        drift: density of the white noise [U^2/s].
    """
    return _integrators(1, (drift,), ("level",))


def constant_velocity(acceleration: float) -> Signal:
    """A position whose velocity changes by white-noise acceleration.

        Q = acceleration [[dt^3/3, dt^2/2], [dt^2/2, dt]]

    Args:
        acceleration: density of the white acceleration [U^2/s^3].
    """
    return _integrators(2, (0.0, acceleration), ("position", "velocity"))


def constant_acceleration(jerk: float) -> Signal:
    """A position whose acceleration changes by white-noise jerk.

    Args:
        jerk: density of the white jerk [U^2/s^5].
    """
    return _integrators(3, (0.0, 0.0, jerk), ("position", "velocity", "acceleration"))


def local_trend(drift: float, trend_drift: float) -> Signal:
    """A level and its trend, each with noise: the local linear trend.

    Args:
        drift: density of the level's noise [U^2/s].
        trend_drift: density of the trend's noise [U^2/s^3].
    """
    return _integrators(2, (drift, trend_drift), ("level", "trend"))


def ornstein_uhlenbeck(time_constant: float, std: float) -> Signal:
    """A deviation that returns to the mean: exponentially correlated noise.

        dx/dt = -x/T + w,  S = 2 std^2/T

    Args:
        time_constant: T [s].
        std: stationary standard deviation [U].
    """
    return Signal(
        np.array([[-1.0 / time_constant]]),
        np.array([[2.0 * std**2 / time_constant]]),
        np.ones(1),
        (("deviation", "U"),),
        (0,),
        np.array([[std**2]]),
    )


def singer(time_constant: float, acceleration_std: float) -> Signal:
    """A position whose acceleration is exponentially correlated: a target that manoeuvres.

        da/dt = -a/T + w,  S = 2 std^2/T

    Args:
        time_constant: T of a manoeuvre [s].
        acceleration_std: stationary standard deviation of the acceleration [U/s^2].
    """
    slope = np.eye(3, k=1)
    slope[2, 2] = -1.0 / time_constant
    chain = _integrators(
        3, (0.0, 0.0, 2.0 * acceleration_std**2 / time_constant), ("position", "velocity", "acceleration")
    )
    return chain._replace(slope=slope, first=np.diag([np.inf, np.inf, acceleration_std**2]))


def oscillator(frequency: float, damping: float, std: float) -> Signal:
    """A damped oscillation about the mean that white noise excites.

        x'' = -2 zeta w_0 x' - w_0^2 x + w,  w_0 = 2 pi frequency,  S = 4 zeta w_0^3 std^2

    The second state is x'/w_0, so both have the unit of the data.

    Args:
        frequency: natural frequency [Hz].
        damping: zeta.
        std: stationary standard deviation [U].
    """
    w = 2.0 * math.pi * frequency
    return Signal(
        np.array([[0.0, w], [-w, -2.0 * damping * w]]),
        np.diag([0.0, 4.0 * damping * w * std**2]),
        np.array([1.0, 0.0]),
        (("oscillation", "U"), ("quadrature", "U")),
        (0, 0),
        std**2 * np.eye(2),
    )


def harmonics(drift: float, period: float, count: int) -> Signal:
    """A periodic signal about the mean whose shape drifts: a daily or yearly course.

        x_k'' = -(2 pi k/period)^2 x_k,  k = 1 ... count;  cosine and sine of each drift as random walks

    Args:
        drift: density of the noise on each cosine and sine [U^2/s].
        period: [s].
        count: harmonics; half the samples in a period describe any seasonal pattern.

    Source: Harvey (1989), section 2.3.4.
    """
    w = 2.0 * math.pi / period
    slope = np.kron(np.diag(np.arange(1.0, count + 1.0)), [[0.0, w], [-w, 0.0]])
    states = [(f"{word}_{k + 1}", "U") for k in range(count) for word in ("harmonic", "quadrature")]
    output = np.tile([1.0, 0.0], count)
    orders = (0,) * (2 * count)
    return Signal(slope, drift * np.eye(2 * count), output, tuple(states), orders, _anywhere(2 * count))


def seasonal(drift: float, period: float, seasons: int) -> Signal:
    """A pattern of as many values in a period, about the mean, that drifts: all of its `harmonics`.

    The last one of an even number has no quadrature, as all its samples would be zero, and twice the density, as
    half of its noise turns into the quadrature within a sample: Q of each cosine is drift dt.

    Args:
        drift: density of the noise on each cosine and sine [U^2/s].
        period: [s].
        seasons: samples in a period.

    Source: Harvey (1989), section 2.3.4, the trigonometric form.
    """
    signal = harmonics(drift, period, seasons // 2)
    if seasons % 2 == 0:
        signal.densities[-1, -1] = signal.first[-1, -1] = 0.0
        signal.densities[-2, -2] *= 2.0
    return signal


def autoregression(std: float, **partials: float) -> Signal:
    """A deviation from the mean that depends on the last ones, in equal steps.

        x_k = phi_1 x_{k-1} + ... + phi_p x_{k-p} + w_k

    It is stationary for all partial autocorrelations r_i between -1 and 1, from which Durbin's recursion has phi:
    phi_i,i = r_i, phi_i,j = phi_{i-1,j} - r_i phi_{i-1,i-j}.

    Args:
        std: stationary standard deviation [U].
        **partials: r_1 ... r_p.

    Raises:
        ValueError: for a partial autocorrelation that is not between -1 and 1.

    Source: Durbin (1960), "The fitting of time-series models", Review of the International Statistical Institute
    28(3); Monahan (1984), "A note on enforcing stationarity in autoregressive-moving average models", Biometrika
    71(2).
    """
    wrong = next((name for name, partial in partials.items() if not abs(partial) < 1.0), None)
    if wrong is not None:
        raise ValueError(f"{wrong} must be between -1 and 1, but got {partials[wrong]:g}")
    p, phi, innovation, correlations = len(partials), np.empty(0), 1.0, [1.0]
    for partial in partials.values():
        correlations.append(float(phi @ correlations[:0:-1]) + partial * innovation)
        phi = np.append(phi - partial * phi[::-1], partial)
        innovation *= 1.0 - partial**2
    lags, densities = np.arange(p), np.zeros((p, p))
    densities[0, 0] = std**2 * innovation
    return Signal(
        np.vstack([phi, np.eye(p)[:-1]]),
        densities,
        np.eye(p)[0],
        tuple((f"lag_{i}" if i else "deviation", "U") for i in range(p)),
        (0,) * p,
        std**2 * np.array(correlations)[np.abs(lags[:, None] - lags)],
        tuple(range(p)),
    )


def added(signals: list[Signal]) -> Signal:
    """The sum of signals, side by side."""
    firsts = np.cumsum([0, *(len(signal.output) for signal in signals)])[:-1].tolist()
    return Signal(
        block_diagonal([signal.slope for signal in signals]),
        block_diagonal([signal.densities for signal in signals]),
        np.concatenate([signal.output for signal in signals]),
        tuple(state for signal in signals for state in signal.states),
        tuple(order for signal in signals for order in signal.orders),
        block_diagonal([signal.first for signal in signals]),
        tuple(first + i for signal, first in zip(signals, firsts, strict=True) for i in signal.discrete),
    )


def with_level(signal: Signal) -> Signal:
    """A signal about a level that stays, its last state."""
    zero = np.zeros((1, 1))
    return added([signal, Signal(zero, zero, np.ones(1), (("mean", "U"),), (0,), _anywhere(1))])


def block_diagonal(blocks: Sequence[np.ndarray]) -> np.ndarray:
    """Square matrices along a diagonal."""
    matrix, first = np.zeros((sum(map(len, blocks)),) * 2), 0
    for block in blocks:
        last = first + len(block)
        matrix[first:last, first:last], first = block, last
    return matrix
