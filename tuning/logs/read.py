"""One recorded run with its model: a file or a table, its plant, and the meaning of its columns.

Whose recorded runs are: a pair (model, logs), a model, or a thruster's preset. Recorded logs as the problem
of a study: from a user's options, or from those in a tuned file.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any

from filters.tuned_file import check_preset_file, made_with, read_tuned_file, tune_options
from thruster_env.core.checks import finite, short_repr
from thruster_env.core.modules import is_code, object_named
from thruster_env.env.record import ANY_DT, read_for
from thruster_env.logs.log import Log
from thruster_env.logs.recorders.registry import ENDINGS
from thruster_env.logs.table import SUFFIXES
from thruster_env.model.continuous import ContinuousModel, in_discrete_time
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.augmented import name_and_unknown
from tuning.problems.find import named
from tuning.problems.log_problem import LogProblem
from tuning.problems.plant_packages import logs_package
from tuning.problems.problem import Problem

Named = Mapping[str, Any] | Sequence[str] | None  # a mapping, or texts NAME=VALUE as on a command line


def read_named(
    path: Any,
    preset: str | Path | None = None,
    model: Any = None,
    sensors: Sequence[str] | None = None,
    columns: Named = None,
    clock_offset: Named = None,
    dt: float | None = None,
    name: str | None = None,
    grid: bool = True,
    stamps: str | None = None,
) -> tuple[Log, Any]:
    """A log, and the source of its model at its sample time.

    Args:
        path: path of a file; a table, as a pandas.DataFrame or a mapping from headers to arrays; or a `Log`.
        preset: the recorded thruster, by name or file, whose clock offsets are corrected; for a model a FILE.toml
            with its values.
        model: instead of a thruster: a `StateSpaceModel`, what makes or offers one, or "module:object".
        sensors: measured channels of a thruster.
        columns: headers by quantity, a mapping or texts NAME=HEADER[UNIT].
        clock_offset: seconds by quantity, a mapping or texts NAME=SECONDS.
        dt: sample time [s].
        name: name of a log that is not a file.
        grid: whether samples are put on a grid; else the log is on its own stamps.
        stamps: "header" or "receipt" of a bag.

    Raises:
        ValueError: states the rule and the value.
    """
    if model is not None and (sensors or (preset is not None and not str(preset).endswith(".toml"))):
        raise ValueError(
            "a log must be of model (--model) or of a thruster (preset, sensors; --preset, --sensor), but got both"
        )
    offsets = pairs("clock_offset (--clock-offset)", clock_offset)
    options: dict[str, Any] = {
        "columns": pairs("columns (--column)", columns),
        "clock_offset": {key: _seconds(key, value) for key, value in offsets.items()},
        "dt": dt,
        "grid": None if grid else False,
        "stamps": stamps,
    }
    if isinstance(path, Log):
        option = next((key for key, value in options.items() if value not in (None, {})), None)
        if option is not None:
            raise ValueError(f"{option} must come with a file or a table, but {path.name} is a Log already")
    elif name is not None:
        options["name"] = name
    if model is not None:
        offer = object_named(model, "model") if isinstance(model, str) else model
        if preset is not None:
            from tuning.identification.result import with_values

            log = read_for(path, offer, **options)[0]
            offer = with_values(in_discrete_time(offer), preset)
            offer(log.dt)  # or the values are of another sample time
            return log, offer
        return read_for(path, offer, **options)[0], offer
    room = logs_package()
    whose = room.DEFAULT_PRESET if preset is None else str(preset)
    thruster = room.Preset(whose, sensors, ANY_DT)
    log, _ = read_for(path, thruster.state_space_model(), **options)
    known = {key: value for key, value in thruster.clock_offset.items() if f"measurement:{key}" not in log.offsets}
    if known and not isinstance(path, Log):  # offsets of the user or of the log itself have priority
        options["clock_offset"] |= known
        log, _ = read_for(path, thruster.state_space_model(), **options)
    return log, room.Preset(whose, sensors, log.dt)


def pairs(option: str, named: Named) -> dict[str, Any]:
    """A mapping, from a mapping or from texts NAME=VALUE; ValueError for another form, or a repeated name."""
    if isinstance(named, Mapping):
        return dict(named)
    if isinstance(named, str) or not isinstance(named, Sequence | None):
        raise ValueError(f"{option} must be a mapping by name, or texts NAME=VALUE, but got {short_repr(named)}")
    values: dict[str, str] = {}
    for text in named or []:
        name, equals, value = text.partition("=")
        if not (name and equals and value) or name in values:
            rule = "be given once for each name" if name in values else "have the form NAME=VALUE"
            raise ValueError(f"{option} must {rule}, but got {short_repr(text)}")
        values[name.strip()] = value.strip()
    return values


def texts(named: Named) -> list[str] | None:
    """The same as texts NAME=VALUE, as in files; None for nothing."""
    if named is None:
        return None
    return [f"{name}={value}" for name, value in named.items()] if isinstance(named, Mapping) else list(named)


def _seconds(name: str, value: Any) -> float:
    try:
        return finite(f"the clock offset of {name}", value)
    except ValueError:
        raise ValueError(
            f"clock_offset (--clock-offset) of {name} must be seconds, but got {short_repr(value)}"
        ) from None


def as_tuned(named: Mapping[str, Any], tuned: str | Path | None) -> dict[str, Any]:
    """Options for reading a log, with the preset and sensors of a tuned file's own logs where none are given.

    Raises:
        ValueError: if no model is given, and the file only names one that is code.
    """
    if tuned is None or named.get("model") is not None:
        return dict(named)
    options = tune_options(read_tuned_file(tuned))
    check_preset_file(options, named.get("preset"), tuned)
    if named.get("preset") is None:
        check_model(options.get("model"), None, tuned)
    stored: dict[str, Any] = {name: value for name, value in options.items() if name in ("preset", "sensors")}
    return {**stored, **{name: value for name, value in named.items() if value not in (None, [])}}


def check_model(named, trusted: str | None, file: str | Path) -> None:
    """Raise ValueError unless the caller gives exactly the code that a file names."""
    if named is None and trusted is not None:
        raise ValueError(
            f"model (--model) must be left out for logs of a thruster, as in {file}, but got {short_repr(trusted)}"
        )
    if named != trusted:
        value = trusted if trusted is None or isinstance(trusted, str) else type(trusted)
        raise ValueError(
            f"the model of logs must be given by its name if it is code, but {file} names {short_repr(named)} and "
            f"got {short_repr(value)}: use --model {named} (model={named!r} in Python), if you trust it"
        )


def model_of_logs(logs: Any, model: Any, preset: str | Path | None) -> tuple[Any, Any, str | Path | None]:
    """Logs, their model (None for a thruster) and the preset, from what a user gives.

    Args:
        logs: recorded runs, or a pair (model, logs) as `tuning.tune` takes it.
        model: a model, what makes or offers one, "module:object", or a thruster's preset.
        preset: a thruster, by name or file.

    Raises:
        ValueError: if a model or a preset is given twice, or a model is neither code nor a preset.
    """
    if isinstance(logs, tuple) and len(logs) == 2 and _is_model(logs[0]):
        if model is not None:
            raise ValueError(f"a pair (model, logs) must come without another model, but got {short_repr(model)}")
        model, logs = logs
    if not isinstance(model, str | Path) or is_code(str(model)):
        return logs, model, preset
    if preset is not None:
        raise ValueError(
            f"give either a model or a preset, but got both, {short_repr(model)} and {short_repr(preset)}"
        )
    if not logs_package().is_preset(model):
        rule = "a model must be an object, 'module:object' or a thruster's preset"
        raise ValueError(f"{rule}, but got {short_repr(model)}")
    return logs, None, model


def _is_model(candidate: Any) -> bool:
    """Whether something is a model, what makes or offers one, code, or a thruster's preset, but no log."""
    if isinstance(candidate, str | Path):
        if Path(candidate).suffix in (*SUFFIXES, *ENDINGS):  # a log in a folder of Windows has a colon, too
            return False
        return is_code(str(candidate)) or logs_package().is_preset(candidate)
    return (
        isinstance(candidate, StateSpaceModel | ContinuousModel)
        or hasattr(candidate, "state_space_model")
        or _makes_one(candidate)
    )


def _makes_one(candidate: Any) -> bool:
    return callable(candidate) and not isinstance(candidate, Log) and not hasattr(candidate, "columns")


OPTIONS = ("preset", "model", "sensors", "columns", "clock_offset", "dt", "grid", "stamps")  # of `read_named`
CUTS = ("held_out", "blocks", "lead", "hold_gaps", "start")


def log_problem(
    logs: Any,
    held_out: Any = None,
    blocks: int | None = None,
    lead: int | None = None,
    hold_gaps: bool = False,
    start: str | None = None,
    *,
    apart: bool = True,
    **options: Any,
) -> LogProblem:
    """The problem of some logs.

    Args:
        logs: a recorded run or several: paths, tables or `Log`s, as `read_named` takes them. Names of
            tables are run1, run2, ...
        held_out: held-out runs, or their paths or names; those that are not among the logs are added to them. A
            run among the logs with the same content is the held-out one, whatever its path or name.
        blocks: number of blocks of each run.
        lead: rows of a block's lead-in.
        hold_gaps: whether runs are not cut at gaps, and their inputs are held there.
        start: where blocks begin, "prior" or "measurement", as `LogProblem` takes it.
        apart: whether to check that held-out runs are not among the others; a tuned file's digests have settled
            it.
        **options: options of `read_named`.

    Raises:
        ValueError: states the rule and the value.
    """
    runs, held_names = runs_by_name(logs, held_out)
    if not runs:
        raise ValueError(
            "a problem of logs must have at least one, in (model, logs) or by --log FILE, but got none"
        )
    pairs = [read_named(log, **options, name=name) for name, log in runs.items()]
    recorded = [log for log, _ in pairs]
    recorded = without_rescaled(recorded, held_names) if apart else recorded
    runs = {log.name: runs[log.name] for log in recorded}
    model = read_for(recorded[0], pairs[0][1])[1]()
    cuts: dict[str, Any] = {"held_out": held_names, "blocks": blocks, "lead": lead, "hold_gaps": hold_gaps or None}
    cuts["start"] = start
    cuts = {key: value for key, value in cuts.items() if value is not None and value != []}
    return LogProblem(recorded, model, **cuts, apart=apart, content=_content(runs, options, cuts))


def runs_by_name(logs: Any, held_out: Any = None) -> tuple[dict[str, Any], list[str]]:
    """All runs by name, with further held-out runs at the end, and the names of the held-out runs."""
    runs: dict[str, Any] = {}
    for log in listed(logs):
        _add(runs, name_of(log, len(runs)), log)
    names = []
    for log in listed(held_out):
        name = next((known for known, run in runs.items() if _is_same(run, log)), name_of(log, len(runs)))
        if not (isinstance(log, str) and name in runs):
            _add(runs, name, log)
        names.append(name)
    return runs, list(dict.fromkeys(names))


def without_rescaled(logs: Sequence[Log], held_names: Sequence[str]) -> list[Log]:
    """The logs without those that are the content of a held-out one under another name.

    Args:
        logs: recorded runs.
        held_names: names of the held-out ones.

    Raises:
        ValueError: if nothing is left to learn from.
    """
    proving = {log.digest for log in logs if log.name in held_names}
    left = [log for log in logs if log.name in held_names or log.digest not in proving]
    if held_names and all(log.name in held_names for log in left):
        raise ValueError("at least one log must be left to learn from, but all are held out")
    return left


def _is_same(first: Any, other: Any) -> bool:
    """Whether two runs are one object, or paths of one file."""
    if isinstance(first, str | PathLike) and isinstance(other, str | PathLike):
        return Path(first).resolve() == Path(other).resolve()
    return first is other


def listed(logs: Any) -> list:
    """Recorded runs as a list; a single run need not be in one. Empty for None."""
    if logs is None:
        return []
    return list(logs) if isinstance(logs, list | tuple) else [logs]


def _add(runs: dict[str, Any], name: str, log: Any) -> None:
    if name in runs and not isinstance(log, str | PathLike) and runs[name] is not log:
        raise ValueError(f"logs must have different names, but got two called {name}")
    runs.setdefault(name, log)


def name_of(log: Any, index: int) -> str:
    """Name of a log: its path, its own name, or for a table its number."""
    if isinstance(log, Log):
        return log.name
    return str(log) if isinstance(log, str | PathLike) else f"run{index + 1}"


def _content(runs: Mapping[str, Any], options: Mapping[str, Any], cuts: Mapping[str, Any]) -> dict | None:
    """The options of the problem as data for JSON; None where a log is not a file, or the model is an object."""
    model, plain = options.get("model"), dict(options)
    if not all(isinstance(log, str | PathLike) for log in runs.values()) or not isinstance(model, str | None):
        return None
    for name in ("columns", "clock_offset"):
        plain[name] = texts(plain.get(name))
    plain["preset"] = None if plain.get("preset") is None else str(plain["preset"])
    plain["sensors"] = None if plain.get("sensors") is None else list(plain["sensors"])
    set_options = {name: plain[name] for name in options if plain[name] is not None}
    return {"options": {**set_options, **cuts}}


def problems_in(file: Path, model: str | None = None, preset: str | Path | None = None) -> list[Problem]:
    """The problems of logs that a tuned file names, read again; empty if it names none.

    A model that is code is not imported because a file names it: the caller has to give it again.

    Args:
        file: the tuned file.
        model: of the logs, if it is code.
        preset: where the file's preset is now; of a scenario the preset with which the file was made.

    Raises:
        ValueError: if a log cannot be read, the options in the file are damaged, or a model that is code is not
            given.
    """
    if not file.is_file():
        return []
    problems: list[Problem] = []
    of_file = read_tuned_file(file)
    for name, entry in of_file["problems"].items():
        content = entry.get("content") if isinstance(entry, dict) else None
        if isinstance(content, dict) and isinstance(content.get("of"), dict):  # that of an augmented problem
            name, content = name_and_unknown(name)[0], content["of"].get("content")
        if not isinstance(content, dict) or "logs" not in content:
            continue
        try:
            paths = [log["file"] for log in content["logs"]]
            options = dict(content["options"])
            if not all(isinstance(path, str) for path in paths) or set(options) - {*OPTIONS, *CUTS}:
                raise TypeError
        except (KeyError, TypeError):
            raise ValueError(
                f"logs in a tuned file must have paths and options, but {file} has {short_repr(content)}"
            ) from None
        check_model(options.get("model"), model, file)
        check_preset_file(options, preset, file)
        _check_logs_are_there(paths, file)
        options |= {} if preset is None else {"preset": str(preset)}
        problem = log_problem(paths, **options, apart=False)
        if name not in (problem.name, re.sub(r" and (\d+) more$", r"+\1", problem.name)):  # as it was until 0.1
            rule = f"logs in a tuned file must be those of {short_repr(name)}"
            raise ValueError(f"{rule}, but {file} has {problem.name}")
        problems.append(named(problem, name))
    if preset is not None and not problems and str(preset) != tune_options(of_file).get("preset"):
        raise ValueError(
            f"preset (--preset) must be that of the tuned file, but got {preset}, and {file} was made with "
            f"{made_with(of_file)}, whose contents it holds: leave --preset out"
        )
    return problems


def _check_logs_are_there(paths: Sequence[str], file: Path) -> None:
    """Raise ValueError if one of the logs that a tuned file names is not there."""
    missing = [path for path in paths if not Path(path).exists()]
    if missing:
        raise ValueError(
            f"the logs of {file} must be where they were, but there is no file {', '.join(missing)}: run the "
            "command in the folder in which thruster tune ran, or put them back"
        )


def model_named_in(problem: Problem) -> str | None:
    """The model that must be given again (--model) with a tuned file of a problem; None where none must."""
    content = problem.as_mapping()
    if content is None or "logs" not in content:
        return None
    return content["options"].get("model")
