"""FilterPy's filters, set up with exactly the models that ours run on."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import numpy as np
from filterpy.kalman import (
    EnsembleKalmanFilter,
    KalmanFilter,
    MerweScaledSigmaPoints,
    UnscentedKalmanFilter,
)

from thruster_env.core.compiled import FASTMATH, with_callees
from thruster_env.core.sources import vector_reader
from thruster_env.model.affine import AffineModel
from thruster_env.thruster.dynamics import Constants, substep, thrust_and_torque
from thruster_env.thruster.plant import Plant

_read_constants = vector_reader(len(Constants._fields))


def python_model(plant: Plant) -> tuple[list[float], Callable, Callable]:
    """The plant as FilterPy's fx and hx, on plain floats, which Python handles faster than small arrays.

    Returns the input [V_s, U_0], to be set before each step since fx takes none, then fx and hx.
    """
    u, c, substeps = [0.0, plant.ambient_velocity], plant.constants, plant.substeps

    def fx(x, dt):
        x = x.tolist()
        for _ in range(substeps):
            x = substep(x, u, c)
        return x

    def hx(x):
        return thrust_and_torque(x.tolist(), c)[0]

    return u, fx, hx


def compiled_model(plant: Plant) -> tuple[list[float], Callable, Callable]:
    """The same compiled, a member a call: the most that a user of FilterPy can do without leaving it."""
    u, numbers, substeps = [0.0, plant.ambient_velocity], np.array(plant.constants), plant.substeps
    advance, thrust = _compiled_functions()

    def fx(x, dt):
        return advance(x, u[0], numbers, substeps)

    def hx(x):
        return thrust(x, numbers)

    return u, fx, hx


def _by_numba(function: Callable) -> Callable:
    import numba
    from numba.extending import register_jitable

    for part in with_callees([function]):
        if part is not function:
            register_jitable(part)
    return numba.njit(fastmath=set(FASTMATH), error_model="numpy")(function)


@cache
def _compiled_functions() -> tuple[Callable, Callable]:

    def advance(x, voltage, numbers, substeps):
        c = Constants(*_read_constants(numbers))
        state = (x[0], x[1])
        for _ in range(substeps):
            state = substep(state, (voltage, c.ambient_velocity), c)
        return state

    def thrust(x, numbers):
        return thrust_and_torque((x[0], x[1]), Constants(*_read_constants(numbers)))[0]

    return _by_numba(advance), _by_numba(thrust)


class EnsembleStep:
    """One predict and update of FilterPy's ensemble Kalman filter under a voltage."""

    def __init__(self, plant: Plant, ensemble_size: int, model: Callable):
        """Make the filter; model is `python_model` or `compiled_model`."""
        self._u, fx, hx = model(plant)
        self._plant = plant
        self.filter = EnsembleKalmanFilter(
            plant.initial_mean, plant.initial_cov, 1, plant.dt, ensemble_size, hx, fx
        )
        self.filter.Q, self.filter.R = plant.process_noise_cov, plant.measurement_noise_cov

    def reset(self) -> None:
        """Put the prior back, with members from NumPy's global generator."""
        self.filter.initialize(self._plant.initial_mean, self._plant.initial_cov)

    def __call__(self, voltage: float, z: np.ndarray) -> None:
        """Do the step."""
        self._u[0] = voltage
        self.filter.predict()
        self.filter.update(z)


class UnscentedStep:
    """One predict and update of FilterPy's unscented Kalman filter under a voltage."""

    def __init__(self, plant: Plant, points: tuple[float, float, float], model: Callable):
        """Make the filter; points are (alpha, beta, kappa), model is `python_model` or `compiled_model`."""
        self._u, fx, hx = model(plant)
        self._plant = plant
        sigma_points = MerweScaledSigmaPoints(2, *points)
        self.filter = UnscentedKalmanFilter(2, 1, plant.dt, lambda x: [hx(x)], fx, sigma_points)
        self.filter.Q, self.filter.R = plant.process_noise_cov, plant.measurement_noise_cov
        self.reset()

    def reset(self) -> None:
        """Put the prior back."""
        self.filter.x, self.filter.P = self._plant.initial_mean, self._plant.initial_cov

    def __call__(self, voltage: float, z: np.ndarray) -> None:
        """Do the step."""
        self._u[0] = voltage
        self.filter.predict()
        self.filter.update(z)


class KalmanStep:
    """One predict and update of FilterPy's Kalman filter of an affine model under a voltage."""

    def __init__(self, model: AffineModel):
        """Make the filter; offsets go in as a second, constant input, and off the measurement."""
        a, b, offset, c, self._shift = model.matrices()
        self.filter = KalmanFilter(dim_x=model.n, dim_z=model.m, dim_u=2)
        self.filter.F, self.filter.B, self.filter.H = a, np.column_stack([b, offset]), c
        self.filter.Q, self.filter.R = model.process_noise_cov, model.measurement_noise_cov
        self._model = model
        self.reset()

    def reset(self) -> None:
        """Put the prior back."""
        self.filter.x, self.filter.P = self._model.prior_mean, self._model.prior_cov

    def __call__(self, u: np.ndarray, z: np.ndarray) -> None:
        """Do the step under u = (V_s, 1)."""
        self.filter.predict(u)
        self.filter.update(z - self._shift)
