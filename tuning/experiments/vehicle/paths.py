"""The vehicle's inputs over time on each of the papers' five paths.

The papers do not define their paths. These are ours with the same names: each starts at rest at the origin,
and on IV the planes are chosen so that the path ends at the printed point, (10, 18, 6) m.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import one_of
from tuning.experiments.vehicle.printed import DT

THRUST = 2.84531  # [N]; holds 1 m/s, the printed speed
TORQUE_ARM = -0.006  # propeller's torque over its thrust [m]
TORQUE = -0.017  # [N m]; that of the constant thrust


class Manoeuvre(NamedTuple):
    """Constant thrust and planes, or ones that change sign."""

    meaning: str
    stern: float  # angle of the stern plane [deg]
    rudder: float  # [deg]
    duration: float  # [s]
    stern_period: float = math.inf  # of a full cycle of the sign [s]
    rudder_period: float = math.inf
    thrust_period: float = math.inf
    thrust_swing: float = 0.0  # as a fraction of the thrust

    @property
    def steps(self) -> int:
        """Steps of DT within the duration."""
        return math.floor(self.duration / DT)

    def inputs(self, steps: int | None = None) -> np.ndarray:
        """X_prop [N], K_prop [N m], delta_s and delta_r [rad] of the first so many steps, all if None, (K, 4)."""
        time = DT * np.arange(self.steps if steps is None else min(steps, self.steps))
        swing = self.thrust_swing * switching(time, self.thrust_period)
        torque = np.full(len(time), TORQUE) if self.thrust_swing == 0.0 else TORQUE_ARM * THRUST * (1.0 + swing)
        stern = math.radians(self.stern) * switching(time, self.stern_period)
        rudder = math.radians(self.rudder) * switching(time, self.rudder_period)
        return np.stack([THRUST * (1.0 + swing), torque, stern, rudder], axis=1)


def switching(time: np.ndarray, period: float) -> np.ndarray:
    """Sign of sin(2 pi t/period), which is 1 at the start and for ever where the period is infinite."""
    return np.where((time / period) % 1.0 < 0.5, 1.0, -1.0)


PATHS = {
    "I": Manoeuvre("turn", 0.0, -5.0, 25.0),
    "II": Manoeuvre("dive", 5.0, 0.0, 25.0),
    "III": Manoeuvre("straight", 0.0, 0.0, 25.0),
    "IV": Manoeuvre("three-dimensional", 6.0483275, -1.3502966, 31.560424),
    "dynamic": Manoeuvre("dynamic", 5.0, 5.0, 25.0, 14.0, 10.0, 9.0, 0.4),
}
"""By name. The meanings of I, II and III are inferred from the order of a conclusion."""


def find_path(name: str) -> Manoeuvre:
    """A path by name; ValueError for an unknown one."""
    return PATHS[one_of("path", name, tuple(PATHS))]
