"""`SegorogeniAUV-v0` and its tasks, as single and vector envs, and how they are drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np

from thruster_env.auv.dynamics import angled_state
from thruster_env.auv.equations import PHI, PSI, THETA, U, X, Y, Z, page_of
from thruster_env.auv.paths import make_depth_task, make_task
from thruster_env.auv.plant import QUATERNION, SYMBOLS, Plant, make_plant
from thruster_env.auv.rendering import ChartEntry, Renderer
from thruster_env.core.checks import arguments_of, takes_arguments_of
from thruster_env.env.copies import TIME
from thruster_env.env.env import PlantEnv, PlantVectorEnv
from thruster_env.env.model_env import ModelledEnv, Split, split
from thruster_env.render.renderer import MODES

if TYPE_CHECKING:
    from thruster_env.auv.rendering import Overlay
    from thruster_env.model.state_space import StateSpaceModel


# What every env and vector env offers to filters.


class ModelledVehicle(ModelledEnv):
    """An env with a `plant` that offers its model to filters; changes are those of `model.model_of_plant`.

    Unless `states` says otherwise, that is the smaller of "motion" (8 states) and "navigation" (12) that predicts
    all channels: of the default sensors, which have compass and depth, "navigation".
    """

    plant_name = "a vehicle"
    plant: Plant

    def model_maker(self) -> Callable[..., StateSpaceModel]:
        """`model.model_of_plant`."""
        from thruster_env.auv.model import model_of_plant

        return model_of_plant

    def state_space_model(self, **changes) -> StateSpaceModel:
        """See `thruster_env.env.model_env`; for "velocities" roll and pitch are as measured, else level."""
        attitude = "measured" if {"phi", "theta"} <= set(self.plant.channels) else "level"
        if self.plant.attitude == QUATERNION:
            attitude = "input"  # which has no effect
        return super().state_space_model(**{"attitude": attitude} | changes)

    def measured_inputs(self, model: StateSpaceModel) -> Split | None:
        """The channels that are inputs of a model beside the action, by symbol; None if there are none."""
        return split(model, len(self.plant.inputs), self.plant.channels)

    def tuned_differences(self, tuned_for: Mapping, file: str) -> list[str]:
        """See `plant.check_same_plant`."""
        from thruster_env.auv.plant import check_same_plant

        return check_same_plant(tuned_for, self.plant, file)

    def overlay(self, label: str, model: StateSpaceModel, mean: np.ndarray, cov: np.ndarray) -> Overlay:
        """The states of a belief that a rendered vehicle shows beside the truth, by their symbols."""
        from thruster_env.auv.rendering import Overlay

        names = {state.symbol: i for i, state in enumerate(model.states)}
        if model.turns:
            names, mean = {symbol: i for i, symbol in enumerate(SYMBOLS)}, np.array(angled_state(tuple(mean)))
            names = {symbol: i for symbol, i in names.items() if i < len(mean)}
        std = np.sqrt(np.maximum(np.diag(cov), 0.0)).tolist()
        symbol_of = {"x": "x", "y": "y", "depth": "z", "phi": "phi", "theta": "theta", "psi": "psi", "u": "u"}
        known = {name: names[symbol] for name, symbol in symbol_of.items() if symbol in names}
        values = {name: float(mean[i]) for name, i in known.items()}
        spreads = {f"{name}_std": std[i] for name, i in known.items() if f"{name}_std" in Overlay._fields}
        return Overlay(label, **values, **spreads)


# `SegorogeniAUV-v0`: thrust and two planes in, noisy measurements out, the state hidden.


class SegorogeniAUVEnv(ModelledVehicle, PlantEnv):
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

    With `attitude="quaternion"` entries 6-9 are a unit quaternion, scalar first, and 10-12 the position.

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
    `thruster_env.auv.env`), `time` [s]; where a channel may be missing also `measurement_valid` (m,).

    ## Episode
    Starts about a cruise at 1 m/s, N(mean, diag) with 0.05 m/s in u, 0.02 m/s and rad/s in the other velocities,
    0.01 rad and 0.01 m besides, unless `initial_state` says otherwise ({"speed": 0} for rest, as the papers), or
    `reset(options={"state": [..]})`. Truncated after 1200 steps (60 s); terminated where pitch is beyond 80 deg,
    near which Euler angles end (not with a quaternion), or the state is not finite. There is no surface: z < 0
    ends nothing.

    ## Arguments
    The list, with units and defaults, is that of `thruster_env.auv.plant.make_plant` (the vehicle, its noise,
    sensors and current; without `substeps`) and of `thruster_env.auv.paths.make_task` (the path and the weights
    above); `render_mode`, and `render_size`, (width, height) of pictures in pixels, come on top. All but the first
    go by name. A wrong value raises a ValueError.
    """

    metadata: dict[str, Any] = {"render_modes": list(MODES), "render_fps": 20}
    page_of = staticmethod(page_of)
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
        info = "state", "measurement", "inputs", "current", "path_errors", "path_piece", "reckoned", "time"
        appended = ("path_depth", "errors") if self.observes_errors else ()
        self._set_up(action_space(plant), info, appended, plant.dropping_channels, *rendering)

    def make_renderer(self) -> Renderer:
        """The renderer of the vehicle and its path."""
        assert self.render_mode is not None  # a renderer is made for a mode only
        return Renderer(
            self.render_mode,
            path=self.task.path.points,
            max_thrust=self.plant.max_thrust,
            max_plane=self.plant.max_plane,
            dt=self.plant.dt,
            frames_per_second=self.metadata["render_fps"],
            size=self.render_size,
        )

    def moment_of(self, report: list[float]) -> ChartEntry:
        """The renderer's input from a report: truth, measurements, the path abreast and the actuators."""
        values = self._by_name(report)
        state, inputs = values["state"], values["inputs"]
        if self.plant.attitude == QUATERNION:
            state = angled_state(tuple(state))
        measured = dict(zip(self.plant.channels, values["measurement"], strict=True))
        return ChartEntry(
            time=report[TIME],
            x=state[X],
            y=state[Y],
            depth=state[Z],
            phi=state[PHI],
            theta=state[THETA],
            psi=state[PSI],
            u=state[U],
            measured_depth=measured.get("z"),
            measured_u=measured.get("u"),
            reference_depth=state[Z] - values["path_errors"][1],
            reference_u=self.task.speed,
            thrust=inputs[0],
            stern=inputs[2],
            rudder=inputs[3],
        )


def action_space(plant: Plant) -> gym.spaces.Box:
    """Thrust from zero, planes, and between them the torque where it is an action, each to its limit."""
    low, high = (limit.astype(np.float32) for limit in plant.input_limits)
    return gym.spaces.Box(low, high, dtype=np.float32)


def at_depth(plant: Plant, depth: float) -> Plant:
    """The plant whose initial state has its mean at a depth [m]."""
    mean = plant.initial_mean.copy()
    mean[-1] = depth
    return plant._replace(initial_mean=mean)


# The other envs: a path to follow, and steps of the depth.


class SegorogeniAUVPathEnv(SegorogeniAUVEnv):
    """An autonomous underwater vehicle: follow a path in three dimensions at a speed.

    As `SegorogeniAUVEnv`, except for these:

    ## Observation space
    Channels and validity flags, then the path:

    | num | observation | min | max | unit |
    |---|---|---|---|---|
    | -6 | depth of the path abreast of the vehicle | -inf | inf | m |
    | -5 | distance to starboard of the path | -inf | inf | m |
    | -4 | distance below the path | -inf | inf | m |
    | -3 | sine of yaw less the path's course | -inf | inf | - |
    | -2 | its cosine | -inf | inf | - |
    | -1 | u less the speed to keep | -inf | inf | m/s |

    These compare the path with what the vehicle itself can know, never with the true state: yaw, depth and speed
    as measured, with noise, and a position by dead reckoning from measured velocities and attitude, from the known
    start. So they drift as the vehicle's own navigation does, by decimetres in half a minute with the default
    sensors, and more with others. `info["path_errors"]` and the reward have the true ones. Where a filter's
    estimate is in the observation, `auv.control` compares that with the path in their place, and with
    the depth.

    ## Reward
    Errors are measured to the point of the path abreast of the vehicle, so the time does not matter; the speed has
    its own term.

    ## Arguments
    `path` is "IV" by default; see `thruster_env.auv.paths.make_task`. Episodes are truncated after 600 steps (30
    s).
    """

    observes_errors = True

    @takes_arguments_of(make_plant, make_task, leaving_out=["substeps"], defaults={"path": "IV"})
    def __init__(self, *, render_mode: str | None = None, render_size: Sequence[int] | None = None, **arguments):
        """Build the plant; see the class for the arguments."""
        self._build(arguments, make_task(**arguments_of(make_task, arguments)), (render_mode, render_size))


class SegorogeniAUVDepthEnv(SegorogeniAUVEnv):
    """An autonomous underwater vehicle: follow steps of the depth up and down, on a straight course north.

    As `SegorogeniAUVPathEnv`, whose observation it has; the path's depth steps by `step_size` (2 m) up or down
    at random every `hold_time` (15 s), within twice of that about `depth` (6 m), where the vehicle starts.
    Observation k compares with the depth of time k + 1, the one that the reward of the next step compares with.
    Episodes are truncated after 1200 steps (60 s).

    ## Arguments
    The list is that of `thruster_env.auv.plant.make_plant` and of `thruster_env.auv.paths.make_depth_task`;
    `render_mode` and `render_size` come on top.
    """

    observes_errors = True

    @takes_arguments_of(make_plant, make_depth_task, leaving_out=["substeps"])
    def __init__(self, *, render_mode: str | None = None, render_size: Sequence[int] | None = None, **arguments):
        """Build the plant; see the class for the arguments."""
        self._build(
            arguments, make_depth_task(**arguments_of(make_depth_task, arguments)), (render_mode, render_size)
        )


# The vector envs: all copies advanced by one compiled call, noise included.


class SegorogeniAUVVectorEnv(ModelledVehicle, PlantVectorEnv):
    """Vector env of `SegorogeniAUV-v0`; see `PlantVectorEnv`.

    `num_envs`, `max_episode_steps` and `autoreset_mode` are those of `PlantVectorEnv`, the others those of the
    single env.
    """

    single_env: ClassVar[type[SegorogeniAUVEnv]] = SegorogeniAUVEnv


class SegorogeniAUVPathVectorEnv(SegorogeniAUVVectorEnv):
    """Vector env of `SegorogeniAUVPath-v0`."""

    single_env = SegorogeniAUVPathEnv


class SegorogeniAUVDepthVectorEnv(SegorogeniAUVVectorEnv):
    """Vector env of `SegorogeniAUVDepth-v0`."""

    single_env = SegorogeniAUVDepthEnv
