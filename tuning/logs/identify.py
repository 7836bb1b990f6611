"""What is to be identified: runs to learn from, those held out, and whose parameters they are of."""

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
OFFSET_SHARE = 4  # of a log, that a clock offset may take away


def split_runs(
    logs: Any, held_out: Any = None, *, use_all: bool = False, **options: Any
) -> tuple[list[Log], list[Log]]:
    """The logs to learn from, and those that only validate: every third of three or more, unless it is told.

    Args:
        logs: recorded runs, as `tuning.logs.read.read_named` takes them.
        held_out: those that only validate, themselves or by path or name.
        use_all: whether none is held out.
        **options: of `read_named`.

    Raises:
        ValueError: states the rule and the value.
    """
    runs, proving = runs_by_name(logs, held_out)
    if use_all and proving:
        raise ValueError(f"give either --held-out or --use-all, but got both, --held-out {proving[0]}")
    names = list(runs)
    if not proving and not use_all and len(names) >= EVERY_THIRD:
        proving = names[EVERY_THIRD - 1 :: EVERY_THIRD]
    learning = [name for name in names if name not in proving]
    if not learning:
        raise ValueError("at least one log must be left to learn from, but all are held out")
    read = {name: read_named(runs[name], **options, name=name)[0] for name in (*learning, *proving)}
    _check_times(list(read.values()))
    return [read[name] for name in learning], [read[name] for name in proving]


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
        logs: to learn from.
        free: names of what is to be found; of a thruster there is a default.
        preset: the thruster where the search starts.
        model: in its place: a model, what makes one, or "module:object".
        sensors: what the filter sees of a thruster.
        noise: whether the variances of Q and R are found, too.
        filter: whose innovations count; a thruster's are the ekf's.

    Raises:
        ValueError: for an unknown name, with those that are known.
    """
    if model is None:
        if filter != "ekf":
            raise ValueError(f"a thruster must be identified with the ekf, but got --filter {filter}")
        whose = None if preset is None else str(preset)
        return room_of_logs().family_of_preset(logs, whose, sensors, list(free), noise=noise)
    if not free:
        raise ValueError("--free must name what of the model is to be found, but got none")
    found = object_named(model, "model") if isinstance(model, str) else model
    return LoggedFamily(logs, found, list(free), noise=noise, dt=logs[0].dt)


class LoggedFamily(ModelFamily):
    """A model's family with the logs it is identified on, as that of a thruster has them."""

    def __init__(self, logs: Sequence[Log], make: Any, free: Sequence[str], **options: Any):
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


def write_found(path: str | Path, found: Identification, family: Any, logs: Sequence[str]) -> None:
    """Write the preset file of a thruster, or the values of a model.

    Args:
        path: of a file that ends in .toml.
        found: from `tuning.identification.identify`.
        family: from `family_of`.
        logs: names of the runs it learned from.

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
    """Raise ValueError unless all logs have one sample time."""
    for log in logs[1:]:
        if abs(log.dt - logs[0].dt) > 1e-6 * logs[0].dt:
            raise ValueError(
                f"logs must have one sample time, but {logs[0].name} has {logs[0].dt:g} s, {log.name} {log.dt:g} s"
            )
