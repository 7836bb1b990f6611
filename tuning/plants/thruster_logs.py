"""Logs of a thruster: the plant of a preset, and `ThrusterFamily`, a model of free parameters to identify."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any, overload

import numpy as np

from thruster_env.core.checks import short_repr
from thruster_env.logs.log import Log
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.thruster.env import ModelledThruster
from thruster_env.thruster.model import NO_BAND, Recorder, lag_weights, logged_plant, model_of_plant, with_recorder
from thruster_env.thruster.parameters import PRESETS, ThrusterParameters, checked, is_file, read_preset
from thruster_env.thruster.plant import Plant
from tuning.likelihood.parametric import about, variance_about
from tuning.likelihood.recorded import clock_offsets, offsets_of, shifted
from tuning.problems.problem import Parameter, Problem
from tuning.problems.scenario import FILE_SEQUENCES, PlantScenario
from tuning.search.parameters import r_name

DEFAULT_PRESET = "tunnel"
FREE = ("motor_damping", "voltage_gain", "lift_coefficient")  # free parameters by default
LINEAR = {"blade_angle": (0.05, 1.5), "thrust_asymmetry": (-0.5, 0.5)}
FASTEST_FLOW = 2.0  # [m/s], ambient
DEAD_PART = 0.25  # largest dead band, as a fraction of the largest voltage
DEAD_START = 0.02
BIAS_PART = 0.25  # largest bias, as a fraction of the channel's largest magnitude
LONGEST_LAG = 100.0  # in sample times
LAG_START = 3.0


class Preset(ModelledThruster):
    """The thruster of a preset as the plant of logs: it offers the model, and checks tuned files.

    With a preset file the model includes the recorder: biases, lags, ambient flow, Q and R; `clock_offset` [s], by
    measured channel, is for the reader of logs.
    """

    def __init__(self, preset: str, sensors: Sequence[str] | None, dt: float):
        """Make the plant."""
        self.plant, self._seen = logged_plant(
            preset=preset, dt=dt, **({"sensors": tuple(sensors)} if sensors else {})
        )
        offsets = read_preset(preset).recorder.get("clock_offset", {}) if is_file(preset) else {}
        self.clock_offset = {name: value for name, value in offsets.items() if name in self.plant.channels}

    def state_space_model(self, **changes) -> StateSpaceModel:
        """The model of the plant with its recorder."""
        bare = self.plant._replace(dead_band=NO_BAND)
        return with_recorder(model_of_plant(bare, **changes), bare, self._seen)


def is_preset(name: str | Path) -> bool:
    """Whether a name is that of a preset, or of a file that may be one."""
    return str(name) in PRESETS or is_file(name)


@overload
def of_preset(problem: PlantScenario, preset: str | Path | None, sequences: int = ...) -> PlantScenario: ...


@overload
def of_preset(problem: Problem, preset: str | Path | None, sequences: int = ...) -> Problem: ...


def of_preset(problem: Problem, preset: str | Path | None, sequences: int = FILE_SEQUENCES) -> Problem:
    """A scenario with another thruster, whose scale is computed; the same problem without a preset.

    Args:
        problem: a scenario.
        preset: a preset's name or file.
        sequences: number of input sequences for the scale.

    Raises:
        ValueError: for a problem that is not a scenario of the thruster's equations.
    """
    if preset is None:
        return problem
    from tuning.plants.thruster import Scenario

    preset = str(preset)
    if not isinstance(problem, Scenario) or problem.system is not None:
        raise ValueError(
            f"preset (--preset) must come with scenarios of the thruster's equations, but got {problem.name}"
        )
    name = f"{problem.name} ({preset})"
    changed = problem.replace(preset=preset, name=name, scale=problem.scale)
    return changed.replace(scale=tuple(float(value) for value in changed.computed_scale(sequences)))


def family_of_preset(
    logs: Sequence[Log], preset: str | None, sensors: Sequence[str] | None, free: Sequence[str], *, noise: bool
):
    """The thruster of a preset whose parameters are free, `tuning.plants.thruster_logs.ThrusterFamily`.

    Args:
        logs: training logs.
        preset: the thruster where the search starts; the default one if None.
        sensors: measured channels.
        free: names of the free parameters; motor damping, voltage gain and lift by default.
        noise: whether Q and R are free, too.
    """
    largest = max(np.abs(log.inputs).max() for log in logs)
    arguments: dict[str, Any] = {"preset": preset or DEFAULT_PRESET, "dt": logs[0].dt}
    arguments["max_voltage"] = float(max(largest, 1.0))
    if sensors:
        arguments["sensors"] = tuple(sensors)
    plant, recorder = logged_plant(**arguments)
    return ThrusterFamily(logs, plant, recorder, list(free) or list(FREE), noise=noise)


def preset_of(identification: Any, family: Any, logs: Sequence[str]):
    """The identified thruster as the content of a preset file, `thruster_env.thruster.parameters.PresetFile`.

    Args:
        identification: from `tuning.likelihood.identify`.
        family: its `ThrusterFamily`.
        logs: names of the runs.
    """
    from thruster_env.thruster.parameters import PresetFile

    plant, recorder = family.plant_at(identification.values), family.recorder_at(identification.values)
    offsets = offsets_of(family.logs, plant.channels, identification.values)
    variances = plant.measurement_noise_cov.diagonal().tolist()
    content: Mapping[str, Any] = {
        "dt": plant.dt,
        "sensors": list(plant.channels),
        "ambient_velocity": plant.ambient_velocity,
        "process_noise_cov": plant.process_noise_cov.diagonal().tolist(),
        "measurement_noise_cov": dict(zip(plant.channels, variances, strict=True)),
        "bias": dict(recorder.bias),
        "lag": dict(recorder.lag),
        "clock_offset": offsets,
    }
    identified = {
        "logs": [Path(log).name for log in logs],
        "log_likelihood": identification.log_likelihood,
        "standard_errors": identification.standard_errors,
        "determined": identification.determined,
        "largest_voltage": float(max(np.abs(log.inputs).max() for log in family.logs)),
    }
    stored = {name: value for name, value in content.items() if value not in ({}, 0.0)}
    return PresetFile(plant.parameters, (recorder.dead_band_low, recorder.dead_band_high), stored, identified)


def write_identified(path: str | Path, identification: Any, family: Any, logs: Sequence[str]) -> None:
    """Write the identified thruster as a preset file; arguments are those of `preset_of`."""
    from thruster_env.thruster.parameters import write_preset

    write_preset(path, preset_of(identification, family, logs), "A thruster as `thruster identify` found it.")


UNITS = {
    "lift_coefficient": "",
    "drag_coefficient": "",
    "motor_damping": "1/s",
    "voltage_gain": "rad/(s^2 V)",
    "load_gain": "1/(kg m^2)",
    "added_mass": "kg",
    "momentum_drag": "kg/m",
    "area": "m^2",
    "diameter": "m",
    "gear_ratio": "",
    "density": "kg/m^3",
    "blade_angle": "rad",
    "thrust_asymmetry": "",
}  # of the thruster's own parameters


class ThrusterFamily:
    """A thruster's models and logs as functions of its free parameters.

    The parameters are the fields of `ThrusterParameters` except angles; ambient_velocity; dead_band, or
    dead_band_low and dead_band_high; bias_CHANNEL, lag_CHANNEL and clock_offset_CHANNEL; Q11, Q22 and R, or R11,
    R22, ...

    Args:
        logs: logs with the plant's inputs and channels.
        plant: the start of all parameters, and the values of the held ones.
        recorder: start of the recorder's parameters: dead band, bias and lag.
        free: names of free parameters.
        noise: whether Q and R are free, too.

    Raises:
        ValueError: for an unknown name; the message has the known ones.
    """

    def __init__(
        self, logs: Sequence[Log], plant: Plant, recorder: Recorder, free: Sequence[str], *, noise: bool = True
    ):
        """Find the parameters by name."""
        self.logs, self.plant, self.recorder = tuple(logs), plant, recorder
        if plant.linear is not None:
            raise ValueError("an identified thruster must follow the equations of motion, but this one is linear")
        known = self.known
        names = list(free) + [name for name in self.noise_names if noise and name not in free]
        wrong = [name for name in names if name not in known]
        if wrong:
            raise ValueError(f"free parameters must be of {', '.join(known)}, but got {short_repr(wrong[0])}")
        if "dead_band" in names and {"dead_band_low", "dead_band_high"} & set(names):
            raise ValueError("dead_band must not be free beside dead_band_low or dead_band_high")
        self.free = tuple(known[name] for name in dict.fromkeys(names))
        self._lagging = tuple(channel for channel in plant.channels if f"lag_{channel}" in names)
        base = model_of_plant(plant._replace(dead_band=NO_BAND))
        self._base = with_recorder(base, plant, self._recorder({}), always=True)

    @property
    def noise_names(self) -> tuple[str, ...]:
        """Names of the variances in Q and R."""
        count = len(self.plant.channels)
        return ("Q11", "Q22", *(r_name(i, count) for i in range(count)))

    @cached_property
    def known(self) -> dict[str, Parameter]:
        """Every parameter that may be free, with its range about its start."""
        plant, recorder, parameters = self.plant, self.recorder, {}
        for name, unit in UNITS.items():
            parameters[name] = _about(name, getattr(plant.parameters, name), unit)
        flow = plant.ambient_velocity
        ends = min(-FASTEST_FLOW, 2 * flow), max(FASTEST_FLOW, 2 * flow)
        parameters["ambient_velocity"] = Parameter("ambient_velocity", *ends, "m/s", log=False, default=flow)
        reach, first = DEAD_PART * plant.max_voltage, DEAD_START * plant.max_voltage
        low, high = (max(-reach, recorder.dead_band_low) or -first), (min(reach, recorder.dead_band_high) or first)
        parameters["dead_band"] = Parameter("dead_band", 0.0, reach, "V", log=False, default=high)
        parameters["dead_band_low"] = Parameter("dead_band_low", -reach, 0.0, "V", log=False, default=low)
        parameters["dead_band_high"] = Parameter("dead_band_high", 0.0, reach, "V", log=False, default=high)
        dt = plant.dt
        model = model_of_plant(plant)
        for i, (channel, quantity) in enumerate(zip(plant.channels, model.measurements, strict=True)):
            largest = max(np.nanmax(np.abs(log.measurements[:, i]), initial=0.0) for log in self.logs)
            bias, at = BIAS_PART * (largest or 1.0), dict(recorder.bias).get(channel, 0.0)
            name = f"bias_{channel}"
            parameters[name] = Parameter(
                name, min(-bias, 2 * at), max(bias, 2 * at), quantity.unit, log=False, default=at
            )
            name, lag = f"lag_{channel}", dict(recorder.lag).get(channel, LAG_START * dt)
            parameters[name] = Parameter(name, 0.0, max(LONGEST_LAG * dt, lag), "s", log=False, default=lag)
        parameters |= clock_offsets(plant.channels, self.logs)
        q, r = np.diag(plant.process_noise_cov), np.diag(plant.measurement_noise_cov)
        units = [quantity.unit for quantity in (*model.states, *model.measurements)]
        for name, variance, unit in zip(self.noise_names, (*q, *r), units, strict=True):
            if variance > 0:
                parameters[name] = variance_about(name, float(variance), unit)
        return parameters

    @property
    def data(self):
        """The logs, or a function of the free clock offsets."""
        return self.shifted(self.logs)

    def shifted(self, logs: Sequence[Log]):
        """Some logs for this family: unchanged, or a function of the free clock offsets."""
        return shifted(logs, self.free)

    def parameters(self, values: Mapping[str, float]) -> ThrusterParameters:
        """The thruster's own parameters."""
        changes: dict[str, Any] = {name: value for name, value in values.items() if name in UNITS}
        return checked(self.plant.parameters._replace(**changes))

    def plant_at(self, values: Mapping[str, float]) -> Plant:
        """The plant for some values; the others are held."""
        q, r = self._noise(values)
        return self.plant._replace(
            parameters=self.parameters(values),
            ambient_velocity=values.get("ambient_velocity", self.plant.ambient_velocity),
            process_noise_cov=q,
            measurement_noise_cov=r,
        )

    def recorder_at(self, values: Mapping[str, float]) -> Recorder:
        """The recorder's parameters (dead band, bias and lag) for some values."""
        return self._recorder(values)

    def model(self, **values: float) -> StateSpaceModel:
        """The model for values of the free parameters without clock offsets; its ranges stay, which is fast."""
        plant, recorder = self.plant_at(values), self._recorder(values)
        constants = plant.constants
        step, biases, lags = constants.substep, dict(recorder.bias), dict(recorder.lag)
        further = {"dead_band_low": recorder.dead_band_low, "dead_band_high": recorder.dead_band_high}
        for i, channel in enumerate(plant.channels):
            further[f"bias_{i}"] = biases.get(channel, 0.0)
            further[f"kept_{i}"], further[f"after_{i}"] = lag_weights(lags.get(channel, 0.0), step)
        q = self._base.process_noise_cov.copy()
        q[:2, :2] = plant.process_noise_cov
        before: Any = self._base.constants  # a NamedTuple
        return self._base.replace(
            constants=before._replace(**constants._asdict(), **further),
            process_noise_cov=q,
            measurement_noise_cov=plant.measurement_noise_cov,
        )

    def _noise(self, values: Mapping[str, float]) -> tuple[np.ndarray, np.ndarray]:
        covs = []
        for cov, names in (
            (self.plant.process_noise_cov, self.noise_names[:2]),
            (self.plant.measurement_noise_cov, self.noise_names[2:]),
        ):
            before = np.diag(cov)
            after = [values.get(name, variance) for name, variance in zip(names, before, strict=True)]
            factors = np.sqrt(np.divide(after, before, out=np.ones(len(before)), where=before > 0))
            covs.append(cov * np.outer(factors, factors))
        return covs[0], covs[1]

    def _recorder(self, values: Mapping[str, float]) -> Recorder:
        known, recorder = self.known, self.recorder
        half = values.get("dead_band")
        low, high = recorder.dead_band_low, recorder.dead_band_high
        low = values.get("dead_band_low", low) if half is None else -half
        high = values.get("dead_band_high", high) if half is None else half
        bias, lag = dict(recorder.bias), dict(recorder.lag)
        for channel in self.plant.channels:
            if f"bias_{channel}" in values:
                bias[channel] = values[f"bias_{channel}"]
            if channel in self._lagging:
                lag[channel] = values.get(f"lag_{channel}", known[f"lag_{channel}"].start)
        return Recorder(low, high, tuple(bias.items()), tuple(lag.items()))


def _about(name: str, value: float, unit: str) -> Parameter:
    """A parameter of the thruster, within a range about its value."""
    if name in LINEAR:
        low, high = LINEAR[name]
        return Parameter(name, min(low, value), max(high, value), unit, log=False, default=value)
    if value == 0:  # as a preset without drag
        return Parameter(name, 0.0, 1.0, unit, log=False, default=0.0)
    return about(name, value, unit)
