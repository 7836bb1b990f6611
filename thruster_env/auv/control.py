"""PD on depth and course as a policy: from the measurements, from an estimate or from the true state.

It has Stable-Baselines3's `predict(observation, state, episode_start, deterministic) -> (action, state)`, for one
observation (d,) or one of each env (n, d). Its memory is `state`: pass None at first, then the state that the last
call returned. Rows where `episode_start` is true forget. (Where a vector env resets on the next step, an episode
starts one step after the last one was done.)
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thruster_env.auv.dynamics import cruise_thrust
from thruster_env.auv.paths import Task
from thruster_env.auv.plant import SYMBOLS, Plant
from thruster_env.core.checks import one_of
from thruster_env.env.model_env import remembered

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
                twelve states, true (`thruster_env.env.commands.ObserveState`) or estimated, "motion" for eight;
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
