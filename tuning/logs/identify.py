"""The input of an identification: training runs, held-out runs, and the model family."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from numerics.checks import shown
from numerics.modules import object_named
from plants.logs.log import Log
from tuning.identification.family import ModelFamily
from tuning.identification.result import Identification
from tuning.identification.values import write_values
from tuning.logs.problem import runs_by_name
from tuning.logs.read import read_named
from tuning.problems.parameter import Parameter
from tuning.problems.rooms import room_of_logs

EVERY_THIRD = 3
OFFSET_SHARE = 4  # a clock offset may be at most the length of a log divided by this


def split_runs(
    logs: Any, held_out: Any = None, *, use_all: bool = False, **options: Any
) -> tuple[list[Log], list[Log]]:
    """The training logs, and the held-out ones for validation: by default every third of three or more.

    Args:
        logs: recorded runs, as `tuning.logs.read.read_named` takes them.
        held_out: the held-out runs, or their paths or names.
        use_all: whether no run is held out.
        **options: options of `read_named`.

    Raises:
        ValueError: states the rule and the value.
    """
    runs, validating = runs_by_name(logs, held_out)
    if use_all and validating:
        raise ValueError(
            f"give either held_out (--held-out) or use_all (--use-all), but got both, held out {validating[0]}"
        )
    names = list(runs)
    if not validating and not use_all and len(names) >= EVERY_THIRD:
        validating = names[EVERY_THIRD - 1 :: EVERY_THIRD]
    learning = [name for name in names if name not in validating]
    if not learning:
        raise ValueError("at least one log must be left to learn from, but all are held out")
    read = {name: read_named(runs[name], **options, name=name)[0] for name in (*learning, *validating)}
    _check_times(list(read.values()))
    return [read[name] for name in learning], [read[name] for name in validating]


def family_of(
    logs: Sequence[Log],
    free: Sequence[str],
    *,
    preset: str | Path | None = None,
    model: Any = None,
    sensors: Sequence[str] | None = None,
    noise: bool = True,
    filter: str = "ekf",
) -> Any:
    """The thruster or the model whose parameters are free.

    Args:
        logs: training logs.
        free: names of the free parameters; a thruster has a default.
        preset: the thruster where the search starts.
        model: instead of a thruster: a model, a function that makes one, or "module:object".
        sensors: measured channels of a thruster.
        noise: whether the variances of Q and R are free, too.
        filter: the filter whose innovations are used; for a thruster always the ekf.

    Raises:
        ValueError: for an unknown name; the message has the known ones.
    """
    if model is None:
        if filter != "ekf":
            raise ValueError(f"a thruster must be identified with the ekf, but got filter {filter} (--filter)")
        whose = None if preset is None else str(preset)
        return room_of_logs().family_of_preset(logs, whose, sensors, list(free), noise=noise)
    if not free:
        raise ValueError("free (--free) must name what of the model is to be found, but got none")
    found = object_named(model, "model") if isinstance(model, str) else model
    return LoggedFamily(logs, found, list(free), noise=noise, dt=logs[0].dt)


class LoggedFamily(ModelFamily):
    """A model's family with the logs that it is identified on, as `ThrusterFamily` has them."""

    def __init__(self, logs: Sequence[Log], make: Any, free: Sequence[str], **options: Any):
        """Keep the logs."""
        super().__init__(make, free, **options)
        self.data = tuple(logs)

    def shifted(self, logs: Sequence[Log]) -> tuple[Log, ...]:
        """Other logs for this family, unchanged."""
        return tuple(logs)


def check_offsets(parameters: Sequence[Parameter], logs: Sequence[Log]) -> None:
    """Raise ValueError unless ranges of clock offsets are short: without common data any model would fit."""
    most = min(log.times[-1] for log in logs) / OFFSET_SHARE
    for one in parameters:
        if one.name.startswith("clock_offset_") and max(-one.low, one.high) > most:
            raise ValueError(
                f"the range of {one.name} must be within a quarter of the shortest log, {most:g} s, but is from "
                f"{one.low:g} to {one.high:g}"
            )


def write_found(path: str | Path, found: Identification, family: Any, logs: Sequence[str]) -> None:
    """Write the preset file of a thruster, or the values of a model.

    Args:
        path: path of a file that ends in .toml.
        found: from `tuning.identification.identify`.
        family: from `family_of`.
        logs: names of the training runs.

    Raises:
        ValueError: if the path has another ending or cannot be written.
    """
    if not str(path).endswith(".toml"):
        raise ValueError(f"a file of what was identified must end in .toml, but got {shown(str(path))}")
    if isinstance(family, ModelFamily):
        write_values(path, found, logs)
    else:
        room_of_logs().write_identified(path, found, family, logs)


def _check_times(logs: Sequence[Log]) -> None:
    """Raise ValueError unless all logs have the same sample time."""
    for log in logs[1:]:
        if abs(log.dt - logs[0].dt) > 1e-6 * logs[0].dt:
            raise ValueError(
                f"logs must have one sample time, but {logs[0].name} has {logs[0].dt:g} s, {log.name} {log.dt:g} s"
            )
