"""Inputs of the vehicle's scenarios: any excitation of thrust and planes, and the manoeuvres of the papers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thruster_env.auv.paths import MANOEUVRES
from thruster_env.auv.plant import Plant
from thruster_env.core.checks import one_of
from thruster_env.effects.effects import set_field
from tuning.problems.excitation import EXCITATIONS, Excitation

TORQUE = 1  # index of K_prop among the inputs of a manoeuvre


@EXCITATIONS.register("manoeuvre")
@dataclass(frozen=True)
class OfManoeuvre(Excitation):
    """Thrust and planes of one of the vehicle's manoeuvres, the same for every seed; the last values are held."""

    path: str = "IV"

    def __post_init__(self):
        """Check the arguments."""
        set_field(self, "path", one_of("path", self.path, tuple(MANOEUVRES)))

    def inputs(self, keys: np.ndarray, steps: int, dt: float, count: int) -> np.ndarray:
        """Inputs (B, steps, count): with the propeller's torque if there are four of them, without if three."""
        if count not in (3, 4):
            raise ValueError(
                f"the excitation 'manoeuvre' must be a vehicle's, with 3 or 4 inputs, but got {count}"
            )
        manoeuvre = MANOEUVRES[self.path]
        times = np.minimum((np.arange(steps) + 0.5) * dt, manoeuvre.duration)
        each = np.array([manoeuvre.inputs(time) for time in times.tolist()])
        each = each if count == 4 else np.delete(each, TORQUE, axis=1)
        return np.broadcast_to(each, (len(keys), *each.shape)).copy()


def commands_of(excitation: Excitation, plant: Plant, keys: np.ndarray, steps: int) -> np.ndarray:
    """Thrust, the torque where it is an input, and planes (B, steps, p), clipped to the limits of the env."""
    low, high = plant.input_limits
    return np.clip(excitation.inputs(keys, steps, plant.dt, len(plant.inputs)), low, high)
