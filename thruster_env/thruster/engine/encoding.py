"""Plant and task as one packed row, the form that compiled steps read; offsets are in `memory`."""

from __future__ import annotations

import numpy as np

from thruster_env.core.checks import covariance_root
from thruster_env.core.matrices import zero_order_hold
from thruster_env.effects.effects import Effect, encoded
from thruster_env.effects.sensors import SENSOR_EFFECTS
from thruster_env.thruster.channels import CHANNELS, MAX_CHANNELS
from thruster_env.thruster.effects.amplifier import AMPLIFIER_EFFECTS, FLOW_SIGNALS, ThrusterContext
from thruster_env.thruster.effects.reference import REFERENCE_SIGNALS, Constant
from thruster_env.thruster.engine import memory as at
from thruster_env.thruster.linear.analysis import LinearModel
from thruster_env.thruster.plant import Plant
from thruster_env.thruster.task import Task, state_limits, thrust_scale

REGISTRIES = (AMPLIFIER_EFFECTS, FLOW_SIGNALS, SENSOR_EFFECTS, REFERENCE_SIGNALS)  # in the order of a step
_SPACING = 64  # effects of each list have numbers of their own, whatever the other lists hold


def is_plain(plant: Plant, task: Task) -> bool:
    """Whether nothing disturbs the thrust measurement of a nominal thruster and the reference is constant.

    That is the frequent case, for which compiled code is smaller.
    """
    disturbed = plant.amplifier or plant.flow or plant.uncertainty or any(plant.sensors.values())
    other = plant.linear is not None or plant.channels != ("thrust",)
    return not disturbed and not other and {type(signal) for signal in task.reference} <= {Constant}


def known_effects(plant: Plant, task: Task) -> tuple[tuple[type[Effect], ...], ...]:
    """Effects, a tuple for each registry, that compiled code has to know: all, or of a plain plant hardly any."""
    if is_plain(plant, task):
        return (), (), (), (Constant,)
    return tuple(tuple(registry.effects.values()) for registry in REGISTRIES)


def encode(plant: Plant, task: Task) -> tuple[np.ndarray, int]:
    """Numbers of a plant and a task, and how many rows beyond the fixed ones a copy's memory needs."""
    p = plant.parameters
    scale = thrust_scale(plant)
    context = ThrusterContext(plant.dt, MAX_CHANNELS, scale, p.motor_damping / p.voltage_gain)
    numbers = np.zeros(at.FIRST_EFFECT)
    numbers[: at.CONSTANT_COUNT] = plant.constants
    numbers[at.SUBSTEPS] = plant.substeps
    numbers[at.TOP_VOLTAGE] = plant.max_voltage
    numbers[at.SAMPLE_TIME] = plant.dt
    lower = np.tril_indices(2)
    numbers[at.Q_ROOT : at.Q_ROOT + 3] = covariance_root(plant.process_noise_cov)[lower]
    numbers[at.PRIOR_MEAN : at.PRIOR_MEAN + 2] = plant.initial_mean
    numbers[at.PRIOR_ROOT : at.PRIOR_ROOT + 3] = covariance_root(plant.initial_cov)[lower]
    m = len(plant.channels)
    numbers[at.CHANNEL_COUNT] = m
    numbers[at.CHANNEL_CODES : at.CHANNEL_CODES + m] = [CHANNELS[channel].code for channel in plant.channels]
    r_root = np.zeros((MAX_CHANNELS, MAX_CHANNELS))
    r_root[:m, :m] = covariance_root(plant.measurement_noise_cov)
    numbers[at.R_ROOT : at.R_ROOT + r_root.size] = r_root.ravel()
    if plant.linear is not None:
        numbers[at.LINEAR] = 1.0
        numbers[at.LINEAR_MODEL : at.LINEAR_MODEL + 10] = _discrete(plant.linear, plant.dt)
    numbers[at.REWARD_WEIGHTS : at.REWARD_WEIGHTS + 3] = task.weights
    numbers[at.THRUST_SCALE] = scale
    numbers[at.LIMITS : at.LIMITS + 2] = state_limits(plant)
    program, rows = _program(plant, task, context, numbers)
    numbers[at.CONSTANT_ROWS] = at.FIXED_ROWS + rows if plant.uncertainty else 0.0
    return np.concatenate([numbers, program]), rows + (at.CONSTANT_COUNT if plant.uncertainty else 0)


def _discrete(linear: LinearModel, dt: float) -> np.ndarray:
    a_d, b_d = zero_order_hold(linear.a, linear.b, dt)
    return np.concatenate([a_d.ravel(), b_d.ravel(), linear.c.ravel()])


def _program(plant: Plant, task: Task, context: ThrusterContext, numbers: np.ndarray) -> tuple[list[float], int]:
    known = known_effects(plant, task)
    chains = [(0, plant.amplifier, at.VOLTAGE), (1, plant.flow, at.AMBIENT)]
    chains += [(2, effects, at.READINGS + i) for i, effects in enumerate(plant.sensors.values())]
    chains += [(3, task.reference, at.NEXT_REFERENCE)]
    program: list[float] = []
    rows = 0
    for index, (section, effects, target) in enumerate(chains):
        # The reference draws from a stream of its own, so it begins with number 0 whatever disturbs the plant.
        first_number = 0 if section == 3 else index * _SPACING
        code, row_count = encoded(effects, known[section], target, at.FIXED_ROWS + rows, first_number, context)
        numbers[at.SECTIONS + section] += len(effects)
        program += code
        rows += row_count
    return program, rows
