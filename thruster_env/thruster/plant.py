"""The noisy plant from plain arguments: a thruster, its noise, sensors and disturbances."""

from __future__ import annotations

import itertools
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import (
    at_least,
    between,
    finite,
    one_of,
    positive,
    short_repr,
    within,
)
from thruster_env.effects.effects import Effect, dropping_channels
from thruster_env.effects.sensors import SENSOR_EFFECTS
from thruster_env.env import plant_data as data_of_plants
from thruster_env.env.plant_data import (
    Entries,
    checked_noise,
    checked_weights,
    data_of,
    initial_distribution,
    sensor_effects,
)
from thruster_env.thruster.analysis import (
    LinearModel,
    equilibrium,
    required_substeps_of_all,
    steady_state,
)
from thruster_env.thruster.dynamics import Constants
from thruster_env.thruster.effects import (
    AMPLIFIER_EFFECTS,
    DISTRIBUTIONS,
    FLOW_SIGNALS,
    REFERENCE_SIGNALS,
    UNCERTAIN,
    DeadBand,
    LogNormal,
    Uniform,
)
from thruster_env.thruster.parameters import (
    CHANNELS,
    LARGEST_VOLTAGE,
    MAX_CHANNELS,
    PRESETS,
    ThrusterParameters,
    checked,
    derive_constants,
    is_file,
    preset_and_dead_band,
    read_preset,
)

DEFAULT_DT = 0.01  # [s], the sample time of the published experiments
DEFAULT_MAX_VOLTAGE = 24.0  # [V]
# Tunnel, signal to noise: w drives motor and flow by 0.5 % of their values at 12 V each step (in stationarity
# 1.15 rad/s and 0.035 m/s at 12 V); v is 0.5 N, 4 % of the thrust at 12 V, 16 % at 6 V and 65 % at 3 V.
DEFAULT_PROCESS_NOISE = (1.0, 4e-4)  # variances a step, [(rad/s)^2, (m/s)^2]
DEFAULT_MEASUREMENT_NOISE = CHANNELS["thrust"].variance  # [N^2]
# Beyond these limits there is no ship, and floating point may overflow.
SAMPLE_TIMES = (1e-9, 10.0)  # [s]
VOLTAGES = (1e-3, 1e6)  # [V]
FASTEST_FLOW = 1e3  # [m/s]
DEFAULT_INITIAL_VARIANCES = (1.0, 0.01)  # about rest, [(rad/s)^2, (m/s)^2]


class Plant(NamedTuple):
    """A thruster with its noise, sampled every dt seconds; `make_plant` makes one from plain arguments."""

    parameters: ThrusterParameters
    dt: float  # [s]
    max_voltage: float  # [V]
    ambient_velocity: float  # [m/s]
    substeps: int  # Runge-Kutta steps a sample time
    process_noise_cov: np.ndarray  # (2, 2), a step
    measurement_noise_cov: np.ndarray  # (m, m)
    initial_mean: np.ndarray  # (2,)
    initial_cov: np.ndarray  # (2, 2)
    sensors: dict[str, tuple[Effect, ...]]  # effects by channel; the m channels in their order
    flow: tuple[Effect, ...] = ()
    amplifier: tuple[Effect, ...] = ()
    uncertainty: dict[str, Uniform | LogNormal] = {}
    linear: LinearModel | None = None  # moves the plant in place of the equations of motion
    dead_band: tuple[float, float] = (0.0, 0.0)  # of a preset file [V], the first of `amplifier`; models have it

    @property
    def constants(self) -> Constants:
        """Constants of the equations of motion, for one Runge-Kutta step."""
        return derive_constants(self.parameters, self.ambient_velocity, self.dt / self.substeps)

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of the measured quantities, in order."""
        return tuple(self.sensors)

    @property
    def dropping_channels(self) -> tuple[int, ...]:
        """Numbers of the channels whose measurements may be missing."""
        return dropping_channels(self.sensors)


def make_uncertainty(uncertainty) -> dict[str, Uniform | LogNormal]:
    """Distributions by parameter from None or a mapping such as {"load_gain": {"name": "uniform", ...}}.

    Raises ValueError if an argument is wrong; the message states the rule and the value.
    """
    if uncertainty is None:
        return {}
    if not isinstance(uncertainty, Mapping):
        raise ValueError(
            f"uncertainty must be a mapping from parameters to distributions, but got {short_repr(uncertainty)}"
        )
    distributions = {}
    for parameter, distribution in uncertainty.items():
        one_of("a name in uncertainty", parameter, UNCERTAIN)
        distributions[parameter] = distribution
        if isinstance(distribution, (Uniform, LogNormal)):
            continue
        names = ", ".join(DISTRIBUTIONS)
        rule = f"the distribution of {parameter} must be a mapping with arguments and a name out of {names}"
        if not isinstance(distribution, Mapping) or distribution.get("name") not in tuple(DISTRIBUTIONS):
            raise ValueError(f"{rule}, but got {short_repr(distribution)}")
        arguments = {key: value for key, value in distribution.items() if key != "name"}
        try:
            distributions[parameter] = DISTRIBUTIONS[distribution["name"]](**arguments)
        except TypeError:
            raise ValueError(f"{rule}, but got {short_repr(distribution)}") from None
    return distributions


def extreme_parameters(nominal: ThrusterParameters, uncertainty: Mapping) -> list[ThrusterParameters]:
    """The nominal parameters and corners of the region they are drawn from, which bound the integration's step.

    All corners for up to five uncertain parameters; of more, those with one parameter or all of them extreme.
    """
    names = list(uncertainty)
    if len(names) <= 5:
        corners = list(itertools.product(*(uncertainty[name].extremes for name in names)))
    else:
        ends = [uncertainty[name].extremes for name in names]
        corners = [tuple(end[side] for end in ends) for side in (0, 1)]
        corners += [
            tuple(end[side] if i == k else 1.0 for i, end in enumerate(ends))
            for k in range(len(names))
            for side in (0, 1)
        ]
    scaled = (
        {name: getattr(nominal, name) * factor for name, factor in zip(names, corner, strict=True)}
        for corner in corners
    )
    return [nominal, *(checked(nominal._replace(**values)) for values in scaled if values)]


def largest_known_voltage(preset) -> float:
    """The voltage up to which a preset is known [V]: what the logs of an identified one reached, or its data."""
    if is_file(preset):
        return float(read_preset(preset).identified.get("largest_voltage", DEFAULT_MAX_VOLTAGE))
    return LARGEST_VOLTAGE.get(preset, DEFAULT_MAX_VOLTAGE) if isinstance(preset, str) else DEFAULT_MAX_VOLTAGE


def make_plant(
    preset: str | Mapping | ThrusterParameters = "tunnel",
    dt: float = DEFAULT_DT,
    max_voltage: float = DEFAULT_MAX_VOLTAGE,
    ambient_velocity: float = 0.0,
    process_noise_cov=DEFAULT_PROCESS_NOISE,
    measurement_noise_cov=None,
    initial_state=None,
    sensors=None,
    flow=None,
    amplifier=None,
    uncertainty=None,
    substeps: int | None = None,
) -> Plant:
    """Make a plant from plain arguments, the same ones that the env takes.

    Args:
        preset: a preset's name, a preset FILE.toml, a mapping of all fields of `ThrusterParameters`, or one of
            these; a file or a mapping may have a dead band, too.
        dt: sample time [s]. Covariances are per step and do not scale with dt.
        max_voltage: voltages are clipped to plus and minus this [V].
        ambient_velocity: flow U_0 along the thruster's axis [m/s].
        process_noise_cov: Q, covariance (2, 2) or two variances per step [(rad/s)^2, (m/s)^2]; zero allowed.
        measurement_noise_cov: R, covariance (m, m) or m variances, in the channels' units squared; zero allowed.
            None for the defaults of `parameters.CHANNELS`.
        initial_state: None for N(0, diag(1, 0.01)), a fixed state [omega_m, U_a], or a mapping:
            {"voltage": V} for the steady state of V volts, {"mean": [..], "cov": [..]} for a distribution.
        sensors: None for the thrust alone, a list of channels of `parameters.CHANNELS`, or a mapping from
            channels to lists of effects, {"thrust": [{"name": "dropout", "probability": 0.1}]}.
        flow: signals of `effects.FLOW_SIGNALS` that add to ambient_velocity.
        amplifier: effects of `effects.AMPLIFIER_EFFECTS` between the commanded voltage and the motor.
        substeps: Runge-Kutta steps per sample time; None for the fewest that reach `analysis.ONE_STEP_ACCURACY`.
        uncertainty: distributions of factors on parameters, {"load_gain": {"name": "log-normal", "std": 0.1}}.

    Raises:
        ValueError: if an argument is wrong; the message states the rule and the value.
    """
    parameters, (low, high) = preset_and_dead_band(preset)
    dt = between("dt", positive("dt", dt), *SAMPLE_TIMES, "s")
    max_voltage = between("max_voltage", positive("max_voltage", max_voltage), *VOLTAGES, "V")
    ambient_velocity = within("ambient_velocity", ambient_velocity, FASTEST_FLOW)
    mean, cov = initial_distribution(
        initial_state,
        (np.zeros(2), np.diag(DEFAULT_INITIAL_VARIANCES)),
        *("two", "voltage", "V"),
        lambda voltage: np.array(
            steady_state(parameters, finite("the voltage of initial_state", voltage), ambient_velocity)[:2]
        ),
    )
    sensors = _sensors(sensors)
    if "current" in sensors and parameters.load_gain == 0:
        raise ValueError("load_gain must be positive for a motor current to follow from it, but got 0.0")
    if measurement_noise_cov is None:
        measurement_noise_cov = [CHANNELS[channel].variance for channel in sensors]
    uncertainty = make_uncertainty(uncertainty)
    corners = extreme_parameters(parameters, uncertainty)
    flow = FLOW_SIGNALS.make(flow)
    swing = sum(signal.largest() for signal in flow)
    flows = {ambient_velocity - swing, ambient_velocity + swing}  # between which the integration has to do
    if substeps is None:
        cases = tuple((corner, u_0) for corner in corners for u_0 in flows)
        substeps = required_substeps_of_all(cases, dt, max_voltage)
    else:
        substeps = at_least("substeps", substeps, 1, 10_000)
    return Plant(
        parameters,
        dt,
        max_voltage,
        ambient_velocity,
        substeps,
        checked_noise("process_noise_cov", process_noise_cov, 2),
        checked_noise("measurement_noise_cov", measurement_noise_cov, len(sensors)),
        mean,
        cov,
        sensors,
        flow,
        (*([DeadBand(high, -low)] if low < high else []), *AMPLIFIER_EFFECTS.make(amplifier)),
        uncertainty,
        dead_band=(low, high),
    )


def _sensors(sensors) -> dict[str, tuple[Effect, ...]]:
    if sensors is None:
        sensors = ("thrust",)
    if not isinstance(sensors, Mapping):
        if isinstance(sensors, str) or not hasattr(sensors, "__iter__"):
            raise ValueError(
                f"sensors must be a list of channels or a mapping from them, but got {short_repr(sensors)}"
            )
        names = list(sensors)
        sensors = {name: () for name in names if isinstance(name, str)}
        if len(sensors) != len(names):
            raise ValueError(f"sensors must name each channel once, but got {short_repr(names)}")
    return sensor_effects(sensors, CHANNELS, SENSOR_EFFECTS, MAX_CHANNELS)


# What makes it another plant, on which Q and R mean nothing. The rest disturbs or bounds the same plant.
ESSENTIAL = ("preset", "system", "dt", "sensors")
BOUNDS_AND_NOISE = "parameters", "max_voltage", "ambient_velocity", "process_noise_cov", "measurement_noise_cov"
DISTURBANCES = "sensor_effects", "flow", "amplifier", "uncertainty"
ENTRIES = Entries(ESSENTIAL, (*ESSENTIAL, *BOUNDS_AND_NOISE, *DISTURBANCES), ThrusterParameters._fields)


def plant_data(plant: Plant) -> dict:
    """The data on which a filter's parameters depend, see `thruster_env.env.plant_data.data_of`."""
    linear = plant.linear
    system = None if linear is None else [matrix.tolist() for matrix in (linear.a, linear.b, linear.c)]
    return data_of(plant, ENTRIES, PRESETS, system=system)


def check_same_plant(tuned_for: Mapping, plant: Plant, file: str | Path) -> list[str]:
    """Raise ValueError, with the differences, if a tuned file is for another plant; return other differences.

    Args:
        tuned_for: the file's data of a plant, from `plant_data`.
        plant: where it is to be used.
        file: its path.
    """
    return data_of_plants.check_same(ENTRIES, tuned_for, plant_data(plant), file)


def differences(then: Mapping, now: Mapping) -> tuple[list[str], list[str]]:
    """What two plants' data differ in: what makes them other plants, and what does not; ValueError for others."""
    return data_of_plants.differences(ENTRIES, then, now)


DEFAULT_WEIGHTS = (1.0, 0.0, 0.01)  # tracking, energy, voltage rate


class Task(NamedTuple):
    """A reference, and a reward from the true thrust T after the step, independent of the sensors.

    -(tracking ((T - r)/T_max)^2 + energy (V_s/V_max)^2 + voltage_rate (change of V_s/V_max)^2), see `step_cost`
    """

    reference: tuple[Effect, ...] = ()
    weights: tuple[float, ...] = DEFAULT_WEIGHTS


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
