"""What can be measured of a thruster."""

from __future__ import annotations

CHANNELS = {
    "thrust": ("N", 0.25),
    "speed": ("rad/s", 4.0),
    "speed-magnitude": ("rad/s", 4.0),
    "current": ("A", 0.01),
}
"""Quantities that can be measured, by name, with their unit and the default variance of their noise.

"speed" is omega_m, "speed-magnitude" |omega_m| (a tachometer without a sign), "current" that of a brushed motor
without friction, I = K2 (K2 V_s - K1 omega_m)/(K_h K1): the voltage constant is K1/K2 and the inertia 1/K_h.
"""
