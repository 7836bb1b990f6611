"""The equations of motion of a thruster, once.

State x = (omega_m, U_a): motor speed [rad/s], section-average flow velocity [m/s].
Input u = (V_s, U_0): source voltage [V], ambient flow velocity along the thruster's axis [m/s].

    d omega_m/dt = -K1 omega_m + K2 V_s - K_h Q
    d U_a/dt     = -(K4/K3) (U_a - U_0) |U_a - U_0| + T/K3

Only the operators + - * / abs and ** occur, so the same source runs on floats, NumPy arrays and torch
tensors and compiles with numba. Source: Healey et al. (1995), as printed by Nurhadi et al. (2022).
"""

from __future__ import annotations

from typing import NamedTuple

from thruster_env.compiled import inlined
from thruster_env.integration import runge_kutta

# Keeps 1/V finite at rest, where every numerator vanishes faster.
_REST = 1e-200


class Constants(NamedTuple):
    """What the equations need of a preset; `parameters.derive_constants` makes it."""

    motor_damping: float  # K1 [1/s]
    voltage_gain: float  # K2 [rad/(s^2 V)]
    load_gain: float  # K_h [1/(kg m^2)]
    inverse_mass: float  # 1/K3 [1/kg]
    flow_drag: float  # K4/K3 [1/m]
    blade_speed: float  # U_p/omega_m = 0.7 R/N [m]
    torque_arm: float  # 0.7 R [m]
    half_lift: float  # rho A C_Lmax/2 [kg/m]
    half_drag: float  # rho A C_Dmax/2 [kg/m]
    attack_sine: float  # sin(2 alpha) at zero inflow
    attack_cosine: float  # cos(2 alpha) at zero inflow
    turn_sine: float  # sin(theta - phi)
    turn_cosine: float  # cos(theta - phi)
    ambient_velocity: float  # U_0 [m/s] where it is constant
    substep: float  # time step of one integration step [s]


@inlined
def lift_and_drag(x, c):
    """Lift and drag [N] at state x, with cos(theta), sin(theta), U_p [m/s] and 1/V [s/m].

        U_p = 0.7 R omega_m/N, V^2 = U_p^2 + U_a^2, phi = arctan2(U_a, U_p)
        Lift = 1/2 rho V^2 A C_Lmax sin(2 alpha),  Drag = 1/2 rho V^2 A C_Dmax (1 - cos(2 alpha))

    With alpha = alpha_0 - phi and theta = phi + turn, V^2 sin(2 alpha) and V^2 cos(2 alpha) are quadratic in
    (U_p, U_a): no trigonometric call is left. The four-quadrant phi makes the forces exactly odd.
    """
    omega, flow = x
    blade = c.blade_speed * omega
    speed_squared = blade * blade + flow * flow
    cosine_part = blade * blade - flow * flow  # V^2 cos(2 phi)
    sine_part = 2.0 * blade * flow  # V^2 sin(2 phi)
    lift = c.half_lift * (c.attack_sine * cosine_part - c.attack_cosine * sine_part)
    drag = c.half_drag * (speed_squared - c.attack_cosine * cosine_part - c.attack_sine * sine_part)
    per_speed = 1.0 / (speed_squared + _REST) ** 0.5
    cosine = (c.turn_cosine * blade - c.turn_sine * flow) * per_speed
    sine = (c.turn_cosine * flow + c.turn_sine * blade) * per_speed
    return lift, drag, cosine, sine, blade, per_speed


@inlined
def thrust_and_torque(x, c):
    """Thrust T [N] and propeller torque Q [N m] at state x.

    T = Lift cos(theta) - Drag sin(theta),  Q = 0.7 R (Lift sin(theta) + Drag cos(theta))
    """
    lift, drag, cosine, sine, _, _ = lift_and_drag(x, c)
    return lift * cosine - drag * sine, c.torque_arm * (lift * sine + drag * cosine)


@inlined
def thrust_and_torque_tangent(x, dx, c):
    """Directional derivatives (dT, dQ) of `thrust_and_torque` at x along dx, by the product rule."""
    lift, drag, cosine, sine, blade, per_speed = lift_and_drag(x, c)
    flow = x[1]
    d_blade = c.blade_speed * dx[0]
    d_flow = dx[1]
    d_speed_squared = 2.0 * (blade * d_blade + flow * d_flow)
    d_cosine_part = 2.0 * (blade * d_blade - flow * d_flow)
    d_sine_part = 2.0 * (d_blade * flow + blade * d_flow)
    d_lift = c.half_lift * (c.attack_sine * d_cosine_part - c.attack_cosine * d_sine_part)
    d_drag = c.half_drag * (d_speed_squared - c.attack_cosine * d_cosine_part - c.attack_sine * d_sine_part)
    d_log_speed = 0.5 * d_speed_squared * per_speed * per_speed
    d_cosine = (c.turn_cosine * d_blade - c.turn_sine * d_flow) * per_speed - cosine * d_log_speed
    d_sine = (c.turn_cosine * d_flow + c.turn_sine * d_blade) * per_speed - sine * d_log_speed
    d_thrust = d_lift * cosine + lift * d_cosine - d_drag * sine - drag * d_sine
    d_torque = c.torque_arm * (d_lift * sine + lift * d_sine + d_drag * cosine + drag * d_cosine)
    return d_thrust, d_torque


@inlined
def rates(x, u, c):
    """Time derivatives (d omega_m/dt [rad/s^2], d U_a/dt [m/s^2]) at state x under input u."""
    omega, flow = x
    voltage, ambient = u
    thrust, torque = thrust_and_torque(x, c)
    slip = flow - ambient
    return (
        c.voltage_gain * voltage - c.motor_damping * omega - c.load_gain * torque,
        c.inverse_mass * thrust - c.flow_drag * slip * abs(slip),
    )


@inlined
def rates_tangent(x, dx, u, c):
    """Directional derivative of `rates` at x along dx: the Jacobian of the plant times dx."""
    d_thrust, d_torque = thrust_and_torque_tangent(x, dx, c)
    slip = x[1] - u[1]
    return (
        -c.motor_damping * dx[0] - c.load_gain * d_torque,
        c.inverse_mass * d_thrust - 2.0 * c.flow_drag * abs(slip) * dx[1],
    )


@inlined
def variational_rates(y, u, c):
    """Rates of the state and of a perturbation of it, y = (omega_m, U_a, d omega_m, d U_a)."""
    x = (y[0], y[1])
    return rates(x, u, c) + rates_tangent(x, (y[2], y[3]), u, c)


substep = runge_kutta(rates, 2)
"""`substep(x, u, c)`: the state after c.substep seconds of constant input, by one Runge-Kutta step."""

variational_substep = runge_kutta(variational_rates, 4)
"""`variational_substep(y, u, c)`: the same with a perturbation; exactly the derivative of `substep`."""


@inlined
def substep_jacobian(x, u, c):
    """Jacobian of `substep` by rows, ((d omega'/d omega, d omega'/d U), (d U'/d omega, d U'/d U))."""
    first = variational_substep((x[0], x[1], 1.0, 0.0), u, c)
    second = variational_substep((x[0], x[1], 0.0, 1.0), u, c)
    return (first[2], second[2]), (first[3], second[3])
