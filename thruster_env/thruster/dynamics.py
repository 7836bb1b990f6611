"""The equations of motion of a thruster, once.

State x = (omega_m, U_a): motor speed [rad/s], section-average flow velocity [m/s].
Input u = (V_s, U_0): source voltage [V], ambient flow velocity along the thruster's axis [m/s].

    d omega_m/dt = -K1 omega_m + K2 V_s - K_h Q
    d U_a/dt     = -(K4/K3) (U_a - U_0) |U_a - U_0| + T/K3

Only the operators + - * / abs and ** occur, so the same source runs on floats, NumPy arrays and torch
tensors and compiles. Source: Healey et al. (1995), as printed by Nurhadi et al. (2022).
"""

from __future__ import annotations

from typing import NamedTuple

from thruster_env.core.derivatives import runge_kutta

# Keeps 1/V finite at rest, where what it multiplies vanishes faster.
_REST = 1e-200


class Constants(NamedTuple):
    """The constants of the equations; `parameters.derive_constants` computes them from a preset.

    With V^2 = U_p^2 + U_a^2, lift and drag are quadratic in (omega_m, U_a), and cos(theta) and sin(theta) are
    linear in them over V. So V T and V Q are cubic: `thrust_21` is the factor of omega_m^2 U_a in V T.
    """

    motor_damping: float  # K1 [1/s]
    voltage_gain: float  # K2 [rad/(s^2 V)]
    load_gain: float  # K_h [1/(kg m^2)]
    inverse_mass: float  # 1/K3 [1/kg]
    flow_drag: float  # K4/K3 [1/m]
    blade_speed: float  # U_p/omega_m = 0.7 R/N [m]
    asymmetry: float  # relative gain of the thrust ahead, and loss astern [-]
    thrust_30: float  # V T's factor of omega_m^3
    thrust_21: float  # ... of omega_m^2 U_a
    thrust_12: float  # ... of omega_m U_a^2
    thrust_03: float  # ... of U_a^3
    torque_30: float  # V Q's factors in the same order
    torque_21: float
    torque_12: float
    torque_03: float
    ambient_velocity: float  # U_0 [m/s] where it is constant
    substep: float  # time step of one integration step [s]


def thrust_and_torque(x, c):
    """Thrust T [N] and propeller torque Q [N m] at state x.

        U_p = 0.7 R omega_m/N, V^2 = U_p^2 + U_a^2, phi = arctan2(U_a, U_p)
        Lift = 1/2 rho V^2 A C_Lmax sin(2 alpha),  Drag = 1/2 rho V^2 A C_Dmax (1 - cos(2 alpha))
        T = (1 + e cos(phi)) (Lift cos(theta) - Drag sin(theta))
        Q = 0.7 R (Lift sin(theta) + Drag cos(theta))

    With alpha = alpha_0 - phi and theta = phi + turn, no trigonometric call is left: see `Constants`. The
    four-quadrant phi makes the forces exactly odd where the asymmetry e is zero (as it is in print).
    """
    omega, flow = x
    blade = c.blade_speed * omega
    omega_2, flow_2 = omega * omega, flow * flow
    per_speed = 1.0 / (blade * blade + flow_2 + _REST) ** 0.5
    lean = 1.0 + c.asymmetry * blade * per_speed
    thrust = omega * (c.thrust_30 * omega_2 + c.thrust_12 * flow_2)
    torque = omega * (c.torque_30 * omega_2 + c.torque_12 * flow_2)
    thrust = thrust + flow * (c.thrust_21 * omega_2 + c.thrust_03 * flow_2)
    torque = torque + flow * (c.torque_21 * omega_2 + c.torque_03 * flow_2)
    return per_speed * lean * thrust, per_speed * torque


def thrust_and_torque_tangent(x, dx, c):
    """Directional derivatives (dT, dQ) of `thrust_and_torque` at x along dx, by the product rule."""
    omega, flow = x
    d_omega, d_flow = dx
    blade, d_blade = c.blade_speed * omega, c.blade_speed * d_omega
    omega_2, flow_2, both = omega * omega, flow * flow, 2.0 * omega * flow
    per_speed = 1.0 / (blade * blade + flow_2 + _REST) ** 0.5
    d_log_speed = (blade * d_blade + flow * d_flow) * per_speed * per_speed
    lean = 1.0 + c.asymmetry * blade * per_speed
    d_lean = c.asymmetry * d_blade * per_speed - (lean - 1.0) * d_log_speed
    thrust = omega * (c.thrust_30 * omega_2 + c.thrust_12 * flow_2)
    torque = omega * (c.torque_30 * omega_2 + c.torque_12 * flow_2)
    thrust = thrust + flow * (c.thrust_21 * omega_2 + c.thrust_03 * flow_2)
    torque = torque + flow * (c.torque_21 * omega_2 + c.torque_03 * flow_2)
    thrust_slope = 3.0 * c.thrust_30 * omega_2 + c.thrust_21 * both + c.thrust_12 * flow_2
    torque_slope = 3.0 * c.torque_30 * omega_2 + c.torque_21 * both + c.torque_12 * flow_2
    d_thrust = thrust_slope * d_omega
    d_torque = torque_slope * d_omega
    d_thrust = d_thrust + (c.thrust_21 * omega_2 + c.thrust_12 * both + 3.0 * c.thrust_03 * flow_2) * d_flow
    d_torque = d_torque + (c.torque_21 * omega_2 + c.torque_12 * both + 3.0 * c.torque_03 * flow_2) * d_flow
    d_thrust = lean * (d_thrust - d_log_speed * thrust) + d_lean * thrust
    return per_speed * d_thrust, per_speed * (d_torque - d_log_speed * torque)


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


def rates_tangent(x, dx, u, c):
    """Directional derivative of `rates` at x along dx: the Jacobian of the plant times dx."""
    d_thrust, d_torque = thrust_and_torque_tangent(x, dx, c)
    slip = x[1] - u[1]
    return (
        -c.motor_damping * dx[0] - c.load_gain * d_torque,
        c.inverse_mass * d_thrust - 2.0 * c.flow_drag * abs(slip) * dx[1],
    )


def variational_rates(y, u, c):
    """Rates of the state and of a perturbation of it, y = (omega_m, U_a, d omega_m, d U_a)."""
    x = (y[0], y[1])
    return rates(x, u, c) + rates_tangent(x, (y[2], y[3]), u, c)


def driven_rates(y, u, c):
    """Rates of the state and of its response to a change dV of the voltage, y = (.., d omega_m, d U_a, dV)."""
    d_omega, d_flow = rates_tangent((y[0], y[1]), (y[2], y[3]), u, c)
    return rates((y[0], y[1]), u, c) + (d_omega + c.voltage_gain * y[4], d_flow, 0.0 * y[4])


substep = runge_kutta(rates, 2)
"""`substep(x, u, c)`: the state after c.substep seconds of constant input, by one Runge-Kutta step."""

variational_substep = runge_kutta(variational_rates, 4)
"""`variational_substep(y, u, c)`: the same with a perturbation; exactly the derivative of `substep`."""

driven_substep = runge_kutta(driven_rates, 5)
"""`driven_substep(y, u, c)`: the same with a perturbation of the voltage, which is held."""


def substep_jacobian(x, u, c):
    """Jacobian of `substep` by rows, ((d omega'/d omega, d omega'/d U), (d U'/d omega, d U'/d U))."""
    first = variational_substep((x[0], x[1], 1.0, 0.0), u, c)
    second = variational_substep((x[0], x[1], 0.0, 1.0), u, c)
    return (first[2], second[2]), (first[3], second[3])
