"""The task of a vehicle: a path, a speed, steps of the depth, and the weights of the reward's terms."""

from __future__ import annotations

from typing import NamedTuple

from thruster_env.auv.paths import STRAIGHT_AHEAD, Path, make_path
from thruster_env.auv.plant import CRUISE_SPEED
from thruster_env.core.checks import between, positive, takes_arguments_of, within
from thruster_env.core.compiled import inlined
from thruster_env.env.plant_data import checked_weights

DEFAULT_WEIGHTS = (1.0, 1.0, 0.1, 0.01)  # cross-track, vertical, speed, planes
LARGEST_DEPTH = 1e4  # [m]
HOLD_TIMES = (1e-3, 1e6)  # [s]


class Task(NamedTuple):
    """A path to follow at a speed, with steps of its depth, and a reward from the true state; see `step_cost`."""

    path: Path
    speed: float  # along the body [m/s]
    step_size: float = 0.0  # of the depth [m]
    hold_time: float = 15.0  # between two steps of the depth [s]
    weights: tuple[float, ...] = DEFAULT_WEIGHTS


@inlined
def step_cost(cross_track, vertical, speed_error, stern, rudder, weights):
    """Cost of a step, minus its reward: w_y e_y^2 + w_z e_z^2 + w_u (u - u_ref)^2 + w_d (delta_s^2 + delta_r^2).

    Errors in m and m/s, planes over their limit.
    """
    tracking = weights[0] * cross_track * cross_track + weights[1] * vertical * vertical
    return tracking + weights[2] * speed_error * speed_error + weights[3] * (stern * stern + rudder * rudder)


def make_task(
    path=STRAIGHT_AHEAD,
    depth: float = 0.0,
    speed: float = CRUISE_SPEED,
    cross_track_weight: float = DEFAULT_WEIGHTS[0],
    vertical_weight: float = DEFAULT_WEIGHTS[1],
    speed_weight: float = DEFAULT_WEIGHTS[2],
    plane_weight: float = DEFAULT_WEIGHTS[3],
) -> Task:
    """Make a task from plain arguments, the same ones that the env takes.

    Args:
        path: "I", "II", "III", "IV" or "dynamic", the courses of `manoeuvres.MANOEUVRES`; or points (north, east,
            down) [m] that straight lines join. It continues straight beyond its ends. By default straight north.
        depth: of the path's origin [m].
        speed: u to keep [m/s].
        cross_track_weight: of the squared distance to starboard or port of the path [1/m^2].
        vertical_weight: of the squared distance above or below it [1/m^2].
        speed_weight: of the squared error of the speed [s^2/m^2].
        plane_weight: of the squares of both planes' angles over their limit.

    Raises:
        ValueError: if an argument is wrong; the message states the rule and the value.
    """
    weights = checked_weights(
        cross_track=cross_track_weight, vertical=vertical_weight, speed=speed_weight, plane=plane_weight
    )
    depth = within("depth", depth, LARGEST_DEPTH)
    return Task(make_path(path, depth), positive("speed", speed, zero_allowed=True), weights=weights)


@takes_arguments_of(make_task, leaving_out=["path"], defaults={"depth": 6.0})
def make_depth_task(step_size: float = 2.0, hold_time: float = 15.0, **arguments) -> Task:
    """The same for steps of the depth on a straight course north.

    Args:
        step_size: by which the depth goes up or down [m], at random, within twice of it about `depth`.
        hold_time: between two steps [s].
        **arguments: those of `make_task`, without path; the depth, where it begins, is 6 m by default.
    """
    task = make_task(**arguments)
    size = within("step_size", positive("step_size", step_size, zero_allowed=True), LARGEST_DEPTH)
    return task._replace(step_size=size, hold_time=between("hold_time", hold_time, *HOLD_TIMES, "s"))
