"""The vehicle's equations of motion: kinematics, dynamics and operating points.

Six velocities nu = (u, v, w, p, q, r) are moved by `forces`. With roll and pitch, on which weight and buoyancy
depend, they are the smallest closed system; yaw and position, to the north, to the east and down, complete the
state.

    nu' = M^-1 F(nu, phi, theta, u)
    (phi, theta, psi)' = T(phi, theta) (p, q, r)
    (x, y, z)' = R(phi, theta, psi) (u, v, w)

Roll phi, pitch theta, yaw psi [rad]; the earth's axes are north, east, down, the body's ahead, starboard, down. An
attitude is (cos phi, sin phi, cos theta, sin theta). Euler angles end at theta = +-90 deg, where the rates of phi
and psi are infinite; with a quaternion in their place (`rotating_rates`) the vehicle may loop. Source: Fossen
(2011), "Handbook of Marine Craft Hydrodynamics and Motion Control", 2.2.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from thruster_env.auv.parameters import VehicleParameters, accelerated, derive_constants, forces, forces_tangent
from thruster_env.core.derivatives import runge_kutta
from thruster_env.core.streams import cosine_and_sine
from thruster_env.model import rotations
from thruster_env.model.turns import Rotation, runge_kutta_munthe_kaas, with_rotations

# Attitude and path of a vehicle: Euler angles, transformations between body and earth, their tangents.


def attitude_of(phi, theta):
    """(cos phi, sin phi, cos theta, sin theta)."""
    c_phi, s_phi = cosine_and_sine(phi)
    c_theta, s_theta = cosine_and_sine(theta)
    return c_phi, s_phi, c_theta, s_theta


def attitude_tangent(attitude, d_phi, d_theta):
    """Directional derivative of `attitude_of`."""
    c_phi, s_phi, c_theta, s_theta = attitude
    return -s_phi * d_phi, c_phi * d_phi, -s_theta * d_theta, c_theta * d_theta


def down(attitude):
    """The direction downwards in the body's axes: (-sin theta, cos theta sin phi, cos theta cos phi)."""
    c_phi, s_phi, c_theta, s_theta = attitude
    return -s_theta, c_theta * s_phi, c_theta * c_phi


def down_tangent(attitude, d_attitude):
    """Directional derivative of `down`."""
    c_phi, s_phi, c_theta, s_theta = attitude
    dc_phi, ds_phi, dc_theta, ds_theta = d_attitude
    return -ds_theta, dc_theta * s_phi + c_theta * ds_phi, dc_theta * c_phi + c_theta * dc_phi


def angle_rates(attitude, p, q, r):
    """Rates of roll, pitch and yaw [rad/s] of a body that turns with p, q, r [rad/s].

    phi' = p + psi' sin theta,  theta' = q cos phi - r sin phi,  psi' = (q sin phi + r cos phi)/cos theta
    """
    c_phi, s_phi, c_theta, s_theta = attitude
    turning = (q * s_phi + r * c_phi) / c_theta
    return p + turning * s_theta, q * c_phi - r * s_phi, turning


def angle_rates_tangent(attitude, d_attitude, q, r, dp, dq, dr):
    """Directional derivative of `angle_rates`."""
    c_phi, s_phi, c_theta, s_theta = attitude
    dc_phi, ds_phi, dc_theta, ds_theta = d_attitude
    per_cosine = 1.0 / c_theta
    turning = (q * s_phi + r * c_phi) * per_cosine
    d_turning = dq * s_phi + q * ds_phi + dr * c_phi + r * dc_phi - turning * dc_theta
    d_turning = d_turning * per_cosine
    d_rolling = dp + d_turning * s_theta + turning * ds_theta
    return d_rolling, dq * c_phi + q * dc_phi - dr * s_phi - r * ds_phi, d_turning


def _levelled(attitude, u, v, w):
    """A vector in axes that turn with the body's heading only: ahead, to starboard and down."""
    c_phi, s_phi, c_theta, s_theta = attitude
    below = v * s_phi + w * c_phi
    return u * c_theta + below * s_theta, v * c_phi - w * s_phi, below * c_theta - u * s_theta


def in_earth_axes(attitude, psi, u, v, w):
    """Components to the north, to the east and down of a vector (u, v, w) in the body's axes."""
    c_psi, s_psi = cosine_and_sine(psi)
    ahead, aside, below = _levelled(attitude, u, v, w)
    return ahead * c_psi - aside * s_psi, ahead * s_psi + aside * c_psi, below


def in_earth_axes_tangent(attitude, d_attitude, psi, d_psi, velocity, d_velocity):
    """Directional derivative of `in_earth_axes`; the vector and its change are (u, v, w)."""
    u, v, w = velocity
    du, dv, dw = d_velocity
    c_phi, s_phi, c_theta, s_theta = attitude
    dc_phi, ds_phi, dc_theta, ds_theta = d_attitude
    c_psi, s_psi = cosine_and_sine(psi)
    ahead, aside, _ = _levelled(attitude, u, v, w)
    below, d_below = v * s_phi + w * c_phi, dv * s_phi + v * ds_phi + dw * c_phi + w * dc_phi
    d_ahead = du * c_theta + u * dc_theta + d_below * s_theta + below * ds_theta - aside * d_psi
    d_aside = dv * c_phi + v * dc_phi - dw * s_phi - w * ds_phi + ahead * d_psi
    return (
        d_ahead * c_psi - d_aside * s_psi,
        d_ahead * s_psi + d_aside * c_psi,
        d_below * c_theta + below * dc_theta - du * s_theta - u * ds_theta,
    )


def in_body_axes(attitude, psi, north, east, below):
    """Components ahead, to starboard and down in the body's axes of a vector in the earth's."""
    c_phi, s_phi, c_theta, s_theta = attitude
    c_psi, s_psi = cosine_and_sine(psi)
    ahead, aside = north * c_psi + east * s_psi, east * c_psi - north * s_psi
    across = ahead * s_theta + below * c_theta
    return ahead * c_theta - below * s_theta, aside * c_phi + across * s_phi, across * c_phi - aside * s_phi


def in_body_axes_tangent(attitude, d_attitude, psi, d_psi, vector, d_vector):
    """Directional derivative of `in_body_axes`; the vector and its change are (north, east, down)."""
    (north, east, below), (d_north, d_east, d_below) = vector, d_vector
    c_phi, s_phi, c_theta, s_theta = attitude
    dc_phi, ds_phi, dc_theta, ds_theta = d_attitude
    c_psi, s_psi = cosine_and_sine(psi)
    ahead, aside = north * c_psi + east * s_psi, east * c_psi - north * s_psi
    d_ahead = d_north * c_psi + d_east * s_psi + aside * d_psi
    d_aside = d_east * c_psi - d_north * s_psi - ahead * d_psi
    across = ahead * s_theta + below * c_theta
    d_across = d_ahead * s_theta + ahead * ds_theta + d_below * c_theta + below * dc_theta
    return (
        d_ahead * c_theta + ahead * dc_theta - d_below * s_theta - below * ds_theta,
        d_aside * c_phi + aside * dc_phi + d_across * s_phi + across * ds_phi,
        d_across * c_phi + across * dc_phi - d_aside * s_phi - aside * ds_phi,
    )


# The motion of an underwater vehicle with six, eight or twelve states, its integration and its Jacobians.


def velocity_rates(x, u, c):
    """Time derivatives of x = nu; u = (X_prop, K_prop, delta_s, delta_r, phi, theta)."""
    return accelerated(forces(x, down(attitude_of(u[4], u[5])), u, c), c)


def velocity_rates_tangent(x, dx, u, c):
    """Directional derivative of `velocity_rates` at x along dx."""
    return accelerated(forces_tangent(x, dx, (0.0, 0.0, 0.0), u, c), c)


def motion_rates(x, u, c):
    """Time derivatives of x = (nu, phi, theta); u = (X_prop, K_prop, delta_s, delta_r)."""
    nu, attitude = (x[0], x[1], x[2], x[3], x[4], x[5]), attitude_of(x[6], x[7])
    rolling, pitching, _ = angle_rates(attitude, x[3], x[4], x[5])
    return accelerated(forces(nu, down(attitude), u, c), c) + (rolling, pitching)


def motion_rates_tangent(x, dx, u, c):
    """Directional derivative of `motion_rates` at x along dx."""
    nu, attitude = (x[0], x[1], x[2], x[3], x[4], x[5]), attitude_of(x[6], x[7])
    d_nu, d_attitude = (dx[0], dx[1], dx[2], dx[3], dx[4], dx[5]), attitude_tangent(attitude, dx[6], dx[7])
    force = forces_tangent(nu, d_nu, down_tangent(attitude, d_attitude), u, c)
    d_rolling, d_pitching, _ = angle_rates_tangent(attitude, d_attitude, x[4], x[5], dx[3], dx[4], dx[5])
    return accelerated(force, c) + (d_rolling, d_pitching)


def navigation_rates(x, u, c):
    """Time derivatives of x = (nu, phi, theta, psi, x, y, z); u = (X_prop, K_prop, delta_s, delta_r)."""
    nu, attitude = (x[0], x[1], x[2], x[3], x[4], x[5]), attitude_of(x[6], x[7])
    turning = angle_rates(attitude, x[3], x[4], x[5])
    path = in_earth_axes(attitude, x[8], x[0], x[1], x[2])
    return accelerated(forces(nu, down(attitude), u, c), c) + turning + path


def navigation_rates_tangent(x, dx, u, c):
    """Directional derivative of `navigation_rates` at x along dx."""
    nu, attitude = (x[0], x[1], x[2], x[3], x[4], x[5]), attitude_of(x[6], x[7])
    d_nu, d_attitude = (dx[0], dx[1], dx[2], dx[3], dx[4], dx[5]), attitude_tangent(attitude, dx[6], dx[7])
    force = forces_tangent(nu, d_nu, down_tangent(attitude, d_attitude), u, c)
    turning = angle_rates_tangent(attitude, d_attitude, x[4], x[5], dx[3], dx[4], dx[5])
    velocity, d_velocity = (x[0], x[1], x[2]), (dx[0], dx[1], dx[2])
    path = in_earth_axes_tangent(attitude, d_attitude, x[8], dx[8], velocity, d_velocity)
    return accelerated(force, c) + turning + path


def current_rates(x, u, c):
    """`navigation_rates` in a current; u = (X_prop, K_prop, delta_s, delta_r, north, east, down).

    Forces are those of the velocity through the water, nu less the current; x holds the velocity over ground. The
    current [m/s] is the same everywhere, and held over the step: in the body's axes it turns with them.
    """
    attitude = attitude_of(x[6], x[7])
    current = in_body_axes(attitude, x[8], u[4], u[5], u[6])
    return (
        *_in_current(x, current, down(attitude), u, c),
        *angle_rates(attitude, x[3], x[4], x[5]),
        *in_earth_axes(attitude, x[8], x[0], x[1], x[2]),
    )


def _in_current(x, current, downwards, u, c):
    """Nu' in a current (ahead, to starboard, down in the body's axes), which turns with them."""
    along, across, below = current
    p, q, r = x[3], x[4], x[5]
    through_water = (x[0] - along, x[1] - across, x[2] - below, p, q, r)
    accelerations = accelerated(forces(through_water, downwards, u, c), c)
    return (
        accelerations[0] + r * across - q * below,
        accelerations[1] + p * below - r * along,
        accelerations[2] + q * along - p * across,
        accelerations[3],
        accelerations[4],
        accelerations[5],
    )


def drifting_rates(x, u, c):
    """`current_rates` with the current as states: x = (nu, phi, theta, psi, x, y, z, north, east).

    Only process noise changes the current [m/s], which has no component down.
    """
    inputs = (u[0], u[1], u[2], u[3], x[12], x[13], 0.0)
    return (*current_rates(x, inputs, c), 0.0, 0.0)


def drifting_rates_tangent(x, dx, u, c):
    """Directional derivative of `drifting_rates` at x along dx."""
    p, q, r, dp, dq, dr = x[3], x[4], x[5], dx[3], dx[4], dx[5]
    attitude = attitude_of(x[6], x[7])
    d_attitude = attitude_tangent(attitude, dx[6], dx[7])
    along, across, below = in_body_axes(attitude, x[8], x[12], x[13], 0.0)
    flow, d_flow = (x[12], x[13], 0.0), (dx[12], dx[13], 0.0)
    d_along, d_across, d_below = in_body_axes_tangent(attitude, d_attitude, x[8], dx[8], flow, d_flow)
    through_water = (x[0] - along, x[1] - across, x[2] - below, p, q, r)
    d_through = (dx[0] - d_along, dx[1] - d_across, dx[2] - d_below, dp, dq, dr)
    accelerations = accelerated(
        forces_tangent(through_water, d_through, down_tangent(attitude, d_attitude), u, c), c
    )
    velocity, d_velocity = (x[0], x[1], x[2]), (dx[0], dx[1], dx[2])
    return (
        accelerations[0] + dr * across + r * d_across - dq * below - q * d_below,
        accelerations[1] + dp * below + p * d_below - dr * along - r * d_along,
        accelerations[2] + dq * along + q * d_along - dp * across - p * d_across,
        accelerations[3],
        accelerations[4],
        accelerations[5],
        *angle_rates_tangent(attitude, d_attitude, q, r, dp, dq, dr),
        *in_earth_axes_tangent(attitude, d_attitude, x[8], dx[8], velocity, d_velocity),
        0.0,
        0.0,
    )


@dataclass(frozen=True)
class Motion:
    """The number of states of a model, and its equations of motion."""

    count: int
    rates: Callable
    tangent: Callable  # of the rates


MODELS = {
    "velocities": Motion(6, velocity_rates, velocity_rates_tangent),
    "motion": Motion(8, motion_rates, motion_rates_tangent),
    "navigation": Motion(12, navigation_rates, navigation_rates_tangent),
    "current": Motion(14, drifting_rates, drifting_rates_tangent),
}
"""Models by name: the papers' six velocities; with roll and pitch; with yaw and position; with the current."""


# The same motion with a quaternion (w, x, y, z) of `thruster_env.model.rotations` for the attitude.


_, ROTATING = with_rotations((*"uvwpqr", Rotation("attitude"), *"xyz"))
"""The rotation of a state (nu, quaternion, x, y, z), whose error is in the body's axes."""


def rotating_rates(x, u, c):
    """Rates of the tangent of x = (nu, quaternion) or (nu, quaternion, x, y, z).

        nu' as in `current_rates`, angular rate (p, q, r) of the body, (x, y, z)' = R (u, v, w)

    u = (X_prop, K_prop, delta_s, delta_r), and a current (north, east, down) or none.
    """
    attitude, downwards = x[6:10], rotations.to_body(x[6:10], (0.0, 0.0, 1.0))
    current = rotations.to_body(attitude, u[4:7]) if len(u) > 4 else (0.0, 0.0, 0.0)
    velocity = rotations.to_world(attitude, x[:3]) if len(x) > 10 else ()
    return (*_in_current(x, current, downwards, u, c), x[3], x[4], x[5], *velocity)


def angled_state(x):
    """(nu, phi, theta, psi, ...) of a state (nu, quaternion, ...); roll and yaw are within half a turn.

    At theta = +-90 deg, roll and yaw are not determined.
    """
    return (*x[:6], *rotations.euler(x[6:10]), *x[10:])


rotating_substep = runge_kutta_munthe_kaas(rotating_rates, ROTATING)
"""`rotating_substep(x, u, c)`: velocities and quaternion, and position if it is in x, after c.substep seconds."""

motion_substep = runge_kutta(motion_rates, 8)
"""`motion_substep(x, u, c)`: velocities, roll and pitch after c.substep seconds of constant input."""

navigation_substep = runge_kutta(navigation_rates, 12)
"""`navigation_substep(x, u, c)`: the same with yaw and position."""

current_substep = runge_kutta(current_rates, 12)
"""`current_substep(x, u, c)`: the same in a current, the last three inputs."""


# Operating range of a vehicle: the thrust of a speed, the range of its states, the integration step.


ONE_STEP_ACCURACY = 1e-4  # of each state's range, over one sample time


def cruise_thrust(p: VehicleParameters, speed: float) -> float:
    """Thrust [N] that holds a speed [m/s] straight ahead: -(Xu + Xuu |u|) u."""
    return -(p.Xu + p.Xuu * abs(speed)) * speed


def top_speed(p: VehicleParameters, thrust: float) -> float:
    """Speed [m/s] straight ahead that a thrust [N] holds; ValueError for a vehicle without drag."""
    linear, square = -p.Xu, -p.Xuu
    if min(linear, square) < 0.0 or linear == square == 0.0:
        raise ValueError(f"Xu and Xuu must be a drag, negative or zero and not both zero, but got {p.Xu}, {p.Xuu}")
    return 2.0 * thrust / (linear + math.sqrt(linear**2 + 4.0 * square * thrust))


def operating_range(p: VehicleParameters, thrust: float) -> np.ndarray:
    """Largest state (12,) of normal operation under thrusts up to so much [N]; the smallest is its opposite.

    Only u is never negative. Manoeuvres with both planes within 5 deg stay inside, and a swing in roll of 3 deg.
    Velocities are parts of the top speed, pitch and yaw rates parts of that over the radius of gyration.
    """
    speed = top_speed(p, thrust)
    turning = 0.09 * speed / math.sqrt(max(p.Iy, 1e-9) / p.m)
    return np.array([speed, *(2 * [0.15 * speed]), 0.3, turning, turning, 0.05, 0.6, math.pi, *(3 * [10.0])])


@lru_cache(maxsize=64)
def required_substeps(p: VehicleParameters, dt: float, thrust: float, plane: float) -> int:
    """Fewest Runge-Kutta steps a sample time that hold the one-step accuracy over the operating range.

    A step with that many substeps is compared with one of twice as many, from the corners of the range and 100
    states between them, under thrusts up to `thrust` [N] and planes within `plane` [rad].

    Raises ValueError if 64 substeps do not suffice: dt is then far too long for the vehicle.
    """
    high = operating_range(p, thrust)[:8]
    rng = np.random.default_rng(0)
    part = np.hstack([rng.uniform(-1.0, 1.0, (8, 100)), rng.choice([-1.0, 1.0], (8, 100))])
    part[0] = np.abs(part[0])
    force = np.abs(rng.uniform(-1.0, 1.0, 200)) * thrust, np.zeros(200)
    u = (*force, *(rng.choice([-1.0, 1.0], (2, 200)) * plane))
    limit = ONE_STEP_ACCURACY * 2.0 * high[:, None]

    def propagated(count):
        c, x = derive_constants(p, dt / count), tuple(part * high[:, None])
        for _ in range(count):
            x = motion_substep(x, u, c)
        return np.array(x)

    count = 1
    with np.errstate(all="ignore"):
        before = propagated(count)
        while count <= 64:
            after = propagated(2 * count)
            if (np.abs(after - before) <= limit).all():
                return count
            count, before = 2 * count, after
    raise ValueError(f"dt must be short enough for 64 Runge-Kutta steps to follow the vehicle, but got {dt!r}")
