"""Roll and pitch, measured by an AHRS, as inputs of the model of six velocities.

They act for one step, as the action does, and are not measurements of the model. Their noise drives the model's
states, so that

    Q = Q_plant + B R_a B',   B = df/d(phi, theta) straight ahead,

with the covariance R_a of these two channels, unless Q is given. By the righting moments it affects roll rates
most.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from thruster_env.auv.plant import Plant
from thruster_env.auv.quantities import ATTITUDE_INPUTS

TILT = 1e-4  # rad


def split_channels(channels: tuple[str, ...], states: str, attitude: str) -> tuple[list[int], list[int]]:
    """Places of the channels that are inputs of a model, phi and theta, and of those that it measures.

    Raises ValueError if an attitude that is to be measured is not.
    """
    names = [quantity.symbol for quantity in ATTITUDE_INPUTS]
    if states != "velocities" or attitude != "measured":
        return [], list(range(len(channels)))
    if not set(names) <= set(channels):
        raise ValueError(
            f"sensors of a measured attitude must measure phi and theta, but got {', '.join(channels)}"
        )
    told = [channels.index(name) for name in names]
    return told, [i for i in range(len(channels)) if i not in told]


def derivative_by_attitude(move: Callable, state: np.ndarray, inputs: list[float], plant: Plant) -> np.ndarray:
    """Derivative (n, 2) of a whole step with respect to its last inputs, roll and pitch (central differences)."""

    def moved(tilt: np.ndarray) -> np.ndarray:
        x, u = state.tolist(), [*inputs[:-2], *tilt.tolist()]
        for _ in range(plant.substeps):
            x = move(x, u, plant.constants)
        return np.array(x)

    return np.transpose([(moved(tilt) - moved(-tilt)) / (2.0 * TILT) for tilt in TILT * np.eye(2)])
