"""Paths to follow: straight pieces between points, and how far a position is from the nearest one.

All begin at rest at the origin, at the depth 0. Path IV has constant inputs that end where the papers' does, 10 m
to the north, 18 m to the east, 6 m down; the dynamic one switches planes and propeller to and fro.

The task of a vehicle: a path, a speed, steps of the depth, and the weights of the reward's terms.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from thruster_env.auv.dynamics import cruise_thrust, navigation_substep
from thruster_env.auv.parameters import SEGOROGENI, derive_constants
from thruster_env.auv.plant import CRUISE_SPEED, QUATERNION, SYMBOLS, Plant
from thruster_env.core.checks import as_floats, between, one_of, positive, short_repr, takes_arguments_of, within
from thruster_env.env.model_env import remembered
from thruster_env.env.plant_data import checked_weights

# Five manoeuvres instead of the papers' paths, which are named there but not defined.


CRUISE_THRUST = 2.845  # [N], holds 1 m/s
CRUISE_TORQUE = -0.017  # [N m]
TORQUE_PER_THRUST = -0.006  # [m], of the dynamic manoeuvre
LONGEST_STEP = 0.05  # [s]


class Manoeuvre(NamedTuple):
    """Planes [deg] over a time [s], held or, with periods [s], switched as the sign of a sine."""

    stern: float
    rudder: float
    duration: float
    stern_period: float | None = None
    rudder_period: float | None = None
    thrust_period: float | None = None
    thrust_swing: float = 0.0  # of the cruise thrust

    def inputs(self, time: float) -> tuple[float, float, float, float]:
        """X_prop [N], K_prop [N m], delta_s and delta_r [rad] at a time [s]."""
        thrust, torque = CRUISE_THRUST, CRUISE_TORQUE
        if self.thrust_period is not None:
            thrust *= 1.0 + self.thrust_swing * _switched(time, self.thrust_period)
            torque = TORQUE_PER_THRUST * thrust
        stern = math.radians(self.stern) * _switched(time, self.stern_period)
        return thrust, torque, stern, math.radians(self.rudder) * _switched(time, self.rudder_period)


MANOEUVRES: dict[str, Manoeuvre] = {
    "I": Manoeuvre(0.0, -5.0, 25.0),
    "II": Manoeuvre(5.0, 0.0, 25.0),
    "III": Manoeuvre(0.0, 0.0, 25.0),
    "IV": Manoeuvre(6.0483275, -1.3502966, 31.560424),
    "dynamic": Manoeuvre(5.0, 5.0, 25.0, 14.0, 10.0, 9.0, 0.4),
}
"""Manoeuvres by the papers' names: turn, dive, straight, in three dimensions, dynamic."""


@cache
def run(name: str) -> np.ndarray:
    """States (K + 1, 12) of Segorogeni's noise-free run of a manoeuvre, at most 0.05 s apart."""
    manoeuvre = MANOEUVRES[one_of("path", name, tuple(MANOEUVRES))]
    count = math.ceil(manoeuvre.duration / LONGEST_STEP - 1e-9)
    step = manoeuvre.duration / count
    c, x = derive_constants(SEGOROGENI, step), (0.0,) * 12
    states = [x]
    for k in range(count):
        x = navigation_substep(x, manoeuvre.inputs((k + 0.5) * step), c)
        states.append(x)
    trajectory = np.array(states)
    trajectory.setflags(write=False)
    return trajectory


def _switched(time: float, period: float | None) -> float:
    """The sign of sin(2 pi t/period), 1 without a period; asked in the middle of a step it is never zero."""
    return 1.0 if period is None else math.copysign(1.0, math.sin(2.0 * math.pi * time / period))


SPACING = 0.2  # [m] between points of a manoeuvre's path: 2 mm from the arc where it turns most tightly
STRAIGHT_AHEAD = ((0.0, 0.0, 0.0), (1.0, 0.0, 0.0))
MOST_POINTS = 10_000
PIECE = 7  # numbers of a piece: where it begins (3), its direction (3), its length


class Errors(NamedTuple):
    """How a pose differs from the path, (...) each."""

    cross_track: np.ndarray  # to starboard of the path [m]
    vertical: np.ndarray  # below it [m]
    course: np.ndarray  # yaw less the path's course, within half a turn [rad]


class Path(NamedTuple):
    """A path of straight pieces, by arc length; beyond its ends it continues straight."""

    starts: np.ndarray  # (K, 3) where each piece begins: north, east, down [m]
    directions: np.ndarray  # (K, 3), of length one
    lengths: np.ndarray  # (K,) [m]

    @property
    def numbers(self) -> np.ndarray:
        """The pieces, PIECE numbers each, as compiled code reads them."""
        return np.hstack([self.starts, self.directions, self.lengths[:, None]]).ravel()

    @property
    def points(self) -> np.ndarray:
        """The points (K + 1, 3) that the path joins [m]."""
        return np.vstack([self.starts, self.starts[-1] + self.lengths[-1] * self.directions[-1]])

    def piece(self, position: np.ndarray, piece: np.ndarray) -> np.ndarray:
        """The piece (...) that positions (..., 3) have reached, from their last piece (...).

        It is the first whose end is not behind the position; progress is never lost, and no corner is cut.
        """
        piece = np.array(piece, dtype=np.int64)
        while True:
            along = np.sum((position - self.starts[piece]) * self.directions[piece], axis=-1)
            ahead = (along > self.lengths[piece]) & (piece < len(self.lengths) - 1)
            if not ahead.any():
                return piece
            piece = piece + ahead

    def errors(self, position: np.ndarray, yaw: np.ndarray, piece: np.ndarray) -> Errors:
        """Errors of poses, positions (..., 3) [m] and yaw (...) [rad], that are at pieces (...)."""
        tangent = self.directions[piece]
        off = position - self.starts[piece]
        off = off - np.sum(off * tangent, axis=-1)[..., None] * tangent
        level = np.hypot(tangent[..., 0], tangent[..., 1])
        cosine, sine = tangent[..., 0] / level, tangent[..., 1] / level
        course = yaw - np.arctan2(sine, cosine)
        return Errors(
            off[..., 1] * cosine - off[..., 0] * sine, off[..., 2], np.arctan2(np.sin(course), np.cos(course))
        )


def make_path(path, depth: float = 0.0) -> Path:
    """A path from a manoeuvre's name or from two or more points (north, east, down) [m], so much [m] deeper.

    Raises ValueError if an argument is wrong; the message states the rule and the value.
    """
    if isinstance(path, str):
        points = by_arc_length(run(one_of("path", path, tuple(MANOEUVRES)))[:, 9:], SPACING)
    else:
        rule = "path must be a manoeuvre's name or two or more points of three finite numbers [m]"
        try:
            points = as_floats(path)
        except ValueError:
            points = np.empty(0)
        if points.ndim != 2 or points.shape[1] != 3 or len(points) < 2 or not np.isfinite(points).all():
            raise ValueError(f"{rule}, but got {short_repr(path)}")
        if len(points) > MOST_POINTS or np.abs(points).max() > 1e6:
            raise ValueError(
                f"path must have at most {MOST_POINTS} points within 1e6 m, but got {short_repr(path)}"
            )
    pieces = np.diff(points, axis=0)
    lengths = np.linalg.norm(pieces, axis=1)
    if (np.hypot(pieces[:, 0], pieces[:, 1]) < 1e-6 * (1.0 + lengths)).any():
        raise ValueError(
            f"each piece of path must lead somewhere else than up or down, but got {short_repr(path)}"
        )
    return Path(points[:-1] + [0.0, 0.0, depth], pieces / lengths[:, None], lengths)


def by_arc_length(points: np.ndarray, spacing: float) -> np.ndarray:
    """Points of a polyline (K, 3) at equal distances along it, close to `spacing`, both ends included."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    distances = np.linspace(0.0, along[-1], max(2, round(along[-1] / spacing) + 1))
    return np.stack([np.interp(distances, along, column) for column in points.T], axis=-1)


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
        path: "I", "II", "III", "IV" or "dynamic", the courses of `MANOEUVRES`; or points (north, east,
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


# PD on depth and course as a policy: from the measurements, from an estimate or from the true state.
#
# It has Stable-Baselines3's `predict(observation, state, episode_start, deterministic) -> (action, state)`, for
# one observation (d,) or one of each env (n, d). Its memory is `state`: pass None at first, then the state that
# the last call returned. Rows where `episode_start` is true forget. (Where a vector env resets on the next step,
# an episode starts one step after the last one was done.)


APPENDED = 6  # entries that observations of the tasks end with: depth of the path, then errors
SEEN = ("measurement", "motion", "navigation")


@dataclass(frozen=True, eq=False)
class DepthAndCourse:
    """Follow the path by a line of sight, with PD on pitch and yaw and P on the speed.

        theta_c = atan((k_z e_z + I)/L),   delta_s = K_theta (theta - theta_c) + K_q q,      I' = k_i e_z
        psi_c = course - atan(e_y/L),      delta_r = K_psi (psi - psi_c) + K_r r
        X_prop = X(u_ref) - K_u (u - u_ref),   where X(u) holds the speed u straight ahead

    e_y, e_z are the distances to starboard of the path and below it, L the distance ahead at which it is aimed at
    (line-of-sight guidance, Fossen 2011, section 10.3). Actions are cut off at the action space. The integral
    holds a depth against a trim, and a path against its slope; it is frozen while the pitch is at its limit.

    The gains were found by hand on `segorogeni` at 1 m/s: at small angles one radian of the rudder turns it with
    3.7 rad/s, one of the stern plane pitches it by 3 rad. They are the same for all tasks.
    """

    plant: Plant
    task: Task
    seen: str  # what observations begin with, one of SEEN
    index_of: dict[str, int]  # of theta, q, r and u in an observation
    look_ahead: float = 1.2  # L [m]
    depth_gain: float = 1.0  # k_z
    depth_integral: float = 0.2  # k_i [1/s]
    largest_pitch: float = 0.6  # that is asked for [rad]
    pitch_gain: float = 1.2  # K_theta
    pitch_rate_gain: float = 0.5  # K_q [s]
    course_gain: float = 1.0  # K_psi
    yaw_rate_gain: float = 0.4  # K_r [s]
    speed_gain: float = 4.0  # K_u [N s/m]

    @classmethod
    def for_env(cls, env, seen: str = "measurement", **gains: float) -> DepthAndCourse:
        """A controller for an env or vector env of a task.

        Args:
            env: `SegorogeniAUVPath-v0` or `SegorogeniAUVDepth-v0`, wrapped or not.
            seen: what its observations begin with: "measurement" for the channels of its sensors, "navigation" for
                twelve states, true (`thruster_env.env.env.ObserveState`) or estimated, "motion" for eight;
                these have no position, so that the path is compared with the vehicle's own reckoning, as with
                measurements.
            **gains: fields of this class.

        Raises:
            ValueError: if the env observes no path, or its sensors lack one of u, q, r and theta.
        """
        base = env.unwrapped
        plant, task = base.plant, base.task
        if not getattr(base, "single_env", type(base)).observes_errors:
            raise ValueError(f"an env must observe its path, as SegorogeniAUVPath-v0 does, but got {base}")
        if plant.attitude == QUATERNION:
            raise ValueError("attitude must be 'euler' for this controller, but the env's is 'quaternion'")
        names = plant.channels if one_of("seen", seen, SEEN) == "measurement" else SYMBOLS
        missing = [name for name in ("u", "q", "r", "theta") if name not in names]
        if missing:
            rule = "sensors must include u, q, r and theta for a controller without a filter"
            raise ValueError(f"{rule}, but the env has {', '.join(names)}")
        return cls(plant, task, seen, {name: names.index(name) for name in ("u", "q", "r", "theta")}, **gains)

    def predict(self, observation, state=None, episode_start=None, deterministic: bool = True):
        """Actions (..., p) for observations (..., d), and state (..., 2): integral [m] and piece of the path."""
        observation = np.asarray(observation, dtype=np.float64)
        integral, piece = np.moveaxis(
            remembered(state, episode_start, np.zeros((*observation.shape[:-1], 2))), -1, 0
        )
        u, q, r, theta = (observation[..., self.index_of[name]] for name in ("u", "q", "r", "theta"))
        across, below, course, piece = self._errors(observation, piece)
        pitch = np.arctan((self.depth_gain * below + integral) / self.look_ahead)
        limited = np.clip(pitch, -self.largest_pitch, self.largest_pitch)
        stern = self.pitch_gain * (theta - limited) + self.pitch_rate_gain * q
        rudder = self.course_gain * (course + np.arctan(across / self.look_ahead)) + self.yaw_rate_gain * r
        speed = self.task.speed
        thrust = cruise_thrust(self.plant.parameters, speed) - self.speed_gain * (u - speed)
        change = self.depth_integral * self.plant.dt * below
        integral = integral + np.where((pitch != limited) & (change * pitch > 0.0), 0.0, change)
        return self._action(thrust, stern, rudder), np.stack([integral, piece], axis=-1)

    def _errors(self, observation: np.ndarray, piece: np.ndarray):
        """Cross-track, vertical and course error, and the piece of the path."""
        depth, across, below, sine, cosine, _ = np.moveaxis(observation[..., -APPENDED:], -1, 0)
        if self.seen != "navigation":
            return across, below, np.arctan2(sine, cosine), piece
        path, position = self.task.path, observation[..., 9:12]
        piece = path.piece(position, piece)
        errors = path.errors(position, observation[..., 8], piece)
        vertical = position[..., 2] - depth if self.task.step_size > 0.0 else errors.vertical
        return errors.cross_track, vertical, errors.course, piece

    def _action(self, thrust, stern, rudder) -> np.ndarray:
        plant = self.plant
        thrust = np.clip(thrust, 0.0, plant.max_thrust)
        planes = [np.clip(angle, -plant.max_plane, plant.max_plane) for angle in (stern, rudder)]
        torque = [] if plant.propeller_torque is not None else [np.zeros_like(thrust)]
        return np.stack([thrust, *torque, *planes], axis=-1).astype(np.float32)
