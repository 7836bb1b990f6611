"""Five manoeuvres instead of the papers' paths, which are named there but not defined.

All begin at rest at the origin, at the depth 0. Path IV has constant inputs that end where the papers' does, 10 m
to the north, 18 m to the east, 6 m down; the dynamic one switches planes and propeller to and fro.
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np

from thruster_env.auv.dynamics import navigation_substep
from thruster_env.auv.parameters import derive_constants
from thruster_env.auv.presets import SEGOROGENI
from thruster_env.core.checks import one_of

CRUISE_THRUST = 2.845  # [N], holds 1 m/s
CRUISE_TORQUE = -0.017  # [N m]
TORQUE_PER_THRUST = -0.006  # [m], of the dynamic manoeuvre
LONGEST_STEP = 0.05  # [s]


class Manoeuvre(NamedTuple):
    """Planes [deg] over a time [s], held or, with periods [s], switched as the sign of a sine."""

    stern: float
    rudder: float
    duration: float
    stern_period: float | None = None
    rudder_period: float | None = None
    thrust_period: float | None = None
    thrust_swing: float = 0.0  # of the cruise thrust

    def inputs(self, time: float) -> tuple[float, float, float, float]:
        """X_prop [N], K_prop [N m], delta_s and delta_r [rad] at a time [s]."""
        thrust, torque = CRUISE_THRUST, CRUISE_TORQUE
        if self.thrust_period is not None:
            thrust *= 1.0 + self.thrust_swing * _switched(time, self.thrust_period)
            torque = TORQUE_PER_THRUST * thrust
        stern = math.radians(self.stern) * _switched(time, self.stern_period)
        return thrust, torque, stern, math.radians(self.rudder) * _switched(time, self.rudder_period)


MANOEUVRES: dict[str, Manoeuvre] = {
    "I": Manoeuvre(0.0, -5.0, 25.0),
    "II": Manoeuvre(5.0, 0.0, 25.0),
    "III": Manoeuvre(0.0, 0.0, 25.0),
    "IV": Manoeuvre(6.0483275, -1.3502966, 31.560424),
    "dynamic": Manoeuvre(5.0, 5.0, 25.0, 14.0, 10.0, 9.0, 0.4),
}
"""Manoeuvres by the papers' names: turn, dive, straight, in three dimensions, dynamic."""


@cache
def run(name: str) -> np.ndarray:
    """States (K + 1, 12) of Segorogeni's noise-free run of a manoeuvre, at most 0.05 s apart."""
    manoeuvre = MANOEUVRES[one_of("path", name, tuple(MANOEUVRES))]
    count = math.ceil(manoeuvre.duration / LONGEST_STEP - 1e-9)
    step = manoeuvre.duration / count
    c, x = derive_constants(SEGOROGENI, step), (0.0,) * 12
    states = [x]
    for k in range(count):
        x = navigation_substep(x, manoeuvre.inputs((k + 0.5) * step), c)
        states.append(x)
    found = np.array(states)
    found.setflags(write=False)
    return found


def _switched(time: float, period: float | None) -> float:
    """The sign of sin(2 pi t/period), 1 without a period; asked in the middle of a step it is never zero."""
    return 1.0 if period is None else math.copysign(1.0, math.sin(2.0 * math.pi * time / period))
