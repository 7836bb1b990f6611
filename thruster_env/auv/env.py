"""`SegorogeniAUV-v0` and its tasks, as single and vector envs, and how they are drawn."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import gymnasium as gym
import numpy as np

from thruster_env.auv.paths import make_depth_task, make_task
from thruster_env.auv.plant import Plant, make_plant
from thruster_env.auv.rendering import ChartEntry, Renderer
from thruster_env.core.checks import arguments_of, takes_arguments_of
from thruster_env.env.copies import TIME
from thruster_env.env.env import PlantEnv, PlantVectorEnv
from thruster_env.env.model_env import ModelledEnv, Split, split
from thruster_env.render.renderer import MODES

# What every env and vector env of the vehicle offers to filters.


if TYPE_CHECKING:
    from thruster_env.auv.rendering import Overlay
    from thruster_env.model.state_space import StateSpaceModel
import math
from functools import lru_cache
from typing import NamedTuple

from thruster_env.auv.dynamics import angle_rates, attitude_of, current_substep, in_earth_axes
from thruster_env.auv.paths import PIECE, Task, step_cost
from thruster_env.auv.plant import CHANNELS, DIRECTIONS, MEASURED, STATES, SYMBOLS
from thruster_env.core.streams import INITIAL, MEASUREMENT, PROCESS, REFERENCE_SIGNAL, cosine_and_sine
from thruster_env.effects.effects import SPACING, Context, Moment, chain_of, chain_runner
from thruster_env.effects.sensors import Reading
from thruster_env.env.copies import Page, PlantCopies, clipped, correlated, root_of
from thruster_env.env.record import check_finite, record
from thruster_env.graphs.graphs import where
from thruster_env.graphs.values import Table, traceable

# The noisy vehicle, from its commands to the reward: the equations of an episode's start and of a step.
#
#     x_{k+1} = F(x_k, u_k) + w_k,  w ~ N(0, Q);      z_{k+1} = h(x_{k+1}) + v_{k+1},  v ~ N(0, R)
#
# F integrates the equations of motion (`dynamics`) over one sample time, in the current; h are the channels. Both
# functions are pure functions of numbers, which `thruster_env.env.copies` runs for one copy or thousands.
#
# The observation compares the path with the vehicle's own reckoning: its position by dead reckoning from its
# known start. Measured velocities over ground are turned into the earth's axes by the measured attitude and
# summed; depth and yaw are those measured. Quantities without a sensor are taken as zero, and yaw follows from
# the measured rates. Position fixes, acoustic or from satellites, are not used: weighing them is a filter's task.


N = len(STATES)
U, V, W, P, Q, R, PHI, THETA, PSI, X, Y, Z = range(N)  # places in a state
STEEPEST = math.radians(80.0)  # near a right angle Euler angles end
LARGEST = 1e12  # of the sum of a state's magnitudes: beyond it, or where it is no number, an episode ends
LARGEST_ERROR = 1e6  # [m], [m/s]: a reward stays finite when a state does not


class Parameters(NamedTuple):
    """The numbers that a step reads; others of the same kind need no compilation."""

    dt: float  # [s]
    constants: Any  # of the equations of motion, for one Runge-Kutta step
    max_thrust: float  # [N]
    max_torque: float  # [N m]
    max_plane: float  # [rad]
    torque_ratio: float  # of the propeller's torque over its thrust [m]
    decays: Any  # what is left of the distance to a held command after a step, of propeller and planes
    prior_mean: Any
    prior_root: Any
    q_root: Any
    r_root: Any
    weights: Any  # cross-track, vertical, speed, planes
    speed: float  # to keep [m/s]
    depth_steps: Any  # size [m], and for so many steps
    pieces: Any  # of the path: the first one, or a table of all
    effects: Any  # parameters of the effects by chain


class Memory(NamedTuple):
    """What a vehicle keeps until the next step."""

    x: Any
    inputs: Any  # that act
    effects: Any  # memories of the effects by chain
    piece: Any  # of the path that the true position has got to
    offset: Any  # of the path's depth [m]
    reckoned: Any  # north, east, down, yaw
    ground_speed: Any  # north, east, down, in the last step [m/s]
    reckoned_piece: Any


def next_piece(arguments, results, numbers):
    """The piece of a path that a position has got to, from the one that it was at; as `paths.Path.piece`."""
    first, count, piece = arguments[0], arguments[1], arguments[2]
    x, y, z = arguments[3], arguments[4], arguments[5]
    last, piece = int(count) // PIECE - 1, int(piece)
    at = int(first) + PIECE * piece
    while piece < last:
        along = (x - numbers[at]) * numbers[at + 3] + (y - numbers[at + 1]) * numbers[at + 4]
        if not along + (z - numbers[at + 2]) * numbers[at + 5] > numbers[at + 6]:
            break
        piece += 1
        at += PIECE
    results[0] = piece


def off_path(pieces: Any, piece: Any, x, y, z) -> tuple[tuple, Any]:
    """Distance to starboard of the path and below it, cosine and sine of its course; and the piece reached."""
    if isinstance(pieces, Table):
        (piece,) = pieces.call(next_piece, 1, pieces.count, piece, x, y, z)
        x_0, y_0, z_0, ahead, aside, below = (pieces[PIECE * piece + float(i)] for i in range(PIECE - 1))
    else:
        x_0, y_0, z_0, ahead, aside, below = pieces[: PIECE - 1]
    x, y, z = x - x_0, y - y_0, z - z_0
    along = x * ahead + y * aside + z * below
    per_level = 1.0 / (ahead * ahead + aside * aside) ** 0.5
    cosine, sine = ahead * per_level, aside * per_level
    errors = (y - along * aside) * cosine - (x - along * ahead) * sine, z - along * below
    return (*errors, cosine, sine), piece


def finite(error):
    """An error within LARGEST_ERROR; NaN, too, as the episode ends."""
    return where(abs(error) < LARGEST_ERROR, error, LARGEST_ERROR)


@lru_cache(maxsize=64)
def vehicle(kinds: tuple, channels: tuple[str, ...], substeps: int, has_torque: bool, steps_depth: bool) -> Page:
    """The page of a vehicle.

    Args:
        kinds: of the effects: name and kinds of each chain.
        channels: names of the measured quantities.
        substeps: Runge-Kutta steps of a sample time.
        has_torque: whether the propeller's torque is an action of its own.
        steps_depth: whether the depth to keep steps up and down.
    """
    act = chain_runner(dict(kinds))
    measured_in = {SYMBOLS.index(name): i for i, name in enumerate(channels) if MEASURED[name] == name}

    def flow(p: Parameters, effects: dict | None, t: Moment) -> tuple[tuple, dict]:
        """The current to the north, to the east and down [m/s]."""
        parts = [act(name, p, 0.0, effects, t) for name in DIRECTIONS]
        return tuple(speed for speed, _ in parts), {k: v for _, memory in parts for k, v in memory.items()}

    def command(p: Parameters, inputs: tuple, action: tuple) -> tuple[tuple, tuple]:
        """The inputs that act, as propeller and planes follow the commands, and the planes' clipped commands."""
        thrust = clipped(action[0], 0.0, p.max_thrust)
        torque = clipped(action[1], -p.max_torque, p.max_torque) if has_torque else p.torque_ratio * thrust
        planes = tuple(clipped(angle, -p.max_plane, p.max_plane) for angle in action[-2:])
        goals, decays = (thrust, torque, *planes), (p.decays[0], p.decays[0], p.decays[1], p.decays[1])
        lagging = zip(goals, decays, inputs, strict=True)
        return tuple(goal + decay * (now - goal) for goal, decay, now in lagging), planes

    def measure(p: Parameters, x: tuple, effects: dict | None, t: Moment) -> tuple[list[Reading], dict]:
        """Readings of all channels, and the memories of their effects."""
        noise = correlated(p.r_root, t.draws.normals(MEASUREMENT, len(channels)))
        readings, memories = list[Reading](), dict[str, Any]()
        for i, name in enumerate(channels):
            reading = Reading(traceable(CHANNELS[name].read)(x, (), (), ()) + noise[i], 1.0)
            reading, memory = act(f"sensor {i}", p, reading, effects, t._replace(state=x))
            readings, memories = [*readings, reading], memories | memory
        return readings, memories

    def reckon(p: Parameters, readings: list[Reading], m: Memory | None) -> tuple[tuple, tuple]:
        """The position and yaw by dead reckoning, speeds averaged over the step, and the speed over ground."""
        z = [readings[measured_in[i]].z if i in measured_in else 0.0 for i in range(N)]
        attitude = attitude_of(z[PHI], z[THETA])
        turning = angle_rates(attitude, z[P], z[Q], z[R])[2]
        yaw = p.prior_mean[PSI] if m is None else m.reckoned[3] + p.dt * turning
        yaw = z[PSI] if PSI in measured_in else yaw
        speed = in_earth_axes(attitude, yaw, z[U], z[V], z[W])
        position = p.prior_mean[X:]
        if m is not None:
            moves = zip(m.reckoned, m.ground_speed, speed, strict=False)
            position = tuple(at + 0.5 * p.dt * (before + after) for at, before, after in moves)
        return (*position[:2], z[Z] if Z in measured_in else position[2], yaw), speed

    def step_depth(p: Parameters, offset: Any, t: Moment) -> Any:
        """The depth to keep in the next step, less the path's: a step up or down at random every so often."""
        if not steps_depth:
            return offset
        size, hold = p.depth_steps
        part = (t.step + 1.0) / hold
        change = where(t.draws.uniforms(REFERENCE_SIGNAL, 0, part)[0] < 0.5, size, -size)
        after = where(abs(offset + change) < 2.5 * size, offset + change, offset - change)
        return where((t.step + 1.0) % hold == 0.0, after, offset)

    def guide(
        p: Parameters, m: Memory | None, x, inputs, current, truth, piece, offset, readings, effects, t: Moment
    ) -> tuple[Memory, dict]:
        """Memory and report, from the true state and the readings."""
        reckoned, ground_speed = reckon(p, readings, m)
        north, east, down, yaw = reckoned
        off, reckoned_piece = off_path(
            p.pieces, 0.0 if m is None else m.reckoned_piece, north, east, down - offset
        )
        aside, below, cosine, sine = off
        along, across = cosine_and_sine(yaw)
        speed_error = readings[measured_in[U]].z - p.speed if U in measured_in else 0.0
        course = across * cosine - along * sine, along * cosine + across * sine
        within_limits = (abs(x[THETA]) < STEEPEST) & (sum(map(abs, x)) < LARGEST)
        report = {
            "terminated": where(within_limits, 0.0, 1.0),
            "time": t.step * p.dt,
            "state": x,
            "measurement": tuple(reading.z for reading in readings),
            "valid": tuple(reading.valid for reading in readings),
            "inputs": inputs,
            "current": current,
            "path_errors": truth,
            "path_piece": piece,
            "reckoned": reckoned,
            "path_depth": down - below,
            "errors": (aside, below, *course, speed_error),
        }
        return Memory(x, inputs, effects, piece, offset, reckoned, ground_speed, reckoned_piece), report

    def begin(p: Parameters, t: Moment) -> tuple[Memory, dict]:
        current, flows = flow(p, None, t)
        noise = correlated(p.prior_root, t.draws.normals(INITIAL, N))
        x = tuple(mean + w for mean, w in zip(p.prior_mean, noise, strict=True))
        offset = step_depth(p, 0.0, t)
        readings, sensors = measure(p, x, None, t)
        (aside, below, *_), piece = off_path(p.pieces, 0.0, x[X], x[Y], x[Z] - offset)
        inputs = (0.0,) * 4
        return guide(p, None, x, inputs, current, (aside, below), piece, offset, readings, flows | sensors, t)

    def step(p: Parameters, m: Memory, action: tuple, t: Moment) -> tuple[Memory, dict]:
        current, flows = flow(p, m.effects, t)
        inputs, planes = command(p, m.inputs, action)
        u = (*inputs, *current)
        x = t.repeat(substeps, lambda x, of: current_substep(x, *of), m.x, (u, p.constants))
        noise = correlated(p.q_root, t.draws.normals(PROCESS, N))
        x = tuple(f + w for f, w in zip(x, noise, strict=True))
        readings, sensors = measure(p, x, m.effects, t)
        (aside, below, *_), piece = off_path(p.pieces, m.piece, x[X], x[Y], x[Z] - m.offset)
        per_plane = where(p.max_plane > 0.0, 1.0 / p.max_plane, 0.0)
        errors = finite(aside), finite(below), finite(x[U] - p.speed)
        stern, rudder = (angle * per_plane for angle in planes)
        cost = step_cost(*errors, stern, rudder, p.weights)
        offset = step_depth(p, m.offset, t)
        memory, report = guide(
            p, m, x, inputs, current, (aside, below), piece, offset, readings, flows | sensors, t
        )
        return memory, {"reward": -cost} | report

    return Page(begin, step, 4 if has_torque else 3)


def page_of(plant: Plant, task: Task) -> tuple[Page, Parameters]:
    """The page of a plant with a task, and its parameters."""
    context, instruments = Context(plant.dt), list(plant.instruments.values())
    signals = [plant.current.get(name, ()) for name in DIRECTIONS]
    chains = {name: chain_of(signals[i], context, i * SPACING, i * SPACING) for i, name in enumerate(DIRECTIONS)}
    for i, effects in enumerate(plant.sensors.values()):
        # What an instrument measures is lost together.
        first, lost_with = ((len(DIRECTIONS) + k) * SPACING for k in (i, instruments.index(instruments[i])))
        chains[f"sensor {i}"] = chain_of(effects, context, first, lost_with)
    pieces = task.path.numbers
    parameters = Parameters(
        plant.dt,
        plant.constants,
        plant.max_thrust,
        plant.max_torque,
        plant.max_plane,
        plant.propeller_torque or 0.0,
        (decay(plant.dt, plant.propeller_lag), decay(plant.dt, plant.plane_lag)),
        tuple(plant.initial_mean),
        root_of(plant.initial_cov),
        root_of(plant.process_noise_cov),
        root_of(plant.measurement_noise_cov),
        task.weights,
        task.speed,
        (task.step_size, max(1.0, round(task.hold_time / plant.dt))),
        tuple(pieces) if len(pieces) == PIECE else pieces,
        {name: parameters for name, (_, parameters) in chains.items()},
    )
    kinds = tuple((name, kinds) for name, (kinds, _) in chains.items())
    has_torque = plant.propeller_torque is None
    return vehicle(kinds, plant.channels, plant.substeps, has_torque, task.step_size > 0.0), parameters


def decay(dt: float, time_constant: float) -> float:
    """The remaining fraction of the distance to a held command after a step: exp(-dt/T), 0 for T = 0."""
    return math.exp(-dt / time_constant) if time_constant > 0.0 else 0.0


class Simulation(NamedTuple):
    """Trajectories of a batch of B vehicles over K steps."""

    states: np.ndarray  # (B, K + 1, 12)
    measurements: np.ndarray  # (B, K + 1, m)
    valid: np.ndarray  # (B, K + 1, m), false where a measurement is missing and the last one repeated
    current: np.ndarray  # (B, K + 1, 3), to the north, to the east and down [m/s]

    def checked(self, what: str = "a simulation") -> Simulation:
        """The same; ValueError that names the first step at which a number is not finite."""
        check_finite(what, self.states, self.measurements)
        return self


def simulate(plant: Plant, keys: np.ndarray, inputs: np.ndarray) -> Simulation:
    """Run a plant from its initial state for every key (B, 2) under inputs (B, K, p).

    The same key and inputs give the same numbers as an env that is stepped through Gymnasium.

    Raises:
        ValueError: if shapes do not fit or a number is not finite.
    """
    task = make_task()
    reports, rows = record(
        lambda count: PlantCopies(page_of, plant, task, count), keys, inputs, "inputs", len(plant.inputs)
    )
    states, measurements, valid, current = (
        reports[..., rows[name]] for name in ("state", "measurement", "valid", "current")
    )
    return Simulation(states, measurements, valid > 0.0, current)


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
    near which Euler angles end, or the state is not finite. There is no surface: z < 0 ends nothing.

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
    mean[Z] = depth
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
