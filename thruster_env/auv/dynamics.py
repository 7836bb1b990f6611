"""The motion of an underwater vehicle with six, eight or twelve states, its integration and its Jacobians.

Six velocities nu = (u, v, w, p, q, r) are moved by `forces`. With roll and pitch, on which weight and buoyancy
depend, they are the smallest closed system; yaw and position, to the north, to the east and down, complete the
state.

    nu' = M^-1 F(nu, phi, theta, u)
    (phi, theta, psi)' = T(phi, theta) (p, q, r)
    (x, y, z)' = R(phi, theta, psi) (u, v, w)
"""

from __future__ import annotations

from thruster_env.auv.forces import accelerated, forces, forces_tangent
from thruster_env.auv.kinematics import (
    angle_rates,
    angle_rates_tangent,
    attitude_of,
    attitude_tangent,
    down,
    down_tangent,
    in_body_axes,
    in_body_axes_tangent,
    in_earth_axes,
    in_earth_axes_tangent,
)
from thruster_env.core.compiled import inlined
from thruster_env.core.integration import euler, euler_jacobian, runge_kutta, runge_kutta_jacobian


@inlined
def velocity_rates(x, u, c):
    """Time derivatives of x = nu; u = (X_prop, K_prop, delta_s, delta_r, phi, theta)."""
    return accelerated(forces(x, down(attitude_of(u[4], u[5])), u, c), c)


@inlined
def velocity_rates_tangent(x, dx, u, c):
    """Directional derivative of `velocity_rates` at x along dx."""
    return accelerated(forces_tangent(x, dx, (0.0, 0.0, 0.0), u, c), c)


@inlined
def motion_rates(x, u, c):
    """Time derivatives of x = (nu, phi, theta); u = (X_prop, K_prop, delta_s, delta_r)."""
    nu, attitude = (x[0], x[1], x[2], x[3], x[4], x[5]), attitude_of(x[6], x[7])
    rolling, pitching, _ = angle_rates(attitude, x[3], x[4], x[5])
    return accelerated(forces(nu, down(attitude), u, c), c) + (rolling, pitching)


@inlined
def motion_rates_tangent(x, dx, u, c):
    """Directional derivative of `motion_rates` at x along dx."""
    nu, attitude = (x[0], x[1], x[2], x[3], x[4], x[5]), attitude_of(x[6], x[7])
    d_nu, d_attitude = (dx[0], dx[1], dx[2], dx[3], dx[4], dx[5]), attitude_tangent(attitude, dx[6], dx[7])
    force = forces_tangent(nu, d_nu, down_tangent(attitude, d_attitude), u, c)
    d_rolling, d_pitching, _ = angle_rates_tangent(attitude, d_attitude, x[4], x[5], dx[3], dx[4], dx[5])
    return accelerated(force, c) + (d_rolling, d_pitching)


@inlined
def navigation_rates(x, u, c):
    """Time derivatives of x = (nu, phi, theta, psi, x, y, z); u = (X_prop, K_prop, delta_s, delta_r)."""
    nu, attitude = (x[0], x[1], x[2], x[3], x[4], x[5]), attitude_of(x[6], x[7])
    turning = angle_rates(attitude, x[3], x[4], x[5])
    path = in_earth_axes(attitude, x[8], x[0], x[1], x[2])
    return accelerated(forces(nu, down(attitude), u, c), c) + turning + path


@inlined
def navigation_rates_tangent(x, dx, u, c):
    """Directional derivative of `navigation_rates` at x along dx."""
    nu, attitude = (x[0], x[1], x[2], x[3], x[4], x[5]), attitude_of(x[6], x[7])
    d_nu, d_attitude = (dx[0], dx[1], dx[2], dx[3], dx[4], dx[5]), attitude_tangent(attitude, dx[6], dx[7])
    force = forces_tangent(nu, d_nu, down_tangent(attitude, d_attitude), u, c)
    turning = angle_rates_tangent(attitude, d_attitude, x[4], x[5], dx[3], dx[4], dx[5])
    velocity, d_velocity = (x[0], x[1], x[2]), (dx[0], dx[1], dx[2])
    path = in_earth_axes_tangent(attitude, d_attitude, x[8], dx[8], velocity, d_velocity)
    return accelerated(force, c) + turning + path


@inlined
def current_rates(x, u, c):
    """`navigation_rates` in a current; u = (X_prop, K_prop, delta_s, delta_r, north, east, down).

    Forces are those of the velocity through the water, nu less the current; x holds the velocity over ground. The
    current [m/s] is the same everywhere, and held over the step: in the body's axes it turns with them.
    """
    attitude = attitude_of(x[6], x[7])
    along, across, below = in_body_axes(attitude, x[8], u[4], u[5], u[6])
    p, q, r = x[3], x[4], x[5]
    through_water = (x[0] - along, x[1] - across, x[2] - below, p, q, r)
    moved = accelerated(forces(through_water, down(attitude), u, c), c)
    return (
        moved[0] + r * across - q * below,
        moved[1] + p * below - r * along,
        moved[2] + q * along - p * across,
        moved[3],
        moved[4],
        moved[5],
        *angle_rates(attitude, p, q, r),
        *in_earth_axes(attitude, x[8], x[0], x[1], x[2]),
    )


@inlined
def drifting_rates(x, u, c):
    """`current_rates` with the current as states: x = (nu, phi, theta, psi, x, y, z, north, east).

    What changes the current [m/s] is process noise alone, and it has no component down.
    """
    told = (u[0], u[1], u[2], u[3], x[12], x[13], 0.0)
    return (*current_rates(x, told, c), 0.0, 0.0)


@inlined
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
    moved = accelerated(forces_tangent(through_water, d_through, down_tangent(attitude, d_attitude), u, c), c)
    velocity, d_velocity = (x[0], x[1], x[2]), (dx[0], dx[1], dx[2])
    return (
        moved[0] + dr * across + r * d_across - dq * below - q * d_below,
        moved[1] + dp * below + p * d_below - dr * along - r * d_along,
        moved[2] + dq * along + q * d_along - dp * across - p * d_across,
        moved[3],
        moved[4],
        moved[5],
        *angle_rates_tangent(attitude, d_attitude, q, r, dp, dq, dr),
        *in_earth_axes_tangent(attitude, d_attitude, x[8], dx[8], velocity, d_velocity),
        0.0,
        0.0,
    )


velocity_substep = runge_kutta(velocity_rates, 6)
"""`velocity_substep(x, u, c)`: six velocities after c.substep seconds of constant input and attitude."""

motion_substep = runge_kutta(motion_rates, 8)
"""`motion_substep(x, u, c)`: velocities, roll and pitch after c.substep seconds of constant input."""

navigation_substep = runge_kutta(navigation_rates, 12)
"""`navigation_substep(x, u, c)`: the same with yaw and position."""

current_substep = runge_kutta(current_rates, 12)
"""`current_substep(x, u, c)`: the same in a current, the last three inputs."""

drifting_substep = runge_kutta(drifting_rates, 14)
"""`drifting_substep(x, u, c)`: the same with the current among the states."""

velocity_jacobian = runge_kutta_jacobian(velocity_rates, velocity_rates_tangent, 6)
motion_jacobian = runge_kutta_jacobian(motion_rates, motion_rates_tangent, 8)
navigation_jacobian = runge_kutta_jacobian(navigation_rates, navigation_rates_tangent, 12)
drifting_jacobian = runge_kutta_jacobian(drifting_rates, drifting_rates_tangent, 14)

velocity_euler = euler(velocity_rates, 6)
"""`velocity_euler(x, u, c)`: `velocity_substep` by Euler's method, as the papers have it; ..."""

motion_euler = euler(motion_rates, 8)
navigation_euler = euler(navigation_rates, 12)
drifting_euler = euler(drifting_rates, 14)
velocity_euler_jacobian = euler_jacobian(velocity_rates_tangent, 6)
motion_euler_jacobian = euler_jacobian(motion_rates_tangent, 8)
navigation_euler_jacobian = euler_jacobian(navigation_rates_tangent, 12)
drifting_euler_jacobian = euler_jacobian(drifting_rates_tangent, 14)
