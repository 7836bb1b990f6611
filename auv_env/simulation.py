"""Whole trajectories of a vehicle, without an env around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from auv_env.engine.copies import Copies
from auv_env.engine.memory import CURRENT, READINGS, STATE, VALID, N
from auv_env.plant import Plant
from auv_env.task import make_task
from plants.trajectories import check_finite, recorded


class Simulation(NamedTuple):
    """Trajectories of a batch of B vehicles over K steps."""

    states: np.ndarray  # (B, K + 1, 12)
    current: np.ndarray  # (B, K + 1, 3) to the north, to the east, down [m/s]
    measurements: np.ndarray  # (B, K + 1, m)
    valid: np.ndarray  # (B, K + 1, m), false where a measurement is missing and the last one repeated

    def checked(self, what: str = "a simulation") -> Simulation:
        """The same; ValueError that names the first step at which a number is not finite."""
        check_finite(what, self.states, self.measurements)
        return self


def simulate(plant: Plant, keys: np.ndarray, inputs: np.ndarray) -> Simulation:
    """Run a vehicle from its initial state for every key (B, 2) under inputs (B, K, p), thrust and planes.

    The same key and inputs give the same numbers as an env that is stepped through Gymnasium; no episode ends.

    Raises:
        ValueError: if shapes do not fit, or an input is NaN.
    """
    record = recorded(Copies(plant, make_task(), len(keys)), keys, inputs)
    m = len(plant.channels)
    readings = record[..., READINGS : READINGS + m]
    valid = record[..., VALID : VALID + m] > 0 if plant.dropping_channels else np.ones(readings.shape, dtype=bool)
    return Simulation(record[..., STATE : STATE + N], record[..., CURRENT : CURRENT + 3], readings, valid)
