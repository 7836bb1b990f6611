"""What is to be identified: logs, those held out, and whose parameters they are of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from numerics.checks import finite, shown
from numerics.modules import object_named
from plants.logs.log import Log
from thruster_cli.logs import DEFAULT_PRESET, read_named
from thruster_env.logged import logged_plant
from tuning.identification.family import ModelFamily
from tuning.problems.parameter import Parameter
from tuning.thruster.identification import ThrusterFamily

EVERY_THIRD = 3
OFFSET_SHARE = 4  # of a log, that a clock offset may take away
THRUSTER_FREE = "motor_damping,voltage_gain,lift_coefficient"  # where nothing is said


def split_runs(logs, held_out, use_all: bool, preset, model, options: Mapping, filter_name: str):
    """What makes the family, the logs to learn from, and those that only validate.

    Raises:
        ValueError: states the rule and the value.
    """
    if use_all and held_out:
        raise ValueError("give either --held-out or --use-all, but got both")
    if model is None and filter_name != "ekf":
        raise ValueError(f"a thruster must be identified with the ekf, but got --filter {filter_name}")
    names = list(dict.fromkeys(map(str, logs)))
    proving = list(dict.fromkeys(map(str, held_out or [])))
    if not proving and not use_all and len(names) >= EVERY_THIRD:
        proving = names[EVERY_THIRD - 1 :: EVERY_THIRD]
    learning = [name for name in names if name not in proving]
    if not learning:
        raise ValueError("at least one log must be left to learn from, but all are held out")
    read = {name: read_named(name, preset, model, **options)[0] for name in (*learning, *proving)}
    _check_times(list(read.values()))
    maker = {"preset": preset or DEFAULT_PRESET, "sensors": options["sensors"]} if model is None else model
    return maker, [read[name] for name in learning], [read[name] for name in proving]


def family_of(maker, logs: Sequence[Log], free: str | None, *, noise: bool):
    """The thruster or the model whose parameters are free."""
    dt = logs[0].dt
    if isinstance(maker, str):
        names = _names(free)
        if not names:
            raise ValueError("--free must name what of the model is to be found, but got none")
        return LoggedFamily(logs, object_named(maker, "model"), names, noise=noise, dt=dt)
    largest = max(np.abs(log.inputs).max() for log in logs)
    arguments = {"preset": maker["preset"], "dt": dt, "max_voltage": float(max(largest, 1.0))}
    if maker["sensors"]:
        arguments["sensors"] = tuple(maker["sensors"])
    plant, seen = logged_plant(**arguments)
    return ThrusterFamily(logs, plant, seen, _names(free or THRUSTER_FREE), noise=noise)


class LoggedFamily(ModelFamily):
    """A model's family with the logs it is identified on, as `ThrusterFamily` has them."""

    def __init__(self, logs: Sequence[Log], make, free, **options):
        """Keep the logs."""
        super().__init__(make, free, **options)
        self.data = tuple(logs)

    def shifted(self, logs: Sequence[Log]) -> tuple[Log, ...]:
        """Other logs as this family takes them."""
        return tuple(logs)


def check_offsets(parameters: Sequence[Parameter], logs: Sequence[Log]) -> None:
    """Raise ValueError unless the ranges of clock offsets leave most of each log: no data fit any model."""
    most = min(log.times[-1] for log in logs) / OFFSET_SHARE
    for one in parameters:
        if one.name.startswith("clock_offset_") and max(-one.low, one.high) > most:
            raise ValueError(
                f"the range of {one.name} must be within a quarter of the shortest log, {most:g} s, but is from "
                f"{one.low:g} to {one.high:g}"
            )


def ranges_of(given: Mapping[str, str]) -> dict[str, tuple[float, float]]:
    """Ranges from texts LOW:HIGH; ValueError for another form."""
    found = {}
    for name, text in given.items():
        low, colon, high = text.partition(":")
        if not colon:
            raise ValueError(f"--range must have the form NAME=LOW:HIGH, but got {shown(f'{name}={text}')}")
        found[name] = finite(f"low of {name}", low), finite(f"high of {name}", high)
    return found


def numbers_of(option: str, given: Mapping[str, str]) -> dict[str, float]:
    """Numbers by name."""
    return {name: finite(f"{option} {name}", text) for name, text in given.items()}


def _names(text: str | None) -> list[str]:
    return [name.strip() for name in (text or "").split(",") if name.strip()]


def _check_times(logs: Sequence[Log]) -> None:
    """Raise ValueError unless all logs have one sample time."""
    for log in logs[1:]:
        if abs(log.dt - logs[0].dt) > 1e-6 * logs[0].dt:
            raise ValueError(
                f"logs must have one sample time, but {logs[0].name} has {logs[0].dt:g} s, {log.name} {log.dt:g} s"
            )
