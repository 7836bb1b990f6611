"""Disturbances of a thruster: amplifier, ambient flow, reference signals and uncertain parameters.

None of them is in a filter's model, except the dead band of a preset.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import Field, asdict, dataclass
from typing import Any, ClassVar

import numpy as np

from thruster_env.core.checks import finite, positive, short_repr, vector
from thruster_env.core.streams import PARAMETERS, REFERENCE_SIGNAL
from thruster_env.effects.effects import (
    LONGEST,
    ConstantSignal,
    Context,
    Effect,
    GaussMarkov,
    Gusts,
    RecordedSeries,
    RecordedSignal,
    Registry,
    Sinusoid,
    not_negative,
    recorded_value,
    set_field,
)
from thruster_env.graphs.draws import Draws
from thruster_env.graphs.graphs import where
from thruster_env.thruster.parameters import ThrusterParameters

FLOW_SIGNALS = Registry(
    "flow", {"sinusoid": Sinusoid, "gauss-markov": GaussMarkov, "gusts": Gusts, "recorded": RecordedSignal}
)


@dataclass(frozen=True)
class ThrusterContext(Context):
    """The data with which an effect on a thruster computes its parameters."""

    thrust_scale: float  # steady thrust at max_voltage [N]
    back_emf: float  # motor speed to back-EMF, K1/K2 [V s/rad]


AMPLIFIER_EFFECTS = Registry("amplifier")


def outside(voltage, low, high):
    """A voltage behind a dead band low ... high: zero within the band, the distance to its end beyond."""
    return voltage - min(max(voltage, low), high)


def _width_or_none(name: str, value) -> float | None:
    return None if value is None else not_negative(name, value)


@AMPLIFIER_EFFECTS.register("dead-band")
@dataclass(frozen=True)
class DeadBand(Effect):
    """Dead band: no voltage within plus and minus `width` [V]; beyond, the voltage minus the width.

    If the band astern differs, it is `astern` [V], and `width` is that ahead.
    """

    width: float
    astern: float | None = None
    checks = {"width": not_negative, "astern": _width_or_none}

    def parameters(self, context: Context) -> dict[str, Any]:
        """The band's ends [V]."""
        return {"low": -self.width if self.astern is None else -self.astern, "high": self.width}

    def as_mapping(self) -> dict:
        """As plain data; without `astern` where the band is symmetric."""
        mapping = super().as_mapping()
        return {name: value for name, value in mapping.items() if value is not None}

    @staticmethod
    def act(e, voltage, memory, t):
        """Apply the dead band to the voltage."""
        return outside(voltage, e.low, e.high), memory


@AMPLIFIER_EFFECTS.register("slew-limit")
@dataclass(frozen=True)
class SlewLimit(Effect):
    """A voltage that changes by at most `rate` [V/s], from zero at the start of an episode."""

    rate: float
    checks = {"rate": positive}

    def parameters(self, context: Context) -> dict[str, Any]:
        """The largest change in a step [V]."""
        return {"change": self.rate * context.dt}

    @staticmethod
    def act(e, voltage, before, t):
        """Limit the change of the voltage per step; it starts from zero."""
        before = 0.0 if t.begin else before
        voltage = min(max(voltage, before - e.change), before + e.change)
        return voltage, voltage


@AMPLIFIER_EFFECTS.register("saturation")
@dataclass(frozen=True)
class AmplifierSaturation(Effect):
    """A voltage within plus and minus `limit` [V], less than the action space's bound to matter."""

    limit: float
    checks = {"limit": positive}

    @staticmethod
    def act(e, voltage, memory, t):
        """Clip to plus and minus a limit."""
        return min(max(voltage, -e.limit), e.limit), memory


def _fraction(name: str, value) -> float:
    fraction = not_negative(name, value)
    if fraction >= 1:
        raise ValueError(f"{name} must be less than 1, but got {value!r}")
    return fraction


@AMPLIFIER_EFFECTS.register("sag")
@dataclass(frozen=True)
class Sag(Effect):
    """A supply whose voltage drops under load: `fraction` of V_s - k_e omega_m is lost in its resistance.

    With the resistance r of the supply and R_a of the armature, the fraction is r/(r + R_a). The motor's constant
    is k_e = K1/K2 of the nominal parameters (a brushed motor without friction), the speed that before the step.
    """

    fraction: float
    checks = {"fraction": _fraction}

    def parameters(self, context: ThrusterContext) -> dict[str, Any]:
        """Fraction and back-EMF constant [V s/rad]."""
        return {"fraction": self.fraction, "back_emf": context.back_emf}

    @staticmethod
    def act(e, voltage, memory, t):
        """Lose a fraction of the voltage that drives current, V_s - k_e omega_m."""
        driving = 0.0 if t.begin else voltage - e.back_emf * t.state[0]
        return voltage - e.fraction * driving, memory


# Reference thrust: signals that the thruster has to follow; those of a list are added.
#
# Levels are fractions of T_max, the steady thrust at max_voltage, so that one reference fits every preset. Random
# values are drawn for each episode. Observation k holds r_{k+1}: `t.step` is the number of
# the reference, one ahead of the plant's.


REFERENCE_SIGNALS = Registry("reference")


def _level(t, part):
    """A uniform number that is drawn for a part of the episode."""
    return t.uniforms(REFERENCE_SIGNAL, part)[0]


@REFERENCE_SIGNALS.register("constant")
@dataclass(frozen=True)
class Constant(Effect):
    """One `level` [T_max], or one `thrust` [N]."""

    level: float | None = None
    thrust: float | None = None
    act = staticmethod(ConstantSignal.act)

    def __post_init__(self):
        """Check the arguments."""
        if (self.level is None) == (self.thrust is None):
            rule = "either level or thrust of a constant must be given"
            raise ValueError(f"{rule}, but got {self.level!r} and {self.thrust!r}")
        name = "level" if self.thrust is None else "thrust"
        set_field(self, name, finite(name, getattr(self, name)))

    def parameters(self, context: ThrusterContext) -> dict[str, Any]:
        """The thrust [N]."""
        if self.level is not None:
            return {"value": self.level * context.thrust_scale}
        assert self.thrust is not None  # one of the two is given
        return {"value": self.thrust}


def held_time(name: str, value) -> float:
    """Return a time for which a level is held [s]; raise ValueError unless it is positive and at most LONGEST."""
    if (time := positive(name, value)) > LONGEST:
        raise ValueError(f"{name} must be at most {LONGEST:g} s, but got {short_repr(value)}")
    return time


@dataclass(frozen=True)
class _Levels(Effect):
    """Levels between `low` and `high` [T_max], a new one every `hold_time` [s]."""

    low: float = 0.1
    high: float = 0.8
    hold_time: float = 1.0

    def __post_init__(self):
        """Check the arguments."""
        low, high = finite("low", self.low), finite("high", self.high)
        if low > high:
            raise ValueError(f"low must be at most high, but got {self.low!r} and {self.high!r}")
        set_field(self, "low", low)
        set_field(self, "high", high)
        set_field(self, "hold_time", held_time("hold_time", self.hold_time))

    def parameters(self, context: ThrusterContext) -> dict[str, Any]:
        """Lowest and highest level [N], steps between two levels."""
        hold, scale = max(1.0, round(self.hold_time / context.dt)), context.thrust_scale
        return {"low": self.low * scale, "high": self.high * scale, "hold": float(hold)}


@REFERENCE_SIGNALS.register("steps")
@dataclass(frozen=True)
class Steps(_Levels):
    """Levels drawn between `low` and `high` [T_max], each held for `hold_time` [s]."""

    @staticmethod
    def act(e, value, memory, t):
        """Add levels that are drawn from an interval and held."""
        u = _level(t, math.floor(t.step / e.hold))
        return value + e.low + (e.high - e.low) * u, memory


@REFERENCE_SIGNALS.register("ramps")
@dataclass(frozen=True)
class Ramps(_Levels):
    """Straight lines between levels drawn from `low` to `high` [T_max], each line taking `hold_time` [s]."""

    @staticmethod
    def act(e, value, memory, t):
        """Add straight lines between levels that are drawn from an interval."""
        position = t.step / e.hold
        part = math.floor(position)
        before, after = _level(t, part), _level(t, part + 1.0)
        return value + e.low + (e.high - e.low) * (before + (position - part) * (after - before)), memory


@REFERENCE_SIGNALS.register("prbs")
@dataclass(frozen=True)
class BinarySequence(_Levels):
    """Pseudo-random binary sequence: `low` or `high` [T_max] with equal chance, drawn every `hold_time` [s]."""

    @staticmethod
    def act(e, value, memory, t):
        """Add a pseudo-random binary sequence: one of two levels, drawn and held."""
        u = _level(t, math.floor(t.step / e.hold))
        return value + where(u < 0.5, e.high, e.low), memory


def _periods(name: str, values) -> tuple[float, ...]:
    return tuple(positive(name, period) for period in vector(name, values))


@REFERENCE_SIGNALS.register("multi-sine")
@dataclass(frozen=True)
class MultiSine(Effect):
    """Sines of equal `amplitude` [T_max], given `periods` [s] and drawn phases, added to `offset` [T_max]."""

    amplitude: float = 0.1
    offset: float = 0.4
    periods: tuple[float, ...] = (4.0, 1.7, 0.7)
    checks = {"amplitude": finite, "offset": finite, "periods": _periods}

    def parameters(self, context: ThrusterContext) -> dict[str, Any]:
        """Offset and amplitude [N], periods [s]."""
        scale = context.thrust_scale
        return {"offset": self.offset * scale, "amplitude": self.amplitude * scale, "periods": self.periods}

    @staticmethod
    def act(e, value, phases, t):
        """Add sines of equal amplitude with phases that are drawn."""
        if t.begin:
            phases = tuple(2.0 * math.pi * _level(t, float(i)) for i in range(len(e.periods)))
        time = t.step * t.dt
        pairs = zip(e.periods, phases, strict=True)
        sines = [math.sin(2.0 * math.pi * time / period + phase) for period, phase in pairs]
        return value + e.offset + e.amplitude * sum(sines), phases


LEAST_BANDWIDTH = 1e-5  # of the sample rate; a narrower low-pass is lost in rounding


@REFERENCE_SIGNALS.register("band-limited-noise")
@dataclass(frozen=True)
class BandLimitedNoise(Effect):
    """Gaussian noise of standard deviation `std` [T_max] about `offset`, below `bandwidth` [Hz].

    White noise through a second-order Butterworth low-pass.
    """

    std: float = 0.15
    offset: float = 0.4
    bandwidth: float = 0.5
    checks = {"std": not_negative, "offset": finite, "bandwidth": positive}

    def parameters(self, context: ThrusterContext) -> dict[str, Any]:
        """Offset [N]; A, b, c of the filter with unit variance times std [N]; root of the state's covariance."""
        from scipy.linalg import solve_discrete_lyapunov
        from scipy.signal import butter, tf2ss

        low, high = LEAST_BANDWIDTH / context.dt, 0.5 / context.dt
        if not low <= self.bandwidth < high:
            rule = f"at least {low:g} Hz and below {high:g} Hz at this dt"
            raise ValueError(f"bandwidth must be {rule}, but got {self.bandwidth}")
        a, b, c, _ = tf2ss(*butter(2, self.bandwidth, fs=1.0 / context.dt))
        cov = solve_discrete_lyapunov(a, b @ b.T)
        c = c * self.std * context.thrust_scale / float((c @ cov @ c.T).item()) ** 0.5
        root = np.linalg.cholesky(cov)
        parts = {"a": a, "b": b, "c": c, "root": root[np.tril_indices(2)]}
        numbers = {name: tuple(part.ravel().tolist()) for name, part in parts.items()}
        return {"offset": self.offset * context.thrust_scale} | numbers

    @staticmethod
    def act(e, value, memory, t):
        """Add white noise through a low-pass, x' = A x + b n, r = c x, stationary from the start."""
        n, m, _, _ = t.normals(REFERENCE_SIGNAL)
        if t.begin:
            x, y = e.root[0] * n, e.root[1] * n + e.root[2] * m
        else:
            x, y = memory
            x, y = e.a[0] * x + e.a[1] * y + e.b[0] * n, e.a[2] * x + e.a[3] * y + e.b[1] * n
        return value + e.offset + (e.c[0] * x + e.c[1] * y), (x, y)


@REFERENCE_SIGNALS.register("recorded")
@dataclass(frozen=True)
class RecordedReference(RecordedSeries):
    """A recorded reference thrust; its values are in newtons."""

    @staticmethod
    def act(e, value, memory, t):
        """Add a recorded series."""
        return value + recorded_value(e, t.step * t.dt), memory


UNCERTAIN = tuple(name for name in ThrusterParameters._fields if name not in ("angles", "thrust_asymmetry"))


class _Distribution:
    __dataclass_fields__: ClassVar[dict[str, Field[Any]]]  # every distribution is a dataclass
    name: ClassVar[str]

    def as_mapping(self) -> dict:
        """The distribution as JSON can hold it: its name and its arguments."""
        return {"name": self.name, **asdict(self)}


@dataclass(frozen=True)
class Uniform(_Distribution):
    """A factor drawn uniformly from `low` to `high`."""

    low: float
    high: float
    name: ClassVar[str] = "uniform"

    def __post_init__(self):
        """Check the arguments."""
        low, high = positive("low", self.low), positive("high", self.high)
        if low > high:
            raise ValueError(f"low must be at most high, but got {self.low!r} and {self.high!r}")
        set_field(self, "low", low)
        set_field(self, "high", high)

    @property
    def numbers(self) -> tuple[float, float]:
        """The numbers of `factor`."""
        return self.low, self.high

    @staticmethod
    def factor(numbers: tuple, number: int, draws: Draws):
        """The factor of the number-th uncertain parameter in an episode."""
        low, high = numbers
        return low + (high - low) * draws.uniforms(PARAMETERS, number)[0]

    @property
    def extremes(self) -> tuple[float, float]:
        """Smallest and largest factor for which the integration must be accurate."""
        return self.low, self.high


@dataclass(frozen=True)
class LogNormal(_Distribution):
    """A factor exp(std n) with a standard normal n: a relative uncertainty of about `std`."""

    std: float
    name: ClassVar[str] = "log-normal"

    def __post_init__(self):
        """Check the argument."""
        std = positive("std", self.std, zero_allowed=True)
        if std > 2:
            raise ValueError(
                f"std must be at most 2, a factor of 7 at one standard deviation, but got {self.std!r}"
            )
        set_field(self, "std", std)

    @property
    def numbers(self) -> tuple[float]:
        """The number of `factor`."""
        return (self.std,)

    @staticmethod
    def factor(numbers: tuple, number: int, draws: Draws):
        """The factor of the number-th uncertain parameter in an episode."""
        return np.exp(numbers[0] * draws.normals(PARAMETERS, block=number)[0])

    @property
    def extremes(self) -> tuple[float, float]:
        """Smallest and largest factor for which the integration must be accurate: three standard deviations."""
        return math.exp(-3 * self.std), math.exp(3 * self.std)


DISTRIBUTIONS = {cls.name: cls for cls in (Uniform, LogNormal)}


def drawn_parameters(nominal: ThrusterParameters, uncertain: Mapping, draws: Draws) -> ThrusterParameters:
    """The parameters of an episode, from its draws of step 0; of keys that are arrays, arrays.

    A parameter's draw depends on the key and on the parameter, not on which others are uncertain.

    Args:
        nominal: the nominal parameters.
        uncertain: the class of the distribution and its numbers, by parameter.
        draws: of step 0.
    """
    factors = {
        name: distribution.factor(numbers, UNCERTAIN.index(name), draws)
        for name, (distribution, numbers) in uncertain.items()
    }
    return nominal._replace(**{name: getattr(nominal, name) * factor for name, factor in factors.items()})
