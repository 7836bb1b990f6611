"""The noisy vehicle, from its commands to the reward: the equations of an episode's start and of a step.

    x_{k+1} = F(x_k, u_k) + w_k,  w ~ N(0, Q);      z_{k+1} = h(x_{k+1}) + v_{k+1},  v ~ N(0, R)

F integrates the equations of motion (`dynamics`) over one sample time, in the current; h are the channels. Both
functions are pure functions of numbers, which `thruster_env.env.copies` runs for one copy or thousands.

The observation compares the path with the vehicle's own reckoning: its position by dead reckoning from its
known start. Measured velocities over ground are turned into the earth's axes by the measured attitude and
summed; depth and yaw are those measured. Quantities without a sensor are taken as zero, and yaw follows from
the measured rates. Position fixes, acoustic or from satellites, are not used: weighing them is a filter's task.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from thruster_env.auv.dynamics import (
    ROTATING,
    angle_rates,
    angled_state,
    attitude_of,
    current_substep,
    in_earth_axes,
    rotating_substep,
)
from thruster_env.auv.paths import PIECE, Task, make_task, step_cost
from thruster_env.auv.plant import (
    CHANNELS_BY_ATTITUDE,
    DIRECTIONS,
    MEASURED,
    QUATERNION,
    STATES,
    SYMBOLS,
    VECTORS,
    Plant,
)
from thruster_env.core.streams import INITIAL, MEASUREMENT, PROCESS, REFERENCE_SIGNAL, cosine_and_sine
from thruster_env.effects.effects import SPACING, Context, Moment, chain_of, chain_runner
from thruster_env.effects.sensors import Reading
from thruster_env.env.copies import Page, PlantCopies, check_finite, clipped, correlated, record, root_of
from thruster_env.graphs.graphs import where
from thruster_env.graphs.values import Table, traceable
from thruster_env.model.turns import move

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
    first, count, begun = arguments[0], arguments[1], arguments[2]
    x, y, z = arguments[3], arguments[4], arguments[5]
    last, piece = int(count) // PIECE - 1, int(begun)
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


def moved(x, w):
    """The state with a quaternion, moved by an error of its tangent."""
    return tuple(move(x, w, ROTATING))


def by_vectors(down, field, velocity):
    """Velocity to the north, to the east and down, and yaw, by measured directions of gravity and magnetic field.

        d = down/|down|,  e = d x field/|d x field|,  n = e x d

    Source: Black (1964), "A passive system for determining the attitude of a satellite", AIAA Journal 2(7).
    """
    (a, b, c), (x, y, z) = down, field
    scale = 1.0 / np.sqrt(a * a + b * b + c * c)
    a, b, c = a * scale, b * scale, c * scale
    x, y, z = b * z - c * y, c * x - a * z, a * y - b * x
    scale = 1.0 / np.sqrt(x * x + y * y + z * z)
    x, y, z = x * scale, y * scale, z * scale
    north = y * c - z * b, z * a - x * c, x * b - y * a
    u, v, w = velocity
    along = north[0] * u + north[1] * v + north[2] * w
    return along, x * u + y * v + z * w, a * u + b * v + c * w, np.arctan2(x, north[0])


def finite(error):
    """An error within LARGEST_ERROR; NaN, too, as the episode ends."""
    return where(abs(error) < LARGEST_ERROR, error, LARGEST_ERROR)


@lru_cache(maxsize=64)
def vehicle(
    kinds: tuple, channels: tuple[str, ...], substeps: int, has_torque: bool, steps_depth: bool, attitude: str
) -> Page:
    """The page of a vehicle.

    Args:
        kinds: of the effects: name and kinds of each chain.
        channels: names of the measured quantities.
        substeps: Runge-Kutta steps of a sample time.
        has_torque: whether the propeller's torque is an action of its own.
        steps_depth: whether the depth to keep steps up and down.
        attitude: of the state, "euler" or "quaternion".
    """
    act, rotates = chain_runner(dict(kinds)), attitude == QUATERNION
    substep = traceable(rotating_substep) if rotates else current_substep
    measured_in = {SYMBOLS.index(name): i for i, name in enumerate(channels) if MEASURED.get(name) == name}
    vectors = (
        [[channels.index(f"{s}_{axis}") for axis in "xyz"] for s in "gm"] if set(VECTORS) <= set(channels) else []
    )

    def disturbed(x: Any, w: Any) -> tuple:
        """The state moved by noise."""
        return traceable(moved)(x, w) if rotates else tuple(a + b for a, b in zip(x, w, strict=True))

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
            reading = Reading(traceable(CHANNELS_BY_ATTITUDE[attitude][name].read)(x, (), (), ()) + noise[i], 1.0)
            reading, memory = act(f"sensor {i}", p, reading, effects, t._replace(state=x))
            readings, memories = [*readings, reading], memories | memory
        return readings, memories

    def reckon(p: Parameters, readings: list[Reading], m: Memory | None) -> tuple[tuple, tuple]:
        """The position and yaw by dead reckoning, speeds averaged over the step, and the speed over ground."""
        z = [readings[measured_in[i]].z if i in measured_in else 0.0 for i in range(N)]
        attitude = attitude_of(z[PHI], z[THETA])
        turning = angle_rates(attitude, z[P], z[Q], z[R])[2]
        yaw = (
            (traceable(angled_state) if rotates else tuple)(p.prior_mean)[PSI]
            if m is None
            else m.reckoned[3] + p.dt * turning
        )
        yaw = z[PSI] if PSI in measured_in else yaw
        speed = in_earth_axes(attitude, yaw, z[U], z[V], z[W])
        if vectors:
            down, field = (tuple(readings[i].z for i in part) for part in vectors)
            *speed, yaw = traceable(by_vectors)(down, field, (z[U], z[V], z[W]))
        position = p.prior_mean[-3:]
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
        within_limits = sum(map(abs, x)) < LARGEST
        if not rotates:
            within_limits = (abs(x[THETA]) < STEEPEST) & within_limits
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
        x = disturbed(p.prior_mean, noise)
        offset = step_depth(p, 0.0, t)
        readings, sensors = measure(p, x, None, t)
        (aside, below, *_), piece = off_path(p.pieces, 0.0, x[-3], x[-2], x[-1] - offset)
        inputs = (0.0,) * 4
        return guide(p, None, x, inputs, current, (aside, below), piece, offset, readings, flows | sensors, t)

    def step(p: Parameters, m: Memory, action: tuple, t: Moment) -> tuple[Memory, dict]:
        current, flows = flow(p, m.effects, t)
        inputs, planes = command(p, m.inputs, action)
        u = (*inputs, *current)
        x = t.repeat(substeps, lambda x, of: substep(x, *of), m.x, (u, p.constants))
        noise = correlated(p.q_root, t.draws.normals(PROCESS, N))
        x = disturbed(x, noise)
        readings, sensors = measure(p, x, m.effects, t)
        (aside, below, *_), piece = off_path(p.pieces, m.piece, x[-3], x[-2], x[-1] - m.offset)
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
    steps_depth = task.step_size > 0.0
    return vehicle(kinds, plant.channels, plant.substeps, has_torque, steps_depth, plant.attitude), parameters


def decay(dt: float, time_constant: float) -> float:
    """The remaining fraction of the distance to a held command after a step: exp(-dt/T), 0 for T = 0."""
    return math.exp(-dt / time_constant) if time_constant > 0.0 else 0.0


class Simulation(NamedTuple):
    """Trajectories of a batch of B vehicles over K steps."""

    states: np.ndarray  # (B, K + 1, 12), or 13 with a quaternion
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
