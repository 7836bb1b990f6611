"""Recorded logs as the problem of a study: from the options of a command, or as a tuned file names them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from filters.tuned_file import read_tuned_file
from numerics.checks import shown
from plants.replay import read_for
from thruster_cli.logs import read_named
from thruster_cli.presets import of_preset
from tuning.problems.find import find_problem
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Problem

OPTIONS = ("preset", "model", "sensors", "columns", "clock_offset", "dt")  # of `read_named`
CUTS = ("held_out", "blocks", "lead")


def log_problem(
    logs: Sequence[str | Path],
    held_out: Sequence[str | Path] | None = None,
    blocks: int | None = None,
    lead: int | None = None,
    **options,
) -> LogProblem:
    """The problem of some logs.

    Args:
        logs: paths of recorded runs.
        held_out: paths of runs that a study never sees; those that are not among the logs are added to them.
        blocks: of each run.
        lead: rows of a block's lead-in.
        **options: of `read_named`.

    Raises:
        ValueError: states the rule and the value.
    """
    names = list(dict.fromkeys(map(str, logs)))
    proving = [str(path) for path in held_out or []]
    names += [name for name in proving if name not in names]
    if not names:
        raise ValueError("a problem of logs must have at least one, but got none: say --log FILE")
    pairs = [read_named(name, **options) for name in names]
    recorded = [log for log, _ in pairs]
    model = read_for(recorded[0], pairs[0][1])[1]()
    cuts = {"held_out": proving, "blocks": blocks, "lead": lead}
    cuts = {key: value for key, value in cuts.items() if value is not None and value != []}
    content = {key: value for key, value in options.items() if value is not None} | cuts
    return LogProblem(recorded, model, **cuts, content={"options": content})


def problems_in(file: Path, model: str | None = None) -> list[Problem]:
    """The problems of logs that a tuned file names, read anew; none if it names none.

    A model that is code is not imported because a file names it: the caller says it once more.

    Raises:
        ValueError: if a log cannot be read, the options in the file are none, or the model is code and not given.
    """
    if not file.is_file():
        return []
    found: list[Problem] = []
    for name, entry in read_tuned_file(file)["problems"].items():
        content = entry.get("content") if isinstance(entry, dict) else None
        if not isinstance(content, dict) or "logs" not in content:
            continue
        try:
            paths = [one["file"] for one in content["logs"]]
            options = dict(content["options"])
            if not all(isinstance(path, str) for path in paths) or set(options) - {*OPTIONS, *CUTS}:
                raise TypeError
        except (KeyError, TypeError):
            raise ValueError(
                f"logs in a tuned file must have paths and options, but {file} has {shown(content)}"
            ) from None
        _check_model(options.get("model"), model, file)
        found.append(log_problem(paths, **options))
        if found[-1].name != name:
            said = f"logs in a tuned file must be those of {shown(name)}"
            raise ValueError(f"{said}, but {file} has {found[-1].name}")
    return found


def _check_model(named, given: str | None, file: Path) -> None:
    """Raise ValueError unless the caller gives the code that a file names, or none where it names none."""
    if named is None and given is not None:
        raise ValueError(f"--model must be left out for logs of a thruster, as in {file}, but got {shown(given)}")
    if named != given:
        raise ValueError(
            f"the model of logs must be given where it is code, but {file} only names {shown(named)}: say --model "
            f"{named}, if you trust it"
        )


def problems_of(
    names: Sequence[str] | None, logs: Sequence[Path] | None, options: Mapping, default: str
) -> tuple[Problem, ...]:
    """What a study is for: logs with their options, or problems by name."""
    given = {name: value for name, value in options.items() if value is not None}
    if logs:
        if names:
            raise ValueError(f"a study must be of --log or of --problem, but got both, {logs[0]} and {names[0]}")
        return (log_problem(logs, **given),)
    preset = given.pop("preset", None)
    if given:
        first = next(iter(given))
        option = {"sensors": "sensor", "columns": "column"}.get(first, first).replace("_", "-")
        raise ValueError(f"--{option} must come with --log, but there is none")
    return tuple(of_preset(find_problem(name), preset) for name in names or [default])
