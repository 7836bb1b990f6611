"""The amplifier between the commanded voltage and the motor: effects that are not in a filter's model."""

from __future__ import annotations

from dataclasses import dataclass

from thruster_env.core.checks import positive
from thruster_env.core.compiled import inlined
from thruster_env.effects.effects import Context, Effect, Registry, set_field
from thruster_env.effects.signals import GaussMarkov, Gusts, RecordedSignal, Sinusoid
from thruster_env.thruster.engine.memory import OMEGA

# Ambient flow U_0 along the thruster's axis [m/s]: signals that add to the constant `ambient_velocity`.


FLOW_SIGNALS = Registry("flow")
for _name, _signal in {
    "sinusoid": Sinusoid,
    "gauss-markov": GaussMarkov,
    "gusts": Gusts,
    "recorded": RecordedSignal,
}.items():
    FLOW_SIGNALS.register(_name)(_signal)


# The context of effects on a thruster.


@dataclass(frozen=True)
class ThrusterContext(Context):
    """The data with which an effect on a thruster computes its parameters."""

    thrust_scale: float  # steady thrust at max_voltage [N]
    back_emf: float  # motor speed to back-EMF, K1/K2 [V s/rad]


AMPLIFIER_EFFECTS = Registry("amplifier")


@inlined
def outside(voltage, low, high):
    """A voltage behind a dead band low ... high: zero within the band, the distance to its end beyond."""
    return voltage - min(max(voltage, low), high)


@inlined
def dead_band(memory, b, target, rows, number, numbers, at, begin):
    """Apply the dead band to the voltage."""
    low, high = numbers[at], numbers[at + 1]
    for j in range(memory.shape[2]):
        memory[b, target, j] = outside(memory[b, target, j], low, high)


@inlined
def slew_limit(memory, b, target, rows, number, numbers, at, begin):
    """Limit the change of the voltage per step; it starts from zero."""
    change = numbers[at]
    for j in range(memory.shape[2]):
        before = 0.0 if begin else memory[b, rows, j]
        after = min(max(memory[b, target, j], before - change), before + change)
        memory[b, target, j] = after
        memory[b, rows, j] = after


@inlined
def saturation(memory, b, target, rows, number, numbers, at, begin):
    """Clip to plus and minus a limit."""
    limit = numbers[at]
    for j in range(memory.shape[2]):
        memory[b, target, j] = min(max(memory[b, target, j], -limit), limit)


@inlined
def sag(memory, b, target, rows, number, numbers, at, begin):
    """Lose a fraction of the voltage that drives current, V_s - k_e omega_m."""
    fraction, back_emf = numbers[at], numbers[at + 1]
    for j in range(memory.shape[2]):
        driving = memory[b, target, j] - back_emf * memory[b, OMEGA, j]
        memory[b, target, j] -= 0.0 if begin else fraction * driving


@AMPLIFIER_EFFECTS.register("dead-band")
@dataclass(frozen=True)
class DeadBand(Effect):
    """Dead band: no voltage within plus and minus `width` [V]; beyond, the voltage minus the width.

    If the band astern differs, it is `astern` [V], and `width` is that ahead.
    """

    width: float
    astern: float | None = None
    act = staticmethod(dead_band)

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "width", positive("width", self.width, zero_allowed=True))
        if self.astern is not None:
            set_field(self, "astern", positive("astern", self.astern, zero_allowed=True))

    def parameters(self, context: Context) -> list[float]:
        """The band's ends [V]."""
        return [-self.width if self.astern is None else -self.astern, self.width]

    def as_mapping(self) -> dict:
        """As plain data; without `astern` where the band is symmetric."""
        mapping = super().as_mapping()
        return {name: value for name, value in mapping.items() if value is not None}


def dead_band_of(low: float, high: float) -> tuple[DeadBand, ...]:
    """The dead band of ends low <= 0 <= high [V] as an effect; none where both are zero."""
    return () if low == high else (DeadBand(high, -low),)


@AMPLIFIER_EFFECTS.register("slew-limit")
@dataclass(frozen=True)
class SlewLimit(Effect):
    """A voltage that changes by at most `rate` [V/s], from zero at the start of an episode."""

    rate: float
    act = staticmethod(slew_limit)

    def __post_init__(self):
        """Check the argument."""
        set_field(self, "rate", positive("rate", self.rate))

    def parameters(self, context: Context) -> list[float]:
        """The largest change in a step [V]."""
        return [self.rate * context.dt]

    def rows(self, context: Context) -> int:
        """The voltage of the last step."""
        return 1


@AMPLIFIER_EFFECTS.register("saturation")
@dataclass(frozen=True)
class AmplifierSaturation(Effect):
    """A voltage within plus and minus `limit` [V], less than the action space's bound to matter."""

    limit: float
    act = staticmethod(saturation)

    def __post_init__(self):
        """Check the argument."""
        set_field(self, "limit", positive("limit", self.limit))


@AMPLIFIER_EFFECTS.register("sag")
@dataclass(frozen=True)
class Sag(Effect):
    """A supply whose voltage drops under load: `fraction` of V_s - k_e omega_m is lost in its resistance.

    With the resistance r of the supply and R_a of the armature, the fraction is r/(r + R_a). The motor's constant
    is k_e = K1/K2 of the nominal parameters (a brushed motor without friction), the speed that before the step.
    """

    fraction: float
    act = staticmethod(sag)

    def __post_init__(self):
        """Check the argument."""
        fraction = positive("fraction", self.fraction, zero_allowed=True)
        if fraction >= 1:
            raise ValueError(f"fraction must be less than 1, but got {self.fraction!r}")
        set_field(self, "fraction", fraction)

    def parameters(self, context: ThrusterContext) -> list[float]:
        """Fraction and back-EMF constant [V s/rad]."""
        return [self.fraction, context.back_emf]
