"""Requirements on the recorded runs of a problem: one sample time, and separate held-out runs."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from thruster_env.core.checks import short_repr
from thruster_env.logs.log import Log, shared_by
from thruster_env.model.continuous import same_dt


def checked_logs(given: Any) -> tuple[Log, ...]:
    """Logs of one problem as a tuple; ValueError unless they have one sample time and different names."""
    logs = (given,) if isinstance(given, Log) else tuple(given) if isinstance(given, Sequence) else ()
    if not logs or not all(isinstance(log, Log) for log in logs):
        raise ValueError(f"logs must be some thruster_env.logs.log.Log, but got {short_repr(given)}")
    check_times(logs)
    names = [log.name for log in logs]
    if len(set(names)) < len(names):
        raise ValueError(f"logs of one problem must have different names, but got {', '.join(names)}")
    return logs


def check_times(logs: Sequence[Log]) -> None:
    """Raise ValueError unless all logs have the same sample time, all on grids or all on their own stamps."""
    for log in logs[1:]:
        if (log.stamps is None) != (logs[0].stamps is None):
            own, other = (logs[0], log) if log.stamps is None else (log, logs[0])
            raise ValueError(f"logs must all lie on grids or none, but {own.name} does not and {other.name} does")
        if not same_dt(log.dt, logs[0].dt):
            first, dt = logs[0].name, f"{logs[0].dt:g}"
            how = "put them on one grid" if log.stamps is None else "give both the same"
            raise ValueError(
                f"logs of one problem must have the same sample time, but {first} has {dt} s and {log.name} "
                f"{log.dt:g} s: {how} with --dt {dt}, in Python dt={dt}"
            )


def check_apart(learning: Sequence[Log], held: Sequence[Log]) -> None:
    """Raise ValueError if a training and a held-out run have rows in common, as a copy or a part of one has."""
    found = shared_by(learning, held) if learning and held else None
    if found is not None:
        raise ValueError(
            f"held-out runs must have no rows in common with the others, but {found[1].name} has some of "
            f"{found[0].name}"
        )
