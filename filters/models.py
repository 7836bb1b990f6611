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

from filters.signals import (
    Signal,
    added,
    autoregression,
    constant,
    constant_acceleration,
    constant_velocity,
    harmonics,
    local_trend,
    ornstein_uhlenbeck,
    oscillator,
    seasonal,
    singer,
)
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
            start=_first_partials if i == 1 else _further_partials,
            log=False,
        )
        for i in range(1, int(settings) + 1)
    )
    free = *partials, _std("std", "standard deviation of the signal")
    about = f"an autoregression of order {settings}, in equal steps"
    return NamedModel(f"ar:{settings}", about, free, autoregression, about_mean=True)


def _first_partials(scales: Scales) -> Sequence[float]:
    return 0.8, 0.2, -0.5


def _further_partials(scales: Scales) -> Sequence[float]:
    return 0.4, -0.4


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
