"""The noisy thruster, from the commanded voltage to the reward: the equations of an episode's start and of a step.

    V, U_0 = amplifier(V_s), flow;   x' = F(x, V, U_0) + w,  w ~ N(0, Q);   z = sensors(h(x') + v),  v ~ N(0, R)
    reward = -(tracking ((T - r)/T_max)^2 + energy (V_s/V_max)^2 + voltage_rate (change of V_s/V_max)^2)

F integrates the equations of motion (`dynamics`) over one sample time; h are the channels. Both functions are pure
functions of numbers, which `thruster_env.env.copies` runs for one copy or thousands: the same seed gives the same
numbers on every path.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.matrices import zero_order_hold
from thruster_env.core.streams import INITIAL, MEASUREMENT, PROCESS
from thruster_env.effects.effects import SPACING, Moment, chain_of, chain_runner
from thruster_env.effects.sensors import Reading
from thruster_env.env.copies import Page, PlantCopies, check_finite, clipped, correlated, record, root_of
from thruster_env.graphs.graphs import where
from thruster_env.graphs.values import traceable
from thruster_env.thruster.analysis import equilibrium, state_range
from thruster_env.thruster.dynamics import substep, thrust_and_torque
from thruster_env.thruster.effects import ThrusterContext, drawn_parameters
from thruster_env.thruster.parameters import CHANNELS, ThrusterParameters, derive_constants
from thruster_env.thruster.plant import Plant, Task, thrust_scale

LARGEST_ERROR = 1e6  # of thrust over T_max: a reward stays finite when a state does not


def step_cost(error, voltage, change, tracking, energy, rate):
    """Cost of a step, minus its reward: of a thrust error [T_max], a voltage and its change [V_max]."""
    return tracking * error * error + energy * voltage * voltage + rate * change * change


class Parameters(NamedTuple):
    """The numbers that a step reads; others of the same kind need no compilation."""

    dt: float  # [s]
    constants: Any  # of the equations of motion, for one Runge-Kutta step
    linear: Any  # A_d, B_d, C by rows, in place of the equations of motion; None if these hold
    nominal: Any  # the preset by name where some of it is uncertain, else None
    uncertain: Any  # numbers of the distribution of each uncertain parameter
    top_voltage: float  # [V]
    prior_mean: Any
    prior_root: Any
    q_root: Any
    r_root: Any
    weights: Any  # tracking, energy, voltage rate
    thrust_scale: float  # [N]
    limits: Any  # of |omega_m| and |U_a|
    effects: Any  # parameters of the effects by chain


class Memory(NamedTuple):
    """What a thruster keeps until the next step."""

    x: Any  # omega_m, U_a
    voltage: Any  # commanded
    reference: Any  # of the next step
    constants: Any  # drawn for the episode, or None
    effects: Any  # memories of the effects by chain


@lru_cache(maxsize=64)
def thruster(kinds: tuple, channels: tuple[Callable, ...], substeps: int, uncertain: tuple, angles: str) -> Page:
    """The page of a thruster.

    Args:
        kinds: of the effects: name and kinds of each chain.
        channels: h(x, y, u, c) of each measured quantity.
        substeps: Runge-Kutta steps of a sample time.
        uncertain: name and distribution of each parameter that is drawn for an episode.
        angles: convention of the preset, for which constants are drawn.
    """
    act = chain_runner(dict(kinds))

    def constants_of(p: Parameters, t: Moment) -> Any:
        """The constants of an episode, drawn from its key where a parameter is uncertain."""
        if not uncertain:
            return p.constants
        distributions = {name: (kind, p.uncertain[name]) for name, kind in uncertain}
        drawn = drawn_parameters(ThrusterParameters(**p.nominal, angles=angles), distributions, t.draws)
        return traceable(derive_constants)(drawn, p.constants.ambient_velocity, p.constants.substep)

    def move(p: Parameters, x: tuple, u: tuple, c: Any, t: Moment) -> tuple:
        """F(x, u): the state after a sample time of constant input u = (V, U_0)."""
        if p.linear is not None:
            (a, b, _), z = p.linear, (*x, *u)
            return tuple(sum(f * v for f, v in zip((*a[i], *b[i]), z, strict=True)) for i in range(2))
        return t.repeat(substeps, lambda x, inputs: substep(x, *inputs), x, (u, c))

    def thrust_of(p: Parameters, x: tuple, c: Any) -> Any:
        """The true thrust T(x) [N]."""
        return thrust_and_torque(x, c)[0] if p.linear is None else p.linear[2][0] * x[0] + p.linear[2][1] * x[1]

    def measure(p: Parameters, x: tuple, thrust, voltage, c: Any, effects: dict | None, t: Moment) -> tuple:
        """Readings of all channels, and the memories of their effects."""
        noise = correlated(p.r_root, t.draws.normals(MEASUREMENT))
        readings, memories = list[Reading](), dict[str, Any]()
        for i, h in enumerate(channels):
            reading = Reading(traceable(h)(x, (thrust,), (voltage,), c) + noise[i], 1.0)
            reading, memory = act(f"sensor {i}", p, reading, effects, t._replace(state=x))
            readings, memories = [*readings, reading], memories | memory
        return readings, memories

    def report_of(x, thrust, voltage, ambient, reference, following, readings: list[Reading], p, t) -> dict:
        within_limits = (abs(x[0]) < p.limits[0]) & (abs(x[1]) < p.limits[1])
        return {
            "terminated": where(within_limits, 0.0, 1.0),
            "time": t.step * p.dt,
            "state": tuple(x),
            "thrust": thrust,
            "measurement": tuple(reading.z for reading in readings),
            "valid": tuple(reading.valid for reading in readings),
            "reference": reference,
            "next_reference": following,
            "ambient_velocity": ambient,
            "voltage": voltage,
        }

    def begin(p: Parameters, t: Moment) -> tuple[Memory, dict]:
        c = constants_of(p, t)
        voltage, amplifier = act("amplifier", p, 0.0, None, t)
        ambient, flow = act("flow", p, p.constants.ambient_velocity, None, t)
        noise = correlated(p.prior_root, t.draws.normals(INITIAL))
        x = tuple(mean + w for mean, w in zip(p.prior_mean, noise, strict=True))
        thrust = thrust_of(p, x, c)
        readings, sensors = measure(p, x, thrust, voltage, c, None, t)
        reference, signals = act("reference", p, 0.0, None, t)
        following, signals = act("reference", p, 0.0, signals, t._replace(begin=False, step=t.step + 1.0))
        report = report_of(x, thrust, voltage, ambient, reference, following, readings, p, t)
        effects = amplifier | flow | sensors | signals
        return Memory(x, 0.0, following, c if uncertain else None, effects), report

    def step(p: Parameters, m: Memory, action: tuple, t: Moment) -> tuple[Memory, dict]:
        c = m.constants if uncertain else p.constants
        t = t._replace(state=m.x)
        command = clipped(action[0], -p.top_voltage, p.top_voltage)
        voltage, amplifier = act("amplifier", p, command, m.effects, t)
        ambient, flow = act("flow", p, p.constants.ambient_velocity, m.effects, t)
        noise = correlated(p.q_root, t.draws.normals(PROCESS))
        x = tuple(f + w for f, w in zip(move(p, m.x, (voltage, ambient), c, t), noise, strict=True))
        thrust = thrust_of(p, x, c)
        readings, sensors = measure(p, x, thrust, voltage, c, m.effects, t)
        following, signals = act("reference", p, 0.0, m.effects, t._replace(step=t.step + 1.0))

        error = (thrust - m.reference) / p.thrust_scale
        error = where(abs(error) < LARGEST_ERROR, error, LARGEST_ERROR)  # NaN, too, as the episode ends
        change = (command - m.voltage) / p.top_voltage
        cost = step_cost(error, command / p.top_voltage, change, *p.weights)
        report = report_of(x, thrust, voltage, ambient, m.reference, following, readings, p, t)
        effects = amplifier | flow | sensors | signals
        return Memory(x, command, following, m.constants, effects), {"reward": -cost} | report

    return Page(begin, step, 1)


ABSURD = 100.0  # a state this many times its range away from rest ends the episode


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


def page_of(plant: Plant, task: Task) -> tuple[Page, Parameters]:
    """The page of a plant with a task, and its parameters."""
    scale, preset = thrust_scale(plant), plant.parameters
    context = ThrusterContext(plant.dt, scale, preset.motor_damping / preset.voltage_gain)
    chains = {"amplifier": plant.amplifier, "flow": plant.flow}
    chains |= {f"sensor {i}": effects for i, effects in enumerate(plant.sensors.values())}
    numbered = {name: chain_of(chain, context, i * SPACING) for i, (name, chain) in enumerate(chains.items())}
    # The reference draws from a stream of its own, so it begins with number 0 whatever disturbs the plant.
    numbered["reference"] = chain_of(task.reference, context)
    uncertain = plant.uncertainty
    nominal = {name: value for name, value in preset._asdict().items() if name != "angles"}
    linear = None
    if plant.linear is not None:
        a_d, b_d = zero_order_hold(plant.linear.a, plant.linear.b, plant.dt)
        linear = (*(tuple(map(tuple, part.tolist())) for part in (a_d, b_d)), tuple(plant.linear.c.ravel()))
    parameters = Parameters(
        plant.dt,
        plant.constants,
        linear,
        nominal if uncertain else None,
        {name: distribution.numbers for name, distribution in uncertain.items()},
        plant.max_voltage,
        tuple(plant.initial_mean),
        root_of(plant.initial_cov),
        root_of(plant.process_noise_cov),
        root_of(plant.measurement_noise_cov),
        task.weights,
        scale,
        tuple(state_limits(plant)),
        {name: parameters for name, (_, parameters) in numbered.items()},
    )
    page = thruster(
        tuple((name, kinds) for name, (kinds, _) in numbered.items()),
        tuple(CHANNELS[channel].read for channel in plant.channels),
        plant.substeps,
        tuple((name, type(distribution)) for name, distribution in uncertain.items()),
        preset.angles,
    )
    return page, parameters


def copies_of(plant: Plant, task: Task, count: int) -> PlantCopies:
    """Thrusters of a plant with a task."""
    return PlantCopies(page_of, plant, task, count)


class Simulation(NamedTuple):
    """Trajectories of a batch of B plants over K steps."""

    states: np.ndarray  # (B, K + 1, 2)
    thrusts: np.ndarray  # (B, K + 1) [N]
    measurements: np.ndarray  # (B, K + 1, m)
    valid: np.ndarray  # (B, K + 1, m), false where a measurement is missing and the last one repeated

    def checked(self, what: str = "a simulation") -> Simulation:
        """The same; ValueError that names the first step at which a number is not finite."""
        check_finite(what, self.states, self.thrusts[..., None], self.measurements)
        return self


def simulate(plant: Plant, keys: np.ndarray, voltages: np.ndarray) -> Simulation:
    """Run a plant from its initial state for every key (B, 2) under voltages (B, K) [V].

    The same key and voltages give the same numbers as an env that is stepped through Gymnasium.

    Raises:
        ValueError: if shapes do not fit or a number is not finite.
    """
    reports, rows = record(lambda count: copies_of(plant, Task(), count), keys, voltages, "voltages", 1)
    states, thrusts, readings, valid = (reports[..., rows[k]] for k in ("state", "thrust", "measurement", "valid"))
    return Simulation(states, thrusts, readings, valid > 0.0)
