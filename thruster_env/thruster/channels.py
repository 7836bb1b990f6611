"""Channels: quantities of a thruster that can be measured.

The functions are of the state x = (omega_m, U_a), the outputs y = (T,), the input u = (V_s,) and the constants c
of the equations of motion; the derivatives of T by the state are dy[0].
"""

from __future__ import annotations

from thruster_env.env.copies import Channel
from thruster_env.model.quantities import Quantity


def thrust(x, y, u, c):
    """Thrust T [N]."""
    return y[0]


def thrust_slopes(x, dy, c):
    """Derivatives of the thrust [N s/rad, N s/m]."""
    return dy[0]


def speed(x, y, u, c):
    """Motor speed omega_m [rad/s]."""
    return x[0]


def speed_slopes(x, dy, c):
    """Derivatives of the speed."""
    return (1.0, 0.0)


def speed_magnitude(x, y, u, c):
    """|omega_m| [rad/s], of a tachometer without a sign."""
    return abs(x[0])


def speed_magnitude_slopes(x, dy, c):
    """Derivatives of the speed's magnitude; at rest those ahead."""
    return (1.0 if x[0] >= 0.0 else -1.0, 0.0)


def current(x, y, u, c):
    """Current of a brushed motor without friction, I = K2 (K2 V_s - K1 omega_m)/(K_h K1) [A].

    The voltage constant is K1/K2 and the inertia 1/K_h.
    """
    driving = c.voltage_gain * u[0] - c.motor_damping * x[0]
    return c.voltage_gain * driving / (c.load_gain * c.motor_damping)


MAX_CHANNELS = 4  # that a thruster may be measured by at once; a draw of noise makes four numbers

CHANNELS: dict[str, Channel] = {
    "thrust": Channel(Quantity("measured thrust", "thrust", "N"), 0.25, thrust, thrust_slopes),
    "speed": Channel(Quantity("measured speed", "speed", "rad/s"), 4.0, speed, speed_slopes),
    "speed-magnitude": Channel(
        Quantity("measured speed-magnitude", "speed-magnitude", "rad/s"),
        4.0,
        speed_magnitude,
        speed_magnitude_slopes,
        affine=False,
    ),
    "current": Channel(Quantity("measured current", "current", "A"), 0.01, current),
}
"""Channels by name; a further one may be added."""
