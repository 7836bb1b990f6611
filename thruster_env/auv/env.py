"""`SegorogeniAUV-v0`: thrust and two planes in, noisy measurements out, the state hidden."""

from __future__ import annotations

from collections.abc import Sequence

import gymnasium as gym
import numpy as np

from thruster_env.auv.engine import memory as at
from thruster_env.auv.engine.copies import Copies
from thruster_env.auv.modelled import ModelledVehicle
from thruster_env.auv.plant import Plant, make_plant
from thruster_env.auv.rendering.env import RenderedVehicle
from thruster_env.auv.task import make_task
from thruster_env.core.arguments import arguments_of, takes_arguments_of
from thruster_env.core.memory import TIME
from thruster_env.env.env import PlantEnv
from thruster_env.env.report import ReportRows


class SegorogeniAUVEnv(ModelledVehicle, RenderedVehicle, PlantEnv):
    """An autonomous underwater vehicle: go straight north at a depth and a speed, by propeller and two planes.

    ## Action space
    | num | action | min | max | unit |
    |---|---|---|---|---|
    | 0 | thrust X_prop, clipped | 0 | max_thrust | N |
    | 1 | stern plane delta_s, clipped; positive pitches the nose down | -max_plane | max_plane | rad |
    | 2 | rudder delta_r, clipped; positive turns to port | -max_plane | max_plane | rad |

    The propeller's torque is propeller_torque times its thrust. If propeller_torque is None, the torque K_prop
    [N m] is a separate action, after the thrust.

    ## Observation space
    One entry a channel of the `sensors` in their order, then, for each channel that may be missing, 1 where the
    measurement is valid and 0 where the last one is repeated. By default:

    | num | observation | min | max | unit |
    |---|---|---|---|---|
    | 0-2 | velocities u, v, w over ground (DVL, 5 Hz) | -inf | inf | m/s |
    | 3-5 | rates p, q, r (gyros) | -inf | inf | rad/s |
    | 6-7 | roll phi, pitch theta (AHRS) | -inf | inf | rad |
    | 8 | yaw psi (compass), not wrapped | -inf | inf | rad |
    | 9 | depth z (pressure, 10 Hz) | -inf | inf | m |
    | 10-13 | whether u, v, w and z are valid | -inf | inf | - |

    ## State (hidden; in `info["state"]`)
    | num | state | unit |
    |---|---|---|
    | 0-2 | velocities u, v, w ahead, to starboard, down | m/s |
    | 3-5 | rates p, q, r of roll, pitch, yaw | rad/s |
    | 6-8 | roll phi, pitch theta, yaw psi | rad |
    | 9-11 | position x north, y east, z down | m |

    ## Reward
    | term | weight | default |
    |---|---|---|
    | -(distance to starboard or port of the path [m])^2 | cross_track_weight | 1 |
    | -(distance above or below it [m])^2 | vertical_weight | 1 |
    | -((u - speed) [m/s])^2 | speed_weight | 0.1 |
    | -(delta_s^2 + delta_r^2)/max_plane^2 | plane_weight | 0.01 |

    Errors are those of the true state after the step, independent of the sensors.

    ## Info
    `state` (12,), `measurement` (m,) in float64, `inputs` (4,) X_prop, K_prop, delta_s, delta_r that act, after
    lags, `current` (3,) to the north, to the east and down [m/s], `path_errors` (2,) to starboard of the path and
    below it [m], `path_piece`, the number of the straight piece of the path that the vehicle has got to,
    `reckoned` (4,) north, east, down [m] and yaw [rad] by the vehicle's own reckoning (see
    `engine.guidance`), `time` [s]; where a channel may be missing also `measurement_valid` (m,).

    ## Episode
    Starts about a cruise at 1 m/s, N(mean, diag) with 0.05 m/s in u, 0.02 m/s and rad/s in the other velocities,
    0.01 rad and 0.01 m besides, unless `initial_state` says otherwise ({"speed": 0} for rest, as the papers), or
    `reset(options={"state": [..]})`. Truncated after 1200 steps (60 s); terminated where pitch is beyond 80 deg,
    near which Euler angles end, or the state is not finite. There is no surface: z < 0 ends nothing.

    ## Arguments
    The list, with units and defaults, is that of `thruster_env.auv.plant.make_plant` (the vehicle, its noise,
    sensors and current; without `substeps`) and of `thruster_env.auv.task.make_task` (the path and the weights
    above); `render_mode`, and `render_size`, (width, height) of pictures in pixels, come on top. All but the first
    go by name. A wrong value raises a ValueError.
    """

    observes_errors = False

    @takes_arguments_of(make_plant, make_task, leaving_out=["substeps"])
    def __init__(self, *, render_mode: str | None = None, render_size: Sequence[int] | None = None, **arguments):
        """Build the plant; see the class for the arguments."""
        self._build(arguments, make_task(**arguments_of(make_task, arguments)), (render_mode, render_size))

    def _build(self, arguments: dict, task, rendering: tuple) -> None:
        plant: Plant = make_plant(**arguments_of(make_plant, arguments))
        start = arguments["initial_state"]
        if start is None or set(start) == {"speed"}:  # the others say how deep it begins
            plant = at_depth(plant, arguments["depth"])
        self.plant, self.task, self.inputs = plant, task, plant.inputs
        m = len(plant.channels)
        measurement = slice(at.READINGS, at.READINGS + m)
        info: dict[str, int | slice] = {
            "state": slice(at.STATE, at.STATE + at.N),
            "measurement": measurement,
            "inputs": slice(at.INPUTS, at.INPUTS + 4),
            "current": slice(at.CURRENT, at.CURRENT + 3),
            "path_errors": slice(at.TRUE_ERRORS, at.TRUE_ERRORS + 2),
            "path_piece": at.PIECE,
            "reckoned": slice(at.RECKONED, at.RECKONED + 4),
            "time": TIME,
        }
        appended = (at.PATH_DEPTH, *range(at.ERRORS, at.ERRORS + 5)) if self.observes_errors else ()
        rows = ReportRows(measurement, slice(at.VALID, at.VALID + m), plant.dropping_channels, appended, info)
        self._set_up(action_space(plant), rows, *rendering)

    def copies_of(self, count: int) -> Copies:
        """Return `count` vehicles with the env's task."""
        return Copies(self.plant, self.task, count)


def action_space(plant: Plant) -> gym.spaces.Box:
    """Thrust from zero, planes, and between them the torque where it is an action, each to its limit."""
    low, high = (limit.astype(np.float32) for limit in plant.input_limits)
    return gym.spaces.Box(low, high, dtype=np.float32)


def at_depth(plant: Plant, depth: float) -> Plant:
    """The plant whose initial state has its mean at a depth [m]."""
    mean = plant.initial_mean.copy()
    mean[at.Z] = depth
    return plant._replace(initial_mean=mean)
