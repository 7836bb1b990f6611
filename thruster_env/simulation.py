"""Whole trajectories of a plant, without an env around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thruster_env.engine.copies import Copies
from thruster_env.engine.memory import FLOW, OMEGA, READINGS, REPORTED, THRUST, VALID
from thruster_env.plant import Plant
from thruster_env.task import Task


class Simulation(NamedTuple):
    """Trajectories of a batch of B plants over K steps."""

    states: np.ndarray  # (B, K + 1, 2)
    thrusts: np.ndarray  # (B, K + 1) [N]
    measurements: np.ndarray  # (B, K + 1, m)
    valid: np.ndarray  # (B, K + 1, m), false where a measurement is missing and the last one repeated

    def checked(self, what: str = "a simulation") -> Simulation:
        """The same; ValueError that names the first step at which a number is not finite."""
        parts = (self.states, self.thrusts[..., None], self.measurements)
        finite = np.all([np.isfinite(part).all(axis=(0, 2)) for part in parts], axis=0)
        if not finite.all():
            raise ValueError(
                f"{what} must stay finite, but it is not from step {np.argmin(finite)} of {len(finite) - 1} on: "
                "mind dt and the noise covariances"
            )
        return self


def simulate(plant: Plant, keys: np.ndarray, voltages: np.ndarray) -> Simulation:
    """Run a plant from its initial state for every key (B, 2) under voltages (B, K) [V].

    The same key and voltages give the same numbers as an env that is stepped through Gymnasium.

    Raises:
        ValueError: if shapes do not fit or a number is not finite.
    """
    keys, voltages = (np.ascontiguousarray(a, dtype=np.float64) for a in (keys, voltages))
    if keys.ndim != 2 or keys.shape[1] != 2 or not np.isfinite(keys).all():
        raise ValueError(f"keys must be finite and of shape (B, 2), but got shape {keys.shape}")
    if voltages.ndim != 2 or len(voltages) != len(keys) or np.isnan(voltages).any():
        rule = f"without NaN and of shape ({len(keys)}, K), one row a key"
        raise ValueError(f"voltages must be {rule}, but got shape {voltages.shape}")
    copies = Copies(plant, Task(), len(keys))
    record = np.empty((voltages.shape[1] + 1, REPORTED, len(keys)))
    record[0] = copies.begin(keys)
    for k, voltage in enumerate(voltages.T):
        record[k + 1] = copies.step(voltage)
    m = len(plant.channels)
    record = np.ascontiguousarray(record.transpose(2, 0, 1))
    readings = record[..., READINGS : READINGS + m]
    valid = record[..., VALID : VALID + m] > 0 if plant.dropping_channels else np.ones(readings.shape, dtype=bool)
    return Simulation(record[..., OMEGA : FLOW + 1], record[..., THRUST], readings, valid)
