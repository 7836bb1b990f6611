"""The current that a vehicle goes in: signals to the north, to the east and down [m/s], the same everywhere.

Forces on the vehicle are those of its velocity through the water; its state is the velocity over ground. A filter
whose model has no current takes it for a disturbance.
"""

from __future__ import annotations

from collections.abc import Mapping

from thruster_env.core.checks import short_repr, within
from thruster_env.effects.effects import Effect, Registry
from thruster_env.effects.signals import ConstantSignal, GaussMarkov, Gusts, RecordedSignal, Sinusoid

DIRECTIONS = ("north", "east", "down")
FASTEST = 100.0  # [m/s]: beyond it there is no water
CURRENT_SIGNALS = Registry("current")
for _name, _signal in {
    "constant": ConstantSignal,
    "gauss-markov": GaussMarkov,
    "sinusoid": Sinusoid,
    "gusts": Gusts,
    "recorded": RecordedSignal,
}.items():
    CURRENT_SIGNALS.register(_name)(_signal)

Current = dict[str, tuple[Effect, ...]]


def make_current(given) -> Current:
    """Signals by direction, from None, three numbers (north, east, down) [m/s] or a mapping from directions.

    Each entry of a mapping is a number or a list of signals of CURRENT_SIGNALS, which are added:
    {"north": 0.2, "east": [{"name": "gauss-markov", "std": 0.1, "time_constant": 60.0}]}.

    Raises ValueError if an argument is wrong; the message states the rule and the value.
    """
    if given is None:
        return {}
    if not isinstance(given, Mapping):
        entries = list(given) if hasattr(given, "__iter__") and not isinstance(given, str) else []
        if len(entries) != len(DIRECTIONS):
            rule = "current must be three velocities (north, east, down) [m/s] or a mapping from directions"
            raise ValueError(f"{rule}, but got {short_repr(given)}")
        given = dict(zip(DIRECTIONS, entries, strict=True))
    unknown = [direction for direction in given if direction not in DIRECTIONS]
    if unknown:
        raise ValueError(
            f"directions of current must be among {', '.join(DIRECTIONS)}, but got {short_repr(unknown)}"
        )
    found = {direction: _signals(direction, given[direction]) for direction in DIRECTIONS if direction in given}
    return {direction: signals for direction, signals in found.items() if signals}


def _signals(direction: str, given) -> tuple[Effect, ...]:
    plain = not isinstance(given, (Mapping, Effect, list, tuple)) and given is not None
    signals = CURRENT_SIGNALS.make({"name": "constant", "value": given} if plain else given)
    within(f"the current {direction}", sum(signal.largest() for signal in signals), FASTEST)
    return tuple(signal for signal in signals if signal != ConstantSignal(0.0))
