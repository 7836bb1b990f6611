"""The vehicle at the papers' noise: their settings and tables, truth, and what filters assume of it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

from thruster_env.auv.model import auv_model
from thruster_env.auv.presets import SEGOROGENI
from thruster_env.core.checks import one_of
from thruster_env.model.state_space import StateSpaceModel

# The runs of the papers on the vehicle: the form of a table, and the settings of both papers.


DT = 0.001  # [s]
NOISE = 1e-6  # Q = R = 1e-6 I, in the units of the velocities squared
MEASURED = ("u", "v", "w", "r")  # H picks these
POSE = ("x", "y", "z", "psi")  # [m], [m], [m], [rad]
FUZZY_LOW, FUZZY_HIGH = (0.0,) * 6, (1.0,) * 6  # bounds of the velocities; the rules are the corners
RUNS = 10  # "mean of 10 runs"
NOT_PRINTED = (
    "number of steps",
    "thrust, propeller torque and stern plane",
    "P_0",
    "the vehicle's coefficients and restoring moments",
    "what the reference paths are",
    "how measurements were made",
    "what RMSE and percent are taken over",
)


class PrintedRow(NamedTuple):
    """One filter on one path."""

    rmse: Mapping[str, float]  # by component of the pose: x, y, z [m], psi [rad]; not every table has all
    seconds: float
    final_percent: Mapping[str, float] = {}  # error at the end over the path's end, it seems


class PrintedPath(NamedTuple):
    """Ensemble and fuzzy Kalman filter on one path."""

    enkf: PrintedRow
    fkf: PrintedRow
    remark: str = ""  # misprint, or how it was interpreted


class Paper(NamedTuple):
    """A source with remarks for its readers."""

    name: str
    source: str
    remarks: tuple[str, ...]


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
