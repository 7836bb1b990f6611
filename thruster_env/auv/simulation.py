"""Whole trajectories of a plant, without an env around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thruster_env.auv.engine.copies import Copies
from thruster_env.auv.engine.memory import CURRENT, READINGS, STATE, VALID, N
from thruster_env.auv.plant import Plant
from thruster_env.auv.task import make_task
from thruster_env.env.record import check_finite, record


class Simulation(NamedTuple):
    """Trajectories of a batch of B vehicles over K steps."""

    states: np.ndarray  # (B, K + 1, 12)
    measurements: np.ndarray  # (B, K + 1, m)
    valid: np.ndarray  # (B, K + 1, m), false where a measurement is missing and the last one repeated
    current: np.ndarray  # (B, K + 1, 3), to the north, to the east and down [m/s]

    def checked(self, what: str = "a simulation") -> Simulation:
        """The same; ValueError that names the first step at which a number is not finite."""
        check_finite(what, self.states, self.measurements)
        return self


def simulate(plant: Plant, keys: np.ndarray, inputs: np.ndarray) -> Simulation:
    """Run a plant from its initial state for every key (B, 2) under inputs (B, K, p).

    The same key and inputs give the same numbers as an env that is stepped through Gymnasium.

    Raises:
        ValueError: if shapes do not fit or a number is not finite.
    """
    m = len(plant.channels)
    reports = record(lambda count: Copies(plant, make_task(), count), keys, inputs, "inputs", len(plant.inputs))
    valid = reports[..., VALID : VALID + m] > 0.0
    parts = (reports[..., first : first + count] for first, count in ((STATE, N), (READINGS, m), (CURRENT, 3)))
    states, measurements, current = parts
    return Simulation(states, measurements, valid, current)
