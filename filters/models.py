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
import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np

from filters.signals import Signal, added, anywhere
from thruster_env.core.checks import finite, one_of, positive, short_repr
from thruster_env.model.affine import AffineModel, affine_model
from thruster_env.model.quantities import Quantity

MOST_HARMONICS, MOST_SEASONS, MOST_ORDER = 6, 24, 8
SEASON_ROUNDING = 0.15  # of a season, by which a step may differ from it, as months do
UNDAMPED = 1e-6  # share of decay in a rate, below which it is that of a harmonic


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
    log: bool = True  # whether it is positive, and searched on a logarithmic scale
    is_searched: bool = False  # whether the start is the highest of many peaks, which may be noise

    def values(self, scales: Scales) -> list[float]:
        """Values from which a search begins."""
        low, high = self.range(scales)
        if self.start is not None:
            return [min(max(value, low), high) for value in self.start(scales)]
        return np.geomspace(low, high, self.starts + 2)[1:-1].tolist()


class NamedModel(NamedTuple):
    """A model that everybody knows: what it is, its free numbers, and the signal for their values."""

    name: str
    about: str
    free: tuple[Free, ...]
    signal: Callable[..., Signal]  # of the free numbers by name
    about_mean: bool = False  # whether the signal varies about the mean of the data
    apart: float | None = None  # [s], whose multiples steps must be


def _density(name: str, meaning: str, power: int) -> Free:
    """The density of white noise that drives a state: U^2/s^power.

    The range is from a noise that moves the output by 1e-5 of its spread over the whole record, to one that moves
    it by 100 spreads in each step.
    """

    def ends(s: Scales) -> tuple[float, float]:
        return 1e-10 * s.spread**2 / s.duration**power, 1e4 * s.spread**2 / s.dt**power

    return Free(name, meaning, f"U^2/s^{power}" if power > 1 else "U^2/s", ends, starts=9)


def _std(name: str, meaning: str) -> Free:
    return Free(name, meaning, "U", lambda s: (1e-4 * s.spread, 1e2 * s.spread), start=lambda s: [s.spread])


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
    is_searched=True,
)
DAMPING = Free("damping", "damping ratio", "", lambda s: (1e-4, 2.0), starts=3)


NAMED: dict[str, NamedModel] = {}  # without settings


def named(name: str, about: str, *free: Free, about_mean: bool = False) -> Callable:
    """Decorator that registers a signal of free numbers as a model of this name."""

    def register(signal: Callable[..., Signal]) -> Callable[..., Signal]:
        NAMED[name] = NamedModel(name, about, free, signal, about_mean)
        return signal

    return register


def _integrators(count: int, densities: tuple[float, ...], symbols: tuple[str, ...]) -> Signal:
    """A chain x_1' = x_2, x_2' = x_3, ..., of which the first is measured."""
    units = ("U", "U/s", "U/s^2")
    states = tuple(zip(symbols, units[:count], strict=True))
    orders = tuple(range(count))
    return Signal(np.eye(count, k=1), np.diag(densities), np.eye(count)[0], states, orders, anywhere(count))


@named("constant", "a level that drifts", _density("drift", "density of the level's drift", 1))
def constant(drift: float) -> Signal:
    """A level that drifts as a random walk: the local level model.

        dx/dt = w,  Q = drift dt

    Args:
        drift: density of the white noise [U^2/s].
    """
    return _integrators(1, (drift,), ("level",))


@named(
    "constant-velocity",
    "a position with a velocity",
    _density("acceleration", "density of the white acceleration", 3),
)
def constant_velocity(acceleration: float) -> Signal:
    """A position whose velocity changes by white-noise acceleration.

        Q = acceleration [[dt^3/3, dt^2/2], [dt^2/2, dt]]

    Args:
        acceleration: density of the white acceleration [U^2/s^3].
    """
    return _integrators(2, (0.0, acceleration), ("position", "velocity"))


@named(
    "constant-acceleration",
    "a position with velocity and acceleration",
    _density("jerk", "density of the white jerk", 5),
)
def constant_acceleration(jerk: float) -> Signal:
    """A position whose acceleration changes by white-noise jerk.

    Args:
        jerk: density of the white jerk [U^2/s^5].
    """
    return _integrators(3, (0.0, 0.0, jerk), ("position", "velocity", "acceleration"))


@named(
    "ornstein-uhlenbeck",
    "deviations that return to the mean",
    TIME_CONSTANT,
    _std("std", "standard deviation of the signal"),
    about_mean=True,
)
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


@named(
    "local-trend",
    "a level and its trend, each with noise",
    _density("drift", "density of the level's drift", 1),
    _density("trend_drift", "density of the trend's drift", 3),
)
def local_trend(drift: float, trend_drift: float) -> Signal:
    """A level and its trend, each with noise: the local linear trend.

    Args:
        drift: density of the level's noise [U^2/s].
        trend_drift: density of the trend's noise [U^2/s^3].
    """
    return _integrators(2, (drift, trend_drift), ("level", "trend"))


@named(
    "singer",
    "a position whose acceleration is correlated",
    TIME_CONSTANT,
    Free(
        "acceleration_std",
        "standard deviation of the acceleration",
        "U/s^2",
        lambda s: (1e-5 * s.spread / s.duration**2, 1e2 * s.spread / s.dt**2),
        starts=9,
    ),
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


@named(
    "oscillator",
    "a damped oscillation about the mean",
    FREQUENCY,
    DAMPING,
    _std("std", "standard deviation of the oscillation"),
    about_mean=True,
)
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
    return Signal(slope, drift * np.eye(2 * count), output, tuple(states), orders, anywhere(2 * count))


def _harmonic_model(settings: str) -> NamedModel:
    """`harmonics` of text such as "period=24,harmonics=3"; without a period it is a free number."""
    rule = "harmonic may have period=SECONDS and harmonics=N"
    values = _numbers_of(settings, rule, "period", "harmonics")
    period, count = values.get("period"), values.get("harmonics", 1.0)
    if not count.is_integer() or not 1 <= count <= MOST_HARMONICS:
        raise ValueError(f"{rule} of 1 to {MOST_HARMONICS}, but got {settings!r}")
    free, fixed, name = (SHAPE_DRIFT,), {"count": int(count)}, f"harmonic:{settings}".rstrip(":")
    if period is None:
        return NamedModel(name, "a periodic course", (*free, PERIOD), partial(harmonics, **fixed), about_mean=True)
    signal = partial(harmonics, period=period, **fixed)
    return NamedModel(name, f"a course of period {period:g} s", free, signal, about_mean=True)


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


def _seasonal_model(settings: str) -> NamedModel:
    """`seasonal` of text such as "period=86400,seasons=24"; seasons are those of a row a second without it."""
    rule = f"seasonal must have period=SECONDS and may have seasons=N of 3 to {MOST_SEASONS}, samples in a period"
    values = _numbers_of(settings, rule, "period", "seasons")
    if "period" not in values:
        raise ValueError(f"{rule}, but got {settings!r}")
    seasons = values.get("seasons", values["period"])
    if not seasons.is_integer() or not 3 <= seasons <= MOST_SEASONS:
        raise ValueError(f"{rule}, but got {settings!r}")
    signal = partial(seasonal, period=values["period"], seasons=int(seasons))
    apart = values["period"] / seasons if seasons % 2 == 0 else None
    about = f"a pattern of {int(seasons)} values in {values['period']:g} s"
    return NamedModel(f"seasonal:{settings}", about, (SHAPE_DRIFT,), signal, about_mean=True, apart=apart)


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
    wrong = next((name for name, r in partials.items() if not abs(r) < 1.0), None)
    if wrong is not None:
        raise ValueError(f"{wrong} must be between -1 and 1, but got {partials[wrong]:g}")
    p, phi, innovation, correlations = len(partials), np.empty(0), 1.0, [1.0]
    for r in partials.values():
        correlations.append(float(phi @ correlations[:0:-1]) + r * innovation)
        phi = np.append(phi - r * phi[::-1], r)
        innovation *= 1.0 - r**2
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


def _autoregressive_model(settings: str) -> NamedModel:
    """`autoregression` of text such as "2", its order."""
    if not settings.isdecimal() or not 1 <= int(settings) <= MOST_ORDER:
        rule = f"ar must have an order of 1 to {MOST_ORDER}, as ar:2"
        raise ValueError(f"{rule}, but got {settings!r}")
    partials = tuple(
        Free(
            f"partial_{i}",
            f"partial autocorrelation at lag {i}",
            "",
            lambda s: (-0.9999, 0.9999),
            start=(lambda s: (0.8, 0.2, -0.5)) if i == 1 else (lambda s: (0.4, -0.4)),
            log=False,
        )
        for i in range(1, int(settings) + 1)
    )
    free = *partials, _std("std", "standard deviation of the signal")
    about = f"an autoregression of order {settings}, in equal steps"
    return NamedModel(f"ar:{settings}", about, free, autoregression, about_mean=True)


def _numbers_of(settings: str, rule: str, *names: str) -> dict[str, float]:
    """Positive numbers by name of text such as "period=24,harmonics=3"; ValueError with the rule for others."""
    try:
        pairs = [setting.split("=") for setting in settings.split(",") if setting]
        values = {name.strip(): float(text) for name, text in pairs}
    except ValueError:
        raise ValueError(f"{rule}, but got {settings!r}") from None
    if (
        len(values) < len(pairs)
        or not set(values) <= set(names)
        or not all(0.0 < value < math.inf for value in values.values())
    ):
        raise ValueError(f"{rule}, but got {settings!r}")
    return values


SHAPE_DRIFT = _density("drift", "density of the drift of its shape", 1)
PERIOD = Free(
    "period",
    "period",
    "s",
    lambda s: (2.0 * s.dt, 2.0 * s.duration),
    start=lambda s: [1.0 / frequency for frequency in s.frequencies],
    is_searched=True,
)
WITH_SETTINGS = {"harmonic": _harmonic_model, "seasonal": _seasonal_model, "ar": _autoregressive_model}
NAMES = (*NAMED, *WITH_SETTINGS)


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
        return self.signal_of(
            [(positive if number.log else finite)(number.name, values[number.name]) for number in self.free]
        )

    def signal_of(self, values: Sequence[float]) -> Signal:
        """The signal for values of the free numbers in order."""
        ends = np.cumsum([0, *(len(part.free) for part in self.parts)]).tolist()
        signals = [
            part.signal(**{number.name: value for number, value in zip(part.free, values[first:], strict=False)})
            for part, first in zip(self.parts, ends, strict=False)
        ]
        return signals[0] if len(signals) == 1 else added(signals)

    def check_harmonics(self, signal: Signal, dt: float) -> None:
        """Raise ValueError for a harmonic of fewer than two samples, which looks like another."""
        continuous = [i for i in range(len(signal.output)) if i not in signal.discrete]
        rates = np.linalg.eigvals(signal.slope[np.ix_(continuous, continuous)])
        fastest = float(rates.imag[np.abs(rates.real) < UNDAMPED * np.abs(rates)].max(initial=0.0))
        if fastest * dt > math.pi * (1.0 + UNDAMPED):
            rule = f"each harmonic of {self.name} must have two samples in its period or more"
            raise ValueError(
                f"{rule}, but one has a period of {2.0 * math.pi / fastest:.4g} s, and dt is {dt:g} s"
            )

    def check_steps(self, dts: Sequence[float] | np.ndarray) -> None:
        """Raise ValueError for steps [s] to times between seasons, where a last quadrature would not be zero."""
        for part in self.parts:
            counts = np.asarray(dts, dtype=np.float64) / (part.apart or math.inf)
            wrong = (np.abs(counts - np.maximum(np.round(counts), 1.0)) > SEASON_ROUNDING) & (
                part.apart is not None
            )
            if wrong.any():
                rule = (
                    f"rows of {part.name} must be {part.apart:g} s apart, or multiples, to {SEASON_ROUNDING:.0%}"
                )
                way = "harmonic:period=SECONDS,harmonics=N takes any steps"
                raise ValueError(f"{rule}, but got {np.asarray(dts)[wrong][0]:g} s: {way}")

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
            first: the first measurement of each axis, or one for all, where a state begins that may begin
                anywhere; stationary ones begin at zero.
            spread: of the data [U]; the prior is the stationary one, or else a hundred times as wide as the data,
                and as fast as that within a step.
            offset: the mean of the data on each axis, about which the signal varies, or one for all.
            quantities: name, symbol and unit of the measurement on each axis.

        Raises:
            ValueError: for a wrong number, and for a harmonic of fewer than two samples, which looks like another.
        """
        signal, axes = self.signal(values), len(quantities)
        self.check_harmonics(signal, dt)
        self.check_steps([dt])
        n, each, (transition, noise_cov) = len(signal.output), np.eye(axes), signal.step(positive("dt", dt))
        offset = np.broadcast_to(np.asarray(offset, dtype=np.float64), axes)
        anywhere = np.isinf(np.diag(signal.first)) & (signal.output != 0.0)
        level = np.eye(n)[int(np.argmax(anywhere))] * anywhere.any()
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
            prior_cov=np.kron(each, signal.start(spread, dt)),
            measurement_offset=offset,
            dt=dt,
            states=states,
            input_quantities=[],
            measurements=list(quantities),
        )


def parts_of(name: str) -> list[str]:
    """The texts that a sum has between its signs; the "+" of a number such as 8.64e+04 is none."""
    return re.split(r"(?<!\d[eE])\+|\+(?!\d)", name)


def named_model(name: str) -> Sum:
    """A model by name, such as "constant-velocity", or a sum, such as "constant + harmonic:period=24,harmonics=2".

    Raises:
        ValueError: for an unknown name; the message has the known ones.
    """
    parts = tuple(_part(part.strip().lower()) for part in parts_of(name))
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
    if name in WITH_SETTINGS:
        return WITH_SETTINGS[name](settings)
    if settings:
        raise ValueError(f"settings must be those of {', '.join(WITH_SETTINGS)}, but got {settings!r} for {name}")
    return NAMED[name]


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
