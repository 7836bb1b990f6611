"""Models by name for a column of numbers: a level, a velocity, an oscillation, and sums of them.

A `Signal` is linear, in continuous time, and driven by white noise:

    dx/dt = A x + w,  E[w(t) w(s)'] = S delta(t - s);   z = C x + offset + v,  v ~ N(0, R)

so each gives a model for any sample time, whose Q has the structure of the physics: a white-noise acceleration
moves position and velocity together. Each has one to three numbers that mean something, with a range that follows
from the data's spread and times (`Scales`), so nobody has to guess where a search begins.

Sources: Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, sections 6.2
(kinematic models) and 8.2 (Singer's); Harvey (1989), Forecasting, Structural Time Series Models and the Kalman
Filter, sections 2.3 (local levels and trends, cycles); van Loan (1978) for Q.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from filters.gaussian.kalman import KalmanFilter
from thruster_env.core.checks import at_least, one_of, positive, short_repr
from thruster_env.model.affine import AffineModel, affine_model
from thruster_env.model.quantities import Quantity

MOST_HARMONICS = 6
UNDAMPED = 1e-6  # share of decay in a rate, below which it is that of a harmonic
TERMS, LARGEST_TERM = 14, 0.5  # of the series of e^(A h), and the norm of A h from which on h is halved
WIDE = 100.0  # spreads of the data in the prior's deviation: a start that knows nothing


class Scales(NamedTuple):
    """What the data say about the size of a model's numbers."""

    spread: float  # standard deviation of the values
    roughness: float  # the most that noise can be: by the differences of that order in which they vary least
    dt: float  # [s]
    duration: float  # [s]
    frequencies: tuple[float, ...]  # of the highest peaks of the spectrum [Hz]


class Free(NamedTuple):
    """A number of a named model that data may determine."""

    name: str
    meaning: str
    unit: str  # U is the data's unit
    range: Callable[[Scales], tuple[float, float]]
    starts: int = 1  # how many values of the range a search begins from, at equal ratios
    start: Callable[[Scales], Sequence[float]] | None = None  # these values, in place of equal ratios

    def values(self, scales: Scales) -> list[float]:
        """Values from which a search begins."""
        low, high = self.range(scales)
        if self.start is not None:
            return [min(max(value, low), high) for value in self.start(scales)]
        return np.geomspace(low, high, self.starts + 2)[1:-1].tolist()


class Signal(NamedTuple):
    """A linear signal in continuous time: A, S, C, and the symbols of its states with their units."""

    slope: np.ndarray  # A, (n, n)
    densities: np.ndarray  # S, (n, n), diagonal
    output: np.ndarray  # C, (n,)
    states: tuple[tuple[str, str], ...]  # symbol, and unit with U for the data's
    orders: tuple[int, ...]  # how often each state is differentiated by time: U/s^order
    variances: np.ndarray  # (n,), stationary ones; infinite for states that start anywhere

    def transition(self, dt: float) -> np.ndarray:
        """F = e^(A dt), (n, n)."""
        return self.step(dt)[0]

    def noise(self, dt: float) -> np.ndarray:
        """Q of a step of dt [s], (n, n)."""
        return self.step(dt)[1]

    def step(self, dt: float) -> tuple[np.ndarray, np.ndarray]:
        """F and Q of a step of dt [s]."""
        transitions, noises = steps(self.slope, self.driven, self.orders, np.array([dt]))
        return transitions[0], np.tensordot(np.diag(self.densities)[list(self.driven)], noises[:, 0], 1)

    def start(self, spread: float, dt: float) -> np.ndarray:
        """Variances of the first state, (n,): stationary ones, or else those of a hundred spreads of the data."""
        wide = (WIDE * spread / dt ** np.array(self.orders)) ** 2
        return np.where(np.isfinite(self.variances), self.variances, wide)

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


def _polynomials(terms: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """sum_k terms_k h^k of matrices (..., k, n, n), for each length h (u,): (..., u, n, n)."""
    *leading, count, n, _ = terms.shape
    powers = lengths[:, None] ** np.arange(count)
    return (powers @ terms.reshape(*leading, count, n * n)).reshape(*leading, len(lengths), n, n)


class NamedModel(NamedTuple):
    """A model that everybody knows: what it is, its free numbers, and the signal for their values."""

    name: str
    about: str
    free: tuple[Free, ...]
    signal: Callable[..., Signal]  # of the free numbers by name
    about_mean: bool = False  # whether the signal varies about the mean of the data


def _density(name: str, meaning: str, power: int) -> Free:
    """The density of white noise that drives a state: U^2/s^power.

    The range is from a noise that moves the output by 1e-5 of its spread over the whole record, to one that moves
    it by 100 spreads in each step.
    """

    def ends(s: Scales) -> tuple[float, float]:
        return 1e-10 * s.spread**2 / s.duration**power, 1e4 * s.spread**2 / s.dt**power

    return Free(name, meaning, f"U^2/s^{power}" if power > 1 else "U^2/s", ends, starts=9)


def _std(name: str, meaning: str) -> Free:
    return Free(name, meaning, "U", lambda s: (1e-4 * s.spread, 1e3 * s.spread), start=lambda s: [s.spread])


TIME_CONSTANT = Free(
    "time_constant",
    "time in which the signal forgets its past",
    "s",
    lambda s: (s.dt / 5.0, 10.0 * s.duration),
    starts=5,
)
FREQUENCY = Free(
    "frequency",
    "natural frequency",
    "Hz",
    lambda s: (0.5 / s.duration, 0.5 / s.dt),
    start=lambda s: s.frequencies,
)
DAMPING = Free("damping", "damping ratio", "", lambda s: (1e-4, 2.0), starts=3)


def _integrators(count: int, densities: tuple[float, ...], symbols: tuple[str, ...]) -> Signal:
    """A chain x_1' = x_2, x_2' = x_3, ..., of which the first is measured."""
    units = ("U", "U/s", "U/s^2")
    states = tuple(zip(symbols, units[:count], strict=True))
    anywhere = np.full(count, np.inf)
    return Signal(np.eye(count, k=1), np.diag(densities), np.eye(count)[0], states, tuple(range(count)), anywhere)


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
        np.array([std**2]),
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
    return chain._replace(slope=slope, variances=np.array([np.inf, np.inf, acceleration_std**2]))


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
        np.array([std**2, std**2]),
    )


NAMED = {
    model.name: model
    for model in (
        NamedModel(
            "constant", "a level that drifts", (_density("drift", "density of the level's drift", 1),), constant
        ),
        NamedModel(
            "constant-velocity",
            "a position with a velocity",
            (_density("acceleration", "density of the white acceleration", 3),),
            constant_velocity,
        ),
        NamedModel(
            "constant-acceleration",
            "a position with velocity and acceleration",
            (_density("jerk", "density of the white jerk", 5),),
            constant_acceleration,
        ),
        NamedModel(
            "ornstein-uhlenbeck",
            "deviations that return to the mean",
            (TIME_CONSTANT, _std("std", "standard deviation of the signal")),
            ornstein_uhlenbeck,
            about_mean=True,
        ),
        NamedModel(
            "local-trend",
            "a level and its trend, each with noise",
            (
                _density("drift", "density of the level's drift", 1),
                _density("trend_drift", "density of the trend's drift", 3),
            ),
            local_trend,
        ),
        NamedModel(
            "singer",
            "a position whose acceleration is correlated",
            (
                TIME_CONSTANT,
                Free(
                    "acceleration_std",
                    "standard deviation of the acceleration",
                    "U/s^2",
                    lambda s: (1e-5 * s.spread / s.duration**2, 1e2 * s.spread / s.dt**2),
                    starts=9,
                ),
            ),
            singer,
        ),
        NamedModel(
            "oscillator",
            "a damped oscillation about the mean",
            (FREQUENCY, DAMPING, _std("std", "standard deviation of the oscillation")),
            oscillator,
            about_mean=True,
        ),
    )
}


HARMONIC = "harmonic"
NAMES = (*NAMED, HARMONIC)


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
    orders, anywhere = (0,) * (2 * count), np.full(2 * count, np.inf)
    return Signal(slope, drift * np.eye(2 * count), output, tuple(states), orders, anywhere)


def _harmonic_model(settings: str) -> NamedModel:
    """`harmonics` with a period and a number from text such as "period=24,harmonics=3"."""
    rule = f"{HARMONIC} must have a period [s], as {HARMONIC}:period=24, and may have harmonics=N"
    try:
        pairs = dict(setting.split("=") for setting in settings.split(","))
        period, count = float(pairs.pop("period")), int(pairs.pop("harmonics", "1"))
    except (KeyError, ValueError):
        raise ValueError(f"{rule}, but got {settings!r}") from None
    if pairs or not (0.0 < period < math.inf) or not 1 <= count <= MOST_HARMONICS:
        raise ValueError(f"{rule} of at most {MOST_HARMONICS}, but got {settings!r}")
    free = (_density("drift", "density of the drift of its shape", 1),)
    about, signal = f"a course of period {period:g} s", partial(harmonics, period=period, count=count)
    return NamedModel(f"{HARMONIC}:{settings}", about, free, signal, about_mean=True)


class Sum(NamedTuple):
    """A named model, or a sum of several, with the names of its free numbers."""

    name: str
    parts: tuple[NamedModel, ...]

    @property
    def free(self) -> tuple[Free, ...]:
        """The free numbers of all parts; a name that several parts have carries its part's."""
        names = [number.name for part in self.parts for number in part.free]
        return tuple(
            number._replace(name=_unique(part.name, number.name, names))
            for part in self.parts
            for number in part.free
        )

    @property
    def about_mean(self) -> bool:
        """Whether the signal varies about the mean of the data: no part has a level of its own."""
        return all(part.about_mean for part in self.parts)

    def signal(self, values: Mapping[str, float]) -> Signal:
        """The signal for values of the free numbers by name."""
        names = [number.name for number in self.free]
        if set(values) != set(names):
            raise ValueError(f"{self.name} takes {', '.join(names)}, but got {short_repr(list(values))}")
        return self.signal_of([positive(name, values[name]) for name in names])

    def signal_of(self, values: Sequence[float]) -> Signal:
        """The signal for values of the free numbers in order."""
        ends = np.cumsum([0, *(len(part.free) for part in self.parts)]).tolist()
        signals = [
            part.signal(**{number.name: value for number, value in zip(part.free, values[first:], strict=False)})
            for part, first in zip(self.parts, ends, strict=False)
        ]
        return signals[0] if len(signals) == 1 else _added(signals)

    def check_harmonics(self, signal: Signal, dt: float) -> None:
        """Raise ValueError for a harmonic of fewer than two samples, which looks like another."""
        rates = np.linalg.eigvals(signal.slope)
        fastest = float(rates.imag[np.abs(rates.real) < UNDAMPED * np.abs(rates)].max(initial=0.0))
        if fastest * dt > math.pi * (1.0 + UNDAMPED):
            rule = f"each harmonic of {self.name} must have two samples in its period or more"
            raise ValueError(
                f"{rule}, but one has a period of {2.0 * math.pi / fastest:.4g} s, and dt is {dt:g} s"
            )

    def model(
        self,
        values: Mapping[str, float],
        noise: float,
        dt: float,
        *,
        first: float | Sequence[float] | np.ndarray = 0.0,
        spread: float = 1.0,
        offset: float | Sequence[float] | np.ndarray = 0.0,
        quantities: Sequence[Quantity] = (Quantity("measurement", "z"),),
    ) -> AffineModel:
        """The model of a step of dt, with a signal of its own and the same numbers for each axis.

        Args:
            values: of the free numbers.
            noise: R, the variance of the measurement noise [U^2].
            dt: sample time [s].
            first: the first measurement of each axis, where the filter begins, or one for all.
            spread: of the data [U]; the prior is the stationary one, or else a hundred times as wide as the data,
                and as fast as that within a step.
            offset: the mean of the data on each axis, about which the signal varies, or one for all.
            quantities: name, symbol and unit of the measurement on each axis.

        Raises:
            ValueError: for a wrong number, and for a harmonic of fewer than two samples, which looks like another.
        """
        signal, axes = self.signal(values), len(quantities)
        self.check_harmonics(signal, dt)
        n, each, (transition, noise_cov) = len(signal.output), np.eye(axes), signal.step(positive("dt", dt))
        offset = np.broadcast_to(np.asarray(offset, dtype=np.float64), axes)
        level = np.eye(n)[int(np.argmax(signal.output))]
        states = [
            Quantity(name, name, in_unit(text, axis.unit))
            for axis in quantities
            for symbol, text in signal.states
            for name in [symbol if axes == 1 else f"{symbol}_{axis.symbol}"]
        ]
        return affine_model(
            a=np.kron(each, transition),
            b=np.zeros((axes * n, 0)),
            c=np.kron(each, signal.output[None]),
            process_noise_cov=np.kron(each, noise_cov),
            measurement_noise_cov=[noise] * axes,
            prior_mean=np.kron(np.broadcast_to(first, axes) - offset, level) + 0.0,  # no negative zeros
            prior_cov=np.tile(signal.start(spread, dt), axes),
            measurement_offset=offset,
            states=states,
            input_quantities=[],
            measurements=list(quantities),
        )


def is_named(name: str) -> bool:
    """Whether a text is the name of a model, or a sum of such names."""
    return all(part.partition(":")[0].strip().lower() in NAMES for part in name.split("+"))


def named_model(name: str) -> Sum:
    """A model by name, such as "constant-velocity", or a sum, such as "constant + harmonic:period=24,harmonics=2".

    Raises:
        ValueError: for an unknown name; the message has the known ones.
    """
    parts = tuple(_part(part.strip().lower()) for part in name.split("+"))
    if len({part.name.partition(":")[0] for part in parts}) < len(parts):
        raise ValueError(f"parts of a sum must differ, but got {name!r}")
    if sum(not part.about_mean for part in parts) > 1:
        rule = "a sum must have at most one part with a level, since data determine the sum of two levels alone"
        raise ValueError(f"{rule}, but got {name!r}")
    return Sum(" + ".join(part.name for part in parts), parts)


def _part(text: str) -> NamedModel:
    """A model by its name, with settings behind a colon."""
    name, _, settings = text.partition(":")
    one_of("a model", name, NAMES)
    if name == HARMONIC:
        return _harmonic_model(settings)
    if settings:
        raise ValueError(f"settings must be those of {HARMONIC}, but got {settings!r} for {name}")
    return NAMED[name]


def kalman_filter(name: str, dt: float, noise: float, *, axes: int = 1, **values: float) -> KalmanFilter:
    """The Kalman filter of a named model, for data whose numbers are known.

        from filters.models import kalman_filter

        filter_ = kalman_filter("constant-velocity", dt=0.1, noise=0.25, acceleration=0.04)

    Args:
        name: of the model (`named_model`).
        dt: sample time [s].
        noise: R, the variance of the measurement noise.
        axes: number of measurements, each of a signal of its own: 2 for a position in a plane.
        **values: the model's numbers.

    Raises:
        ValueError: for an unknown name or number.
    """
    symbols = ["z"] if at_least("axes", axes, 1) == 1 else [f"z_{i + 1}" for i in range(axes)]
    quantities = [Quantity("measurement", symbol) for symbol in symbols]
    return KalmanFilter(model=named_model(name).model(values, noise, dt, quantities=quantities))


def in_unit(text: str, unit: str) -> str:
    """A unit with U replaced by the data's; empty for a pure number."""
    if not unit:
        text = text.replace("U^2/", "1/").replace("U/", "1/")
        return "" if text in ("U", "U^2") else text
    powered = f"({unit})" if set(unit) & set("/ *^") else unit
    return text.replace("U^2", f"{powered}^2").replace("U", unit)


def _unique(part: str, name: str, names: list[str]) -> str:
    part = part.partition(":")[0].replace("-", "_")
    return f"{part}_{name}" if names.count(name) > 1 else name


def _added(signals: list[Signal]) -> Signal:
    """The sum of signals, side by side."""
    return Signal(
        _block_diagonal([signal.slope for signal in signals]),
        _block_diagonal([signal.densities for signal in signals]),
        np.concatenate([signal.output for signal in signals]),
        tuple(state for signal in signals for state in signal.states),
        tuple(order for signal in signals for order in signal.orders),
        np.concatenate([signal.variances for signal in signals]),
    )


def _block_diagonal(blocks: Sequence[np.ndarray]) -> np.ndarray:
    matrix, first = np.zeros((sum(map(len, blocks)),) * 2), 0
    for block in blocks:
        last = first + len(block)
        matrix[first:last, first:last], first = block, last
    return matrix
