"""The task of an env: a reference thrust, and the weights of the reward's terms."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thruster_env.core.compiled import inlined
from thruster_env.effects.effects import Effect
from thruster_env.env.plant_data import checked_weights
from thruster_env.thruster.analysis import equilibrium, state_range, steady_state
from thruster_env.thruster.effects import REFERENCE_SIGNALS
from thruster_env.thruster.plant import Plant

DEFAULT_WEIGHTS = (1.0, 0.0, 0.01)  # tracking, energy, voltage rate
ABSURD = 100.0  # a state this many times its range away from rest ends the episode


class Task(NamedTuple):
    """A reference, and a reward from the true thrust T after the step, independent of the sensors.

    -(tracking ((T - r)/T_max)^2 + energy (V_s/V_max)^2 + voltage_rate (change of V_s/V_max)^2), see `step_cost`
    """

    reference: tuple[Effect, ...] = ()
    weights: tuple[float, ...] = DEFAULT_WEIGHTS


@inlined
def step_cost(error, voltage, change, tracking, energy, rate):
    """Cost of a step, minus its reward: of a thrust error [T_max], a voltage and its change [V_max]."""
    return tracking * error * error + energy * voltage * voltage + rate * change * change


def make_task(
    reference=None,
    tracking_weight: float = DEFAULT_WEIGHTS[0],
    energy_weight: float = DEFAULT_WEIGHTS[1],
    voltage_rate_weight: float = DEFAULT_WEIGHTS[2],
) -> Task:
    """Make a task from plain arguments, the same ones that the env takes.

    Args:
        reference: signals of `effects.REFERENCE_SIGNALS`, which are added; none if None. (Each env has its own
            default; `BowThruster-v0` takes a thrust [N].)
        tracking_weight: of the squared thrust error over T_max.
        energy_weight: of the squared voltage over max_voltage.
        voltage_rate_weight: of the squared change of voltage over max_voltage.

    Raises:
        ValueError: if an argument is wrong; the message states the rule and the value.
    """
    weights = checked_weights(tracking=tracking_weight, energy=energy_weight, voltage_rate=voltage_rate_weight)
    return Task(REFERENCE_SIGNALS.make(reference), weights)


def thrust_scale(plant: Plant) -> float:
    """Steady thrust at max_voltage, T_max [N]."""
    if plant.linear is None:
        return steady_state(plant.parameters, plant.max_voltage).thrust
    return float(abs(equilibrium(plant.linear, (plant.max_voltage, 0.0))[2]))


def half_thrust(plant: Plant) -> float:
    """Steady thrust at half of max_voltage [N]: the reference where no other one is given."""
    if plant.linear is None:
        return steady_state(plant.parameters, plant.max_voltage / 2).thrust
    return float(equilibrium(plant.linear, (plant.max_voltage / 2, 0.0))[2])


def state_limits(plant: Plant) -> np.ndarray:
    """Magnitudes (2,) of omega_m [rad/s] and U_a [m/s] at which an episode ends."""
    if plant.linear is not None:
        speed, flow, _ = equilibrium(plant.linear, (plant.max_voltage, plant.ambient_velocity))
        # The open-bladed system hardly answers to the voltage: its noise is larger than its range.
        spread = np.sqrt(np.diag(plant.initial_cov)) + np.sqrt(np.diag(plant.process_noise_cov))
        return ABSURD * (2 * np.abs([speed, flow]) + np.abs(plant.initial_mean) + spread)
    flow = abs(plant.ambient_velocity)
    turned_by_flow = np.array([flow / plant.constants.blade_speed, flow])
    return ABSURD * (state_range(plant.parameters, plant.max_voltage) + turned_by_flow)
