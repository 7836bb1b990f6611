"""The vehicle at the papers' noise, as truth and as filters assume it, and the worlds that it moves in."""

from __future__ import annotations

from typing import Any

from thruster_env.auv.model import auv_model
from thruster_env.auv.presets import SEGOROGENI
from thruster_env.core.checks import one_of
from thruster_env.model.state_space import StateSpaceModel
from tuning.experiments.vehicle.printed import DT, MEASURED, NOISE

ANGLE_NOISE = 1e-6  # of roll and pitch, standard deviation per step [rad]: so Q of eight states is not singular
START = (1e-3,) * 6 + (1e-4,) * 2 + (0.0,) * 4  # standard deviations about rest at the origin; P_0 is not printed
WORLDS = {"vehicle": SEGOROGENI, "no restoring moments": SEGOROGENI._replace(zG=0.0)}
"""Segorogeni with our parameters, and the same with the centre of gravity at the centre of buoyancy.

Then nothing depends on roll and pitch, so that the papers' six velocities are a closed system.
"""
COUNTS = {"velocities": 6, "motion": 8, "navigation": 12}


def papers_model(states: str, world: str = "vehicle", **arguments) -> StateSpaceModel:
    """The model of so many states at the papers' noise and sensors, u, v, w and r measured at every step of 1 ms.

    Process noise is on velocities, as in the papers, and very small on roll and pitch; yaw and position have none.
    The inputs are X_prop, K_prop, delta_s and delta_r, and for "velocities" also roll and pitch.

    Args:
        states: "velocities", "motion" or "navigation".
        world: one of `WORLDS`.
        **arguments: others of `thruster_env.auv.model.auv_model`.

    Raises:
        ValueError: for an unknown world, and as `auv_model` does.
    """
    noise = (NOISE,) * 6 + (ANGLE_NOISE**2,) * 2 + (0.0,) * 4
    settings: dict[str, Any] = {
        "preset": WORLDS[one_of("world", world, tuple(WORLDS))],
        "dt": DT,
        "propeller_torque": None,
        "sensors": MEASURED,
        "measurement_noise_cov": (NOISE,) * len(MEASURED),
        "initial_state": {"mean": (0.0,) * 12, "cov": [deviation**2 for deviation in START]},
        "process_noise_cov": noise[: COUNTS[one_of("states", states, tuple(COUNTS))]],
    }
    return auv_model(states=states, **settings | arguments)
