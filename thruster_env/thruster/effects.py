"""Disturbances of a thruster: amplifier, ambient flow, reference signals and uncertain parameters.

None of them is in a filter's model, except the dead band of a preset.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import Field, asdict, dataclass
from typing import Any, ClassVar

import numpy as np

from thruster_env.core.checks import finite, one_of, positive, short_repr, vector
from thruster_env.core.compiled import inlined
from thruster_env.core.memory import KEY_0, KEY_1, STEP
from thruster_env.core.streams import PARAMETERS, REFERENCE_SIGNAL, normal_block, uniform_block
from thruster_env.effects.effects import LONGEST, Context, Effect, Registry, not_negative, set_field
from thruster_env.effects.signals import (
    ConstantSignal,
    GaussMarkov,
    Gusts,
    RecordedSeries,
    RecordedSignal,
    Sinusoid,
    recorded_value,
)
from thruster_env.thruster.parameters import ThrusterParameters, checked

# Ambient flow U_0 along the thruster's axis [m/s]: signals that add to the constant `ambient_velocity`.


FLOW_SIGNALS = Registry(
    "flow", {"sinusoid": Sinusoid, "gauss-markov": GaussMarkov, "gusts": Gusts, "recorded": RecordedSignal}
)


# The context of effects on a thruster.


@dataclass(frozen=True)
class ThrusterContext(Context):
    """The data with which an effect on a thruster computes its parameters."""

    thrust_scale: float  # steady thrust at max_voltage [N]
    back_emf: float  # motor speed to back-EMF, K1/K2 [V s/rad]
    speed_row: int  # of the memory: the motor speed [rad/s]


# The amplifier between the commanded voltage and the motor.


AMPLIFIER_EFFECTS = Registry("amplifier")


@inlined
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

    def parameters(self, context: Context) -> list[float]:
        """The band's ends [V]."""
        return [-self.width if self.astern is None else -self.astern, self.width]

    def as_mapping(self) -> dict:
        """As plain data; without `astern` where the band is symmetric."""
        mapping = super().as_mapping()
        return {name: value for name, value in mapping.items() if value is not None}

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Apply the dead band to the voltage."""
        low, high = numbers[at], numbers[at + 1]
        for j in range(memory.shape[2]):
            memory[b, target, j] = outside(memory[b, target, j], low, high)


def dead_band_of(low: float, high: float) -> tuple[DeadBand, ...]:
    """The dead band of ends low <= 0 <= high [V] as an effect; none where both are zero."""
    return () if low == high else (DeadBand(high, -low),)


@AMPLIFIER_EFFECTS.register("slew-limit")
@dataclass(frozen=True)
class SlewLimit(Effect):
    """A voltage that changes by at most `rate` [V/s], from zero at the start of an episode."""

    rate: float
    checks = {"rate": positive}
    row_count = 1  # the voltage of the last step

    def parameters(self, context: Context) -> list[float]:
        """The largest change in a step [V]."""
        return [self.rate * context.dt]

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Limit the change of the voltage per step; it starts from zero."""
        change = numbers[at]
        for j in range(memory.shape[2]):
            before = 0.0 if begin else memory[b, rows, j]
            after = min(max(memory[b, target, j], before - change), before + change)
            memory[b, target, j] = after
            memory[b, rows, j] = after


@AMPLIFIER_EFFECTS.register("saturation")
@dataclass(frozen=True)
class AmplifierSaturation(Effect):
    """A voltage within plus and minus `limit` [V], less than the action space's bound to matter."""

    limit: float
    checks = {"limit": positive}

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Clip to plus and minus a limit."""
        limit = numbers[at]
        for j in range(memory.shape[2]):
            memory[b, target, j] = min(max(memory[b, target, j], -limit), limit)


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

    def parameters(self, context: ThrusterContext) -> list[float]:
        """Fraction, back-EMF constant [V s/rad], row of the motor speed."""
        return [self.fraction, context.back_emf, context.speed_row]

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Lose a fraction of the voltage that drives current, V_s - k_e omega_m."""
        fraction, back_emf, speed = numbers[at], numbers[at + 1], int(numbers[at + 2])
        for j in range(memory.shape[2]):
            driving = memory[b, target, j] - back_emf * memory[b, speed, j]
            memory[b, target, j] -= 0.0 if begin else fraction * driving


# Reference thrust: signals that the thruster has to follow; those of a list are added.
#
# Levels are fractions of T_max, the steady thrust at max_voltage, so that one reference fits every preset. Random
# values are drawn for each episode. Observation k holds r_{k+1}, so each signal works one step ahead.


REFERENCE_SIGNALS = Registry("reference")


@inlined
def _uniform(memory, b, j, number, index):
    u, _, _, _ = uniform_block(number, index, REFERENCE_SIGNAL, memory[b, KEY_0, j], memory[b, KEY_1, j])
    return u


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

    def parameters(self, context: ThrusterContext) -> list[float]:
        """The thrust [N]."""
        if self.level is not None:
            return [self.level * context.thrust_scale]
        assert self.thrust is not None  # one of the two is given
        return [self.thrust]


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

    def parameters(self, context: ThrusterContext) -> list[float]:
        """Lowest and highest level [N], steps between two levels."""
        hold = max(1.0, round(self.hold_time / context.dt))
        return [self.low * context.thrust_scale, self.high * context.thrust_scale, hold]


@REFERENCE_SIGNALS.register("steps")
@dataclass(frozen=True)
class Steps(_Levels):
    """Levels drawn between `low` and `high` [T_max], each held for `hold_time` [s]."""

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Add levels that are drawn from an interval and held."""
        low, high, hold = numbers[at], numbers[at + 1], numbers[at + 2]
        for j in range(memory.shape[2]):
            part = math.floor((memory[b, STEP, j] + 1.0) / hold)
            u = _uniform(memory, b, j, number, part)
            memory[b, target, j] += low + (high - low) * u


@REFERENCE_SIGNALS.register("ramps")
@dataclass(frozen=True)
class Ramps(_Levels):
    """Straight lines between levels drawn from `low` to `high` [T_max], each line taking `hold_time` [s]."""

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Add straight lines between levels that are drawn from an interval."""
        low, high, hold = numbers[at], numbers[at + 1], numbers[at + 2]
        for j in range(memory.shape[2]):
            position = (memory[b, STEP, j] + 1.0) / hold
            part = math.floor(position)
            before, after = _uniform(memory, b, j, number, part), _uniform(memory, b, j, number, part + 1.0)
            memory[b, target, j] += low + (high - low) * (before + (position - part) * (after - before))


@REFERENCE_SIGNALS.register("prbs")
@dataclass(frozen=True)
class BinarySequence(_Levels):
    """Pseudo-random binary sequence: `low` or `high` [T_max] with equal chance, drawn every `hold_time` [s]."""

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Add a pseudo-random binary sequence: one of two levels, drawn and held."""
        low, high, hold = numbers[at], numbers[at + 1], numbers[at + 2]
        for j in range(memory.shape[2]):
            part = math.floor((memory[b, STEP, j] + 1.0) / hold)
            u = _uniform(memory, b, j, number, part)
            memory[b, target, j] += high if u < 0.5 else low


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

    def parameters(self, context: ThrusterContext) -> list[float]:
        """Offset and amplitude [N], sample time [s], number of sines, their periods [s]."""
        scale = context.thrust_scale
        return [self.offset * scale, self.amplitude * scale, context.dt, float(len(self.periods)), *self.periods]

    def rows(self, context: ThrusterContext) -> int:
        """The phases."""
        return len(self.periods)

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Add sines of equal amplitude with phases that are drawn."""
        offset, amplitude, dt, count = numbers[at], numbers[at + 1], numbers[at + 2], int(numbers[at + 3])
        for j in range(memory.shape[2]):
            memory[b, target, j] += offset
            for i in range(count):
                if begin:
                    u = _uniform(memory, b, j, number, i)
                    memory[b, rows + i, j] = 2.0 * math.pi * u
                time = (memory[b, STEP, j] + 1.0) * dt
                phase = 2.0 * math.pi * time / numbers[at + 4 + i] + memory[b, rows + i, j]
                memory[b, target, j] += amplitude * math.sin(phase)


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
    row_count = 2  # the states of the low-pass

    def parameters(self, context: ThrusterContext) -> list[float]:
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
        numbers = [*a.ravel(), *b.ravel(), *c.ravel(), root[0, 0], root[1, 0], root[1, 1]]
        return [self.offset * context.thrust_scale, *map(float, numbers)]

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Add white noise through a low-pass, x' = A x + b n, r = c x, stationary from the start."""
        offset = numbers[at]
        for j in range(memory.shape[2]):
            step = memory[b, STEP, j] + 1.0
            n, m, _, _ = normal_block(number, step, REFERENCE_SIGNAL, memory[b, KEY_0, j], memory[b, KEY_1, j])
            x, y = memory[b, rows, j], memory[b, rows + 1, j]
            if begin:
                memory[b, rows, j] = numbers[at + 9] * n
                memory[b, rows + 1, j] = numbers[at + 10] * n + numbers[at + 11] * m
            else:
                memory[b, rows, j] = numbers[at + 1] * x + numbers[at + 2] * y + numbers[at + 5] * n
                memory[b, rows + 1, j] = numbers[at + 3] * x + numbers[at + 4] * y + numbers[at + 6] * n
            memory[b, target, j] += offset
            memory[b, target, j] += numbers[at + 7] * memory[b, rows, j] + numbers[at + 8] * memory[b, rows + 1, j]


@REFERENCE_SIGNALS.register("recorded")
@dataclass(frozen=True)
class RecordedReference(RecordedSeries):
    """A recorded reference thrust; its values are in newtons."""

    @staticmethod
    @inlined
    def act(memory, b, target, rows, number, numbers, at, begin):
        """Add a recorded series."""
        for j in range(memory.shape[2]):
            time = (memory[b, STEP, j] + 1.0) * numbers[at]
            memory[b, target, j] += recorded_value(time, numbers, at + 1)


# Uncertain parameters: factors on a preset's values, drawn once per episode from its key.


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

    def factors(self, number: int, keys: np.ndarray) -> np.ndarray:
        """Factors of the number-th uncertain parameter for keys (B, 2), shape (B,)."""
        u = uniform_block(number, 0, PARAMETERS, keys[:, 0].astype(np.uint64), keys[:, 1].astype(np.uint64))[0]
        return self.low + (self.high - self.low) * u

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

    def factors(self, number: int, keys: np.ndarray) -> np.ndarray:
        """Factors of the number-th uncertain parameter for keys (B, 2), shape (B,)."""
        n = normal_block(number, 0, PARAMETERS, keys[:, 0].astype(np.uint64), keys[:, 1].astype(np.uint64))[0]
        return np.exp(self.std * n)

    @property
    def extremes(self) -> tuple[float, float]:
        """Smallest and largest factor for which the integration must be accurate: three standard deviations."""
        return math.exp(-3 * self.std), math.exp(3 * self.std)


DISTRIBUTIONS = {cls.name: cls for cls in (Uniform, LogNormal)}


def make_uncertainty(uncertainty) -> dict[str, Uniform | LogNormal]:
    """Distributions by parameter from None or a mapping such as {"load_gain": {"name": "uniform", ...}}.

    Raises ValueError if an argument is wrong; the message states the rule and the value.
    """
    if uncertainty is None:
        return {}
    if not isinstance(uncertainty, Mapping):
        raise ValueError(
            f"uncertainty must be a mapping from parameters to distributions, but got {short_repr(uncertainty)}"
        )
    distributions = {}
    for parameter, distribution in uncertainty.items():
        one_of("a name in uncertainty", parameter, UNCERTAIN)
        distributions[parameter] = distribution
        if isinstance(distribution, (Uniform, LogNormal)):
            continue
        names = ", ".join(DISTRIBUTIONS)
        rule = f"the distribution of {parameter} must be a mapping with arguments and a name out of {names}"
        if not isinstance(distribution, Mapping) or distribution.get("name") not in tuple(DISTRIBUTIONS):
            raise ValueError(f"{rule}, but got {short_repr(distribution)}")
        arguments = {key: value for key, value in distribution.items() if key != "name"}
        try:
            distributions[parameter] = DISTRIBUTIONS[distribution["name"]](**arguments)
        except TypeError:
            raise ValueError(f"{rule}, but got {short_repr(distribution)}") from None
    return distributions


def drawn_parameters(nominal: ThrusterParameters, uncertainty: Mapping, keys: np.ndarray) -> ThrusterParameters:
    """Parameters of the episodes with keys (B, 2): the uncertain ones as arrays (B,), the others numbers.

    A parameter's draw depends on the key and on the parameter, not on which others are uncertain.
    """
    drawn = {
        name: getattr(nominal, name) * distribution.factors(UNCERTAIN.index(name), keys)
        for name, distribution in uncertainty.items()
    }
    return nominal._replace(**drawn)


def extreme_parameters(nominal: ThrusterParameters, uncertainty: Mapping) -> list[ThrusterParameters]:
    """The nominal parameters and corners of the region they are drawn from, which bound the integration's step.

    All corners for up to five uncertain parameters; of more, those with one parameter or all of them extreme.
    """
    names = list(uncertainty)
    if len(names) <= 5:
        corners = list(itertools.product(*(uncertainty[name].extremes for name in names)))
    else:
        ends = [uncertainty[name].extremes for name in names]
        corners = [tuple(end[side] for end in ends) for side in (0, 1)]
        corners += [
            tuple(end[side] if i == k else 1.0 for i, end in enumerate(ends))
            for k in range(len(names))
            for side in (0, 1)
        ]
    scaled = (
        {name: getattr(nominal, name) * factor for name, factor in zip(names, corner, strict=True)}
        for corner in corners
    )
    return [nominal, *(checked(nominal._replace(**values)) for values in scaled if values)]
