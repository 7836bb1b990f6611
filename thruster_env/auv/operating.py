"""Operating range of a vehicle: the thrust of a speed, the range of its states, the integration step."""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np

from thruster_env.auv.dynamics import motion_substep
from thruster_env.auv.parameters import VehicleParameters, derive_constants

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

    def moved(count):
        c, x = derive_constants(p, dt / count), tuple(part * high[:, None])
        for _ in range(count):
            x = motion_substep(x, u, c)
        return np.array(x)

    count = 1
    with np.errstate(all="ignore"):
        before = moved(count)
        while count <= 64:
            after = moved(2 * count)
            if (np.abs(after - before) <= limit).all():
                return count
            count, before = 2 * count, after
    raise ValueError(f"dt must be short enough for 64 Runge-Kutta steps to follow the vehicle, but got {dt!r}")
