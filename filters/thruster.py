"""The bridge: the thruster as a `StateSpaceModel`, and filters for it by name. Nothing else here knows it."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from filters.ensemble import EnsembleKalmanFilter
from filters.extended import ExtendedKalmanFilter
from filters.filter import Filter
from filters.kalman import KalmanFilter
from filters.model import StateSpaceModel
from thruster_env.checks import finite, one_of
from thruster_env.compiled import compilable, inlined
from thruster_env.dynamics import substep, substep_jacobian, thrust_and_torque, thrust_and_torque_tangent
from thruster_env.linear import steady_state
from thruster_env.parameters import ThrusterParameters, checked
from thruster_env.plant import Plant, make_plant


@inlined
def transition(x, u, c):
    """One Runge-Kutta step of the thruster under voltage u = (V_s,)."""
    return substep(x, (u[0], c.ambient_velocity), c)


@compilable
def transition_jacobian(x, u, c):
    """Jacobian of `transition` by rows."""
    return substep_jacobian(x, (u[0], c.ambient_velocity), c)


@inlined
def observe(x, c):
    """The measured quantity: thrust [N]."""
    return (thrust_and_torque(x, c)[0],)


@compilable
def observe_jacobian(x, c):
    """Jacobian of `observe` by rows."""
    return (
        (
            thrust_and_torque_tangent(x, (1.0, 0.0), c)[0],
            thrust_and_torque_tangent(x, (0.0, 1.0), c)[0],
        ),
    )
