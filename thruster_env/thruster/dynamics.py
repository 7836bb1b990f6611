"""The equations of motion of a thruster, once.

State x = (omega_m, U_a): motor speed [rad/s], section-average flow velocity [m/s].
Input u = (V_s, U_0): source voltage [V], ambient flow velocity along the thruster's axis [m/s].

    d omega_m/dt = -K1 omega_m + K2 V_s - K_h Q
    d U_a/dt     = -(K4/K3) (U_a - U_0) |U_a - U_0| + T/K3

Only the operators + - * / abs and ** occur, so the same source runs on floats, NumPy arrays and torch
tensors and compiles with numba. Source: Healey et al. (1995), as printed by Nurhadi et al. (2022).
"""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import pygame

from thruster_env.core.compiled import inlined
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


@inlined
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


@inlined
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


@inlined
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


@inlined
def substep_jacobian(x, u, c):
    """Jacobian of `substep` by rows, ((d omega'/d omega, d omega'/d U), (d U'/d omega, d U'/d U))."""
    first = variational_substep((x[0], x[1], 1.0, 0.0), u, c)
    second = variational_substep((x[0], x[1], 0.0, 1.0), u, c)
    return (first[2], second[2]), (first[3], second[3])


# The propeller seen from the side and end on, blurred by the angle that it turned while the frame was exposed.
#
# At full voltage a blade moves on to the place of the next in less than a step. Sharp pictures of every step
# would then seem to stand still or to turn backwards. A frame is the mean of all pictures between two angles, as
# from a camera whose shutter stays open from one frame to the next.


BLADES = 4
HUB = 0.26  # radius of the hub, of the propeller's
TABLE = 64  # pictures from one blade to the next
SMOOTH = 4  # a picture is drawn this many times larger and averaged
PITCH = math.pi / 6  # of the drawn blades, from the propeller's plane [rad]
BRONZE, DARK_BRONZE, HUB_BRONZE = np.array((205, 158, 92)), np.array((128, 92, 50)), (150, 112, 64)


class BlurredPicture:
    """Means over any range of angles of a picture that repeats from blade to blade.

    The mean from a to b is (S(b) - S(a)) / (b - a), S being the running sum of the pictures: exact, and as quick
    for a whole turn as for a degree.
    """

    def __init__(self, draw, size: tuple[int, int]):
        """Draw TABLE pictures with draw(surface, angle), angles in rad, size (width, height) in px."""
        width, height = size
        self._sums = np.zeros((TABLE + 1, height, width, 4), dtype=np.float32)
        for k in range(TABLE):
            large = pygame.Surface((width * SMOOTH, height * SMOOTH), pygame.SRCALPHA, 32)
            draw(large, (k + 0.5) / TABLE * 2 * math.pi / BLADES)
            # Averaged with empty surroundings of zeros, colours come out multiplied by their coverage.
            small = pygame.transform.smoothscale(large, size)
            pixels = np.frombuffer(pygame.image.tobytes(small, "RGBA"), np.uint8)
            self._sums[k + 1] = self._sums[k] + pixels.reshape(height, width, 4)

    def mean(self, start: float, end: float) -> np.ndarray:
        """The mean from one angle [rad] to another, premultiplied RGBA, (height, width, 4) of uint8."""
        low, high = (angle * BLADES * TABLE / (2 * math.pi) for angle in sorted((start, end)))
        if high - low < 1.0:  # finer than the table: as if it turned by one picture of it
            low = (low + high - 1.0) / 2
            high = low + 1.0
        before = math.floor(low / TABLE) * TABLE  # whole blades, which would only cost digits
        low, high = low - before, high - before
        return ((self._sum(high) - self._sum(low)) / (high - low) + 0.5).astype(np.uint8)

    def _sum(self, position: float) -> np.ndarray:
        rounds, position = divmod(position, TABLE)
        k = min(int(position), TABLE - 1)
        part = np.float32(position - k)
        return self._sums[-1] * np.float32(rounds) + (1 - part) * self._sums[k] + part * self._sums[k + 1]


@cache  # all renderers and their copies share the tables
def end_view(radius: float) -> BlurredPicture:
    """The propeller of a radius [px] seen from port, in a square around it; angles count clockwise from up."""
    r, half_width = _blade()

    def draw(surface, angle):
        middle = surface.get_width() / 2
        pixels = radius * SMOOTH
        for blade in range(BLADES):
            centre = angle + 2 * math.pi * blade / BLADES
            edge = half_width * math.cos(PITCH) / r
            around = np.concatenate((centre - edge, (centre + edge)[::-1]))
            out = np.concatenate((r, r[::-1])) * pixels
            outline = np.stack((middle + out * np.sin(around), middle - out * np.cos(around)), axis=-1)
            pygame.draw.polygon(surface, BRONZE.tolist(), outline.tolist())
            # The line where a blade is thickest, so that single blades are seen to turn.
            tip = (middle + 0.9 * pixels * math.sin(centre), middle - 0.9 * pixels * math.cos(centre))
            pygame.draw.line(surface, (176, 130, 72), (middle, middle), tip, SMOOTH)
        pygame.draw.circle(surface, HUB_BRONZE, (middle, middle), HUB * pixels)
        pygame.draw.circle(surface, (196, 152, 92), (middle, middle), HUB * pixels * 0.45)

    side = math.ceil(2 * radius)
    return BlurredPicture(draw, (side, side))


@cache
def side_view(radius: float) -> BlurredPicture:
    """The same propeller seen from the side, its axis level and water driven to the right, width 1.2 radii."""
    r, half_width = _blade()
    across = np.concatenate((-half_width, half_width[::-1]))  # along the blade's chord
    out = np.concatenate((r, r[::-1]))

    def draw(surface, angle):
        width, height = surface.get_size()
        pixels = radius * SMOOTH

        def draw_blade(centre):
            around = centre + across * math.cos(PITCH) / out
            axial = -across * math.sin(PITCH)  # the leading edge is upstream, to the left
            outline = np.stack((width / 2 + pixels * axial, height / 2 - pixels * out * np.cos(around)), axis=-1)
            light = 0.5 + 0.5 * math.sin(centre)  # blades at the back are in the shade
            pygame.draw.polygon(surface, (DARK_BRONZE + light * (BRONZE - DARK_BRONZE)).tolist(), outline.tolist())

        centres = [angle + 2 * math.pi * blade / BLADES for blade in range(BLADES)]
        behind = sorted((c for c in centres if math.sin(c) < 0), key=math.sin)
        front = sorted((c for c in centres if math.sin(c) >= 0), key=math.sin)
        for centre in behind:
            draw_blade(centre)
        hub = pygame.Rect(0, 0, 0.62 * pixels, 2 * HUB * pixels)
        hub.center = (round(width / 2), round(height / 2))
        pygame.draw.rect(surface, HUB_BRONZE, hub)
        cap = pygame.Rect(0, 0, 0.5 * pixels, hub.height)
        cap.center = hub.midleft
        pygame.draw.ellipse(surface, HUB_BRONZE, cap)
        for centre in front:
            draw_blade(centre)

    return BlurredPicture(draw, (math.ceil(1.2 * radius), math.ceil(2 * radius)))


def _blade() -> tuple[np.ndarray, np.ndarray]:
    """Radii from root to tip and half the blade's width there, of the propeller's radius.

    Wide at the tip, as blades in a tunnel are, with rounded corners.
    """
    r = np.concatenate((np.linspace(0.2, 0.9, 8), (0.94, 0.97, 0.99, 1.0)))
    half_width = 0.17 + 0.26 * (r - 0.2) / 0.8
    half_width[-4:] *= (0.97, 0.9, 0.78, 0.55)
    return r, half_width
