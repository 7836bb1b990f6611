"""Position and yaw that follow from velocities over time, by the full transformation or by yaw alone.

Integrals are by the trapezoidal rule. Yaw counts full turns; its errors are the short way round.

Source of the transformation by yaw alone: Ngatini, Nurhadi (2019), equations 1 to 4.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.integrate import cumulative_trapezoid

from thruster_env.auv.dynamics import angle_rates, attitude_of, in_earth_axes, planar_kinematics
from thruster_env.core.angles import difference
from thruster_env.core.compiled import CompiledOrPython, function_fingerprint, inlined, is_interpreting

POSE_ANGLES = (False, False, False, True)  # of x, y, z and yaw


@inlined
def next_attitude(phi, theta, before, after, dt):
    """Roll and pitch [rad] a step later, by Heun's rule; p, q, r [rad/s] were before and are after."""
    rolling, pitching, _ = angle_rates(attitude_of(phi, theta), before[0], before[1], before[2])
    there = attitude_of(phi + dt * rolling, theta + dt * pitching)
    rolling_there, pitching_there, _ = angle_rates(there, after[0], after[1], after[2])
    half = 0.5 * dt
    return phi + half * (rolling + rolling_there), theta + half * (pitching + pitching_there)


@cache
def _attitude_reckoner(interpreting: bool) -> CompiledOrPython:
    fingerprint = function_fingerprint(next_attitude, within=__name__)

    def reckon(rates, dt, attitudes):
        fingerprint  # noqa: B018 - part of the cache's key
        for b in range(rates.shape[0]):
            phi = theta = 0.0
            for k in range(1, rates.shape[1]):
                before = rates[b, k - 1, 0], rates[b, k - 1, 1], rates[b, k - 1, 2]
                after = rates[b, k, 0], rates[b, k, 1], rates[b, k, 2]
                phi, theta = next_attitude(phi, theta, before, after, dt)
                attitudes[b, k, 0] = phi
                attitudes[b, k, 1] = theta

    return CompiledOrPython(reckon)


def reckoned_attitude(velocities: np.ndarray, dt: float) -> np.ndarray:
    """Roll and pitch (B, K + 1, 2) [rad] from p, q, r of velocities (B, K + 1, 6), level at the start."""
    attitudes = np.zeros((*velocities.shape[:2], 2))
    _attitude_reckoner(is_interpreting())(np.ascontiguousarray(velocities[..., 3:]), dt, attitudes)
    return attitudes


def full_pose(velocities: np.ndarray, attitudes: np.ndarray | None, dt: float) -> np.ndarray:
    """Position x, y, z [m] and yaw [rad], (B, K + 1, 4), by the full transformation from the origin.

    Args:
        velocities: u, v, w [m/s] and p, q, r [rad/s] in the body's axes, (B, K + 1, 6).
        attitudes: roll and pitch [rad], (B, K + 1, 2); dead-reckoned from the velocities if None.
        dt: time of a step [s].
    """
    if attitudes is None:
        attitudes = reckoned_attitude(velocities, dt)
    u, v, w, p, q, r = np.moveaxis(velocities, -1, 0)
    attitude = attitude_of(attitudes[..., 0], attitudes[..., 1])
    yaw = _integral(angle_rates(attitude, p, q, r)[2], dt)
    return np.stack([*(_integral(rate, dt) for rate in in_earth_axes(attitude, yaw, u, v, w)), yaw], axis=-1)


def planar_pose(velocities: np.ndarray, dt: float) -> np.ndarray:
    """The same by the papers' transformation, which turns by yaw alone: z' = w, psi' = r."""
    components = np.moveaxis(velocities, -1, 0)
    yaw = _integral(components[5], dt)
    rates = planar_kinematics(tuple(components), yaw)
    return np.stack([*(_integral(rate, dt) for rate in rates[:3]), yaw], axis=-1)


def pose_errors(poses: np.ndarray, true_poses: np.ndarray) -> np.ndarray:
    """Errors (..., 4) of positions [m] and of yaw [rad], which are the short way round."""
    return difference(poses, true_poses, POSE_ANGLES)


def _integral(rates: np.ndarray, dt: float) -> np.ndarray:
    return cumulative_trapezoid(rates, dx=dt, initial=0.0)
