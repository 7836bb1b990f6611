"""How the parameters of a verb stand at the command line, where its signature and docstring cannot say it.

A verb is a function such as `tuning.evaluate`. `tuning.cli.verbs` makes its command: types and defaults come from
the signature, help from the docstring, and the rest from these markers in `Annotated`.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

# Panels of the help, in the order in which verbs declare their parameters.
INPUT, FILTER, SEARCH, LEARNING, RUNS, OUTPUT = "Input", "Filter", "Search", "Learning", "Runs", "Output"
LOGS = "Recorded runs"
UNSET: Any = object()
READ, WRITTEN = "read", "written"


@dataclass(frozen=True)
class Option:
    """A parameter as an option; what is left out follows from its name, type, default and description.

    Attributes:
        panel: that groups it in the help.
        names: "--filter", for instance, or "--grid/--no-grid".
        metavar: word for its value.
        type: of its value, if the annotation allows more than a command line can express.
        default: if it differs from the function's.
        choices: names that are accepted in any case, or which list of `tuning.cli.verbs.names_in`. They follow a
            description that ends with a colon.
        listed: what follows instead.
        least: of a number.
        most: of a number.
        file: READ or WRITTEN: whether a file can be written is checked before anything runs.
        unset: the argument for a command in which it is not given, if it is not the function's default.
    """

    panel: str = RUNS
    names: tuple[str, ...] = ()
    metavar: str | None = None
    type: Any = None
    default: Any = UNSET
    choices: Iterable[str] | str | None = None
    listed: str = ""
    least: float | None = None
    most: float | None = None
    file: str | None = None
    unset: Any = UNSET


@dataclass(frozen=True)
class Argument(Option):
    """A parameter whose value stands alone on the command line; it may be named by an option in addition."""


@dataclass(frozen=True)
class LogsArgument(Argument):
    """Recorded runs: the file or files, and options of `tuning.read_logs` up to the parameter `last`."""

    last: str = ""


@dataclass(frozen=True)
class ProblemOption(Option):
    """A problem, or several: its name, or recorded runs (--log) with options of `read_logs` up to `last`."""

    last: str = "start"


@dataclass(frozen=True)
class Group:
    """A dataclass whose fields are options."""

    of: Any


@dataclass(frozen=True)
class PythonOnly:
    """A parameter without an option, and its value for a command."""

    value: Any = UNSET


Progress = Annotated[bool | None, PythonOnly(True)]
ExecutorOption = Annotated[Executor | str | None, Option(RUNS, metavar="processes:N|mpi|dask:ADDRESS", type=str)]
Seed = Annotated[int, Option(RUNS, least=0)]
Augment = Annotated[Sequence[str] | Mapping[str, Any], Option(FILTER, metavar="NAME[:STD[:WALK]]", type=list[str])]
FilterOption = Option(FILTER, ("--filter",), type=str, choices="filters")
TunedArgument = Argument(FILTER, ("--tuned",), "FILE", str, file=READ)
PresetOption = Option(INPUT, type=str, choices="presets", file=READ)
ModelOption = Option(INPUT, metavar="MODEL", type=str)
Preset = Annotated[str | Path | None, PresetOption]
Model = Annotated[Any, ModelOption]
OneProblem = Annotated[Any, ProblemOption(INPUT, ("--problem", "--scenario"), type=str, choices="problems")]
CodeProblem = Annotated[Any, Option(INPUT, ("--problem",), "MODULE:OBJECT", list[str])]
TunedFile = Annotated[str | Path, Argument(FILTER, metavar="FILE", type=Path, file=READ)]
WrittenFile = Annotated[str | Path | None, Option(OUTPUT, metavar="FILE", type=Path, file=WRITTEN)]
