"""Logs of a thruster with its model, and scenarios of another thruster than the default one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, overload

import numpy as np

from thruster_env.logs.log import Log
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.thruster.env import ModelledThruster
from thruster_env.thruster.logged import NO_BAND, logged_plant, with_recorder
from thruster_env.thruster.model import model_of_plant
from thruster_env.thruster.parameters import PRESETS
from thruster_env.thruster.preset_file import is_file, read_preset
from tuning.problems.files import FILE_SEQUENCES
from tuning.problems.problem import Problem
from tuning.problems.scenario import BaseScenario

DEFAULT_PRESET = "tunnel"
FREE = ("motor_damping", "voltage_gain", "lift_coefficient")  # free parameters by default


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
def of_preset(problem: BaseScenario, preset: str | Path | None, sequences: int = ...) -> BaseScenario: ...


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
    from tuning.thruster.scenario import Scenario, computed_scale

    preset = str(preset)
    if not isinstance(problem, Scenario) or problem.system is not None:
        raise ValueError(
            f"preset (--preset) must come with scenarios of the thruster's equations, but got {problem.name}"
        )
    name = f"{problem.name} ({preset})"
    changed = problem.replace(preset=preset, name=name, scale=problem.scale)
    return changed.replace(scale=tuple(float(value) for value in computed_scale(changed, sequences)))


def family_of_preset(
    logs: Sequence[Log],
    preset: str | None,
    sensors: Sequence[str] | None,
    free: Sequence[str],
    *,
    noise: bool,
):
    """The thruster of a preset whose parameters are free, `tuning.thruster.identification.ThrusterFamily`.

    Args:
        logs: training logs.
        preset: the thruster where the search starts; the default one if None.
        sensors: measured channels.
        free: names of the free parameters; motor damping, voltage gain and lift by default.
        noise: whether Q and R are free, too.
    """
    from tuning.thruster.identification import ThrusterFamily  # which imports Optuna

    largest = max(np.abs(log.inputs).max() for log in logs)
    arguments: dict[str, Any] = {"preset": preset or DEFAULT_PRESET, "dt": logs[0].dt}
    arguments["max_voltage"] = float(max(largest, 1.0))
    if sensors:
        arguments["sensors"] = tuple(sensors)
    plant, recorder = logged_plant(**arguments)
    return ThrusterFamily(logs, plant, recorder, list(free) or list(FREE), noise=noise)


def preset_of(identification: Any, family: Any, logs: Sequence[str]):
    """The identified thruster as the content of a preset file, `thruster_env.thruster.preset_file.PresetFile`.

    Args:
        identification: from `tuning.identification.identify`.
        family: its `ThrusterFamily`.
        logs: names of the runs.
    """
    from thruster_env.thruster.preset_file import PresetFile

    plant, recorder = family.plant_at(identification.values), family.recorder_at(identification.values)
    offsets = {channel: _taken_off(family.logs, channel) for channel in plant.channels}
    offsets |= {
        name.removeprefix("clock_offset_"): value + offsets[name.removeprefix("clock_offset_")]
        for name, value in identification.values.items()
        if name.startswith("clock_offset_")
    }
    offsets = {channel: value for channel, value in offsets.items() if value}
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


def _taken_off(logs: Sequence[Log], channel: str) -> float:
    """The clock offset with which all logs were read; 0 if they differ, since they then belong to the logs."""
    offsets = {log.offsets.get(f"measurement:{channel}", 0.0) for log in logs}
    return offsets.pop() if len(offsets) == 1 else 0.0


def write_identified(path: str | Path, identification: Any, family: Any, logs: Sequence[str]) -> None:
    """Write the identified thruster as a preset file; arguments are those of `preset_of`."""
    from thruster_env.thruster.preset_file import write_preset

    write_preset(path, preset_of(identification, family, logs), "A thruster as `thruster identify` found it.")
