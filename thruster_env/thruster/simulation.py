"""Trajectories of a plant, without an env around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thruster_env.env.record import check_finite, record
from thruster_env.thruster.engine.copies import Copies
from thruster_env.thruster.engine.memory import FLOW, OMEGA, READINGS, THRUST, VALID
from thruster_env.thruster.plant import Plant
from thruster_env.thruster.task import Task


class Simulation(NamedTuple):
    """Trajectories of a batch of B plants over K steps."""

    states: np.ndarray  # (B, K + 1, 2)
    thrusts: np.ndarray  # (B, K + 1) [N]
    measurements: np.ndarray  # (B, K + 1, m)
    valid: np.ndarray  # (B, K + 1, m), false where a measurement is missing and the last one repeated

    def checked(self, what: str = "a simulation") -> Simulation:
        """The same; ValueError that names the first step at which a number is not finite."""
        check_finite(what, self.states, self.thrusts[..., None], self.measurements)
        return self


def simulate(plant: Plant, keys: np.ndarray, voltages: np.ndarray) -> Simulation:
    """Run a plant from its initial state for every key (B, 2) under voltages (B, K) [V].

    The same key and voltages give the same numbers as an env that is stepped through Gymnasium.

    Raises:
        ValueError: if shapes do not fit or a number is not finite.
    """
    reports = record(lambda count: Copies(plant, Task(), count), keys, voltages, "voltages", 1)
    m = len(plant.channels)
    readings = reports[..., READINGS : READINGS + m]
    valid = reports[..., VALID : VALID + m] > 0 if plant.dropping_channels else np.ones(readings.shape, dtype=bool)
    return Simulation(reports[..., OMEGA : FLOW + 1], reports[..., THRUST], readings, valid)
