"""The published linear systems as plants, where the Kalman filter is optimal."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thruster_env.checks import one_of
from thruster_env.linear import zero_order_hold
from thruster_env.plant import Plant, make_plant
from thruster_env.published import PUBLISHED

PUBLISHED_NOISE = 0.5  # variance of each state a step, and of the measurement, in the published runs


class LinearDynamics(NamedTuple):
    """dx/dt = A x + B u, T = C x for x = (omega_m, U_a) and u = (V_s, U_0), held over a sample time."""

    a: np.ndarray  # (2, 2)
    b: np.ndarray  # (2, 2)
    c: np.ndarray  # (1, 2)

    def numbers(self, dt: float) -> np.ndarray:
        """A_d, B_d of the zero-order hold at dt [s], and C, by rows: ten numbers."""
        a_d, b_d = zero_order_hold(self.a, self.b, dt)
        return np.concatenate([a_d.ravel(), b_d.ravel(), self.c.ravel()])

    def steady_state(self, u) -> np.ndarray:
        """Equilibrium (omega_m [rad/s], U_a [m/s], T [N]) under u; the unstable system never comes to it."""
        x = -np.linalg.solve(self.a, self.b @ np.asarray(u, dtype=np.float64))
        return np.append(x, self.c @ x)


def make_linear_plant(system: str = "tunnel", measurement_noise_cov=None, **plant_arguments) -> Plant:
    """Make a plant that moves by a published linear system, in place of the equations of motion.

    Args:
        system: "tunnel" or "open_bladed"; see `published`.
        measurement_noise_cov: R; the published 0.5 for every channel if None.
        **plant_arguments: those of `make_plant`, without preset and uncertainty.

    Raises:
        ValueError: states the rule and the value.
    """
    model = PUBLISHED[one_of("system", system, tuple(PUBLISHED))]
    plant = make_plant("tunnel", **plant_arguments)
    if "current" in plant.channels:
        raise ValueError("the linear systems must be measured by other channels than the current, which they lack")
    dynamics = LinearDynamics(*(np.array(matrix) for matrix in (model.a, model.b, model.c)))
    plant = plant._replace(linear=dynamics, substeps=1)
    if measurement_noise_cov is None:
        return plant._replace(measurement_noise_cov=PUBLISHED_NOISE * np.eye(len(plant.channels)))
    return plant
