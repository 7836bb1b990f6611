"""Plant and task as one row of numbers, the form that compiled steps read; places are in `memory`."""

from __future__ import annotations

import math

import numpy as np

from thruster_env.auv.channels import CHANNELS, MEASURED
from thruster_env.auv.effects.context import VehicleContext
from thruster_env.auv.effects.current import CURRENT_SIGNALS, DIRECTIONS
from thruster_env.auv.effects.sensors import VEHICLE_SENSOR_EFFECTS
from thruster_env.auv.engine import memory as at
from thruster_env.auv.plant import Plant
from thruster_env.auv.quantities import SYMBOLS
from thruster_env.auv.task import Task
from thruster_env.core.checks import covariance_root
from thruster_env.effects.effects import Effect, encoded

REGISTRIES = (CURRENT_SIGNALS, VEHICLE_SENSOR_EFFECTS)  # in the order of a step
STEEPEST = math.radians(80.0)  # near a right angle Euler angles end
_SPACING = 64  # effects of each list have numbers of their own, whatever the other lists hold


def known_effects() -> tuple[tuple[type[Effect], ...], ...]:
    """Effects, a tuple for each registry, that compiled code has to know."""
    return tuple(tuple(registry.effects.values()) for registry in REGISTRIES)


def encode(plant: Plant, task: Task) -> tuple[np.ndarray, int]:
    """Numbers of a plant and a task, and how many rows beyond the fixed ones a copy's memory needs."""
    numbers = np.zeros(at.FIRST_PIECE)
    numbers[: at.CONSTANT_COUNT] = plant.constants
    numbers[at.SUBSTEPS] = plant.substeps
    numbers[at.SAMPLE_TIME] = plant.dt
    numbers[at.INPUT_COUNT] = len(plant.inputs)
    numbers[at.MAX_THRUST] = plant.max_thrust
    numbers[at.MAX_TORQUE] = plant.max_torque
    numbers[at.MAX_PLANE] = plant.max_plane
    numbers[at.TORQUE_RATIO] = plant.propeller_torque or 0.0
    numbers[at.PROPELLER_DECAY] = decay(plant.dt, plant.propeller_lag)
    numbers[at.PLANE_DECAY] = decay(plant.dt, plant.plane_lag)
    numbers[at.MEAN : at.MEAN + at.N] = plant.initial_mean
    m = len(plant.channels)
    roots = {
        at.PRIOR_ROOT: plant.initial_cov,
        at.Q_ROOT: plant.process_noise_cov,
        at.R_ROOT: plant.measurement_noise_cov,
    }
    for place, cov in roots.items():
        numbers[place : place + cov.size] = covariance_root(cov).ravel()
    numbers[at.CHANNEL_COUNT] = m
    numbers[at.CHANNEL_CODES : at.CHANNEL_CODES + m] = [CHANNELS[channel].code for channel in plant.channels]
    for i, channel in enumerate(plant.channels):
        if MEASURED[channel] == channel:
            numbers[at.MEASURED_IN + SYMBOLS.index(channel)] = at.READINGS + i
    numbers[at.WEIGHTS : at.WEIGHTS + 4] = task.weights
    numbers[at.SPEED] = task.speed
    numbers[at.STEP_SIZE] = task.step_size
    numbers[at.HOLD_STEPS] = max(1.0, round(task.hold_time / plant.dt))
    numbers[at.STEEPEST] = STEEPEST
    program, rows = _program(plant, numbers)
    numbers[at.PIECES] = len(task.path.lengths)
    numbers[at.FIRST_EFFECT] = at.FIRST_PIECE + task.path.numbers.size
    return np.concatenate([numbers, task.path.numbers, program]), rows


def decay(dt: float, time_constant: float) -> float:
    """The remaining fraction of the distance to a held command after a step: exp(-dt/T), 0 for T = 0."""
    return math.exp(-dt / time_constant) if time_constant > 0.0 else 0.0


def _program(plant: Plant, numbers: np.ndarray) -> tuple[list[float], int]:
    context = VehicleContext(plant.dt, at.VALID - at.READINGS, at.STATE + at.Z)
    chains = [(0, plant.current.get(name, ()), at.CURRENT + i) for i, name in enumerate(DIRECTIONS)]
    chains += [(1, effects, at.READINGS + i) for i, effects in enumerate(plant.sensors.values())]
    instruments = list(plant.instruments.values())  # what one of them measures is lost together
    first = [*range(len(DIRECTIONS)), *(len(DIRECTIONS) + instruments.index(one) for one in instruments)]
    known = known_effects()
    program: list[float] = []
    rows = 0
    for index, (section, effects, target) in enumerate(chains):
        number, with_first = index * _SPACING, first[index] * _SPACING
        code, taken = encoded(effects, known[section], target, at.FIXED_ROWS + rows, number, context, with_first)
        numbers[at.SECTIONS + section] += len(effects)
        program += code
        rows += taken
    return program, rows
