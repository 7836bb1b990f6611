"""`thruster export`: a tuned filter as C code."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from filters.c.programs import programs_of, single_error
from filters.c.project import write_project
from thruster_env.core.checks import one_of
from tuning.api.estimate import monitor_for
from tuning.cli.options import (
    OUTPUT,
    CodeOption,
    JsonOption,
    LogModelOption,
    MonitorOption,
    TunedPresetOption,
)
from tuning.cli.output import announce_compilation, check_targets, emit
from tuning.evaluation.tuned import read_tuned
from tuning.logs.problem import problems_in
from tuning.problems.find import find_problem

LANGUAGES = ("c",)


def command(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Tuned file, as `thruster tune` writes it.")],
    out: Annotated[Path, typer.Option(metavar="FOLDER", help="Folder for the files.", rich_help_panel=OUTPUT)],
    language: Annotated[str, typer.Option(help="Only c.", rich_help_panel=OUTPUT)] = "c",
    name: Annotated[
        str | None,
        typer.Option(help="Name of the C type and files; the filter's by default.", rich_help_panel=OUTPUT),
    ] = None,
    single: Annotated[bool, typer.Option("--single", help="Single precision.", rich_help_panel=OUTPUT)] = False,
    monitor: MonitorOption = None,
    board: Annotated[
        bool,
        typer.Option(
            "--board", help="Also write board.c and board.ld, for an emulated Cortex-M4.", rich_help_panel=OUTPUT
        ),
    ] = False,
    problem: CodeOption = None,
    model: LogModelOption = None,
    preset: TunedPresetOption = None,
    json: JsonOption = None,
) -> None:
    """Write a tuned Kalman or ensemble filter as C99, with its model, Q and R, and a program that filters a log.

    All but gsf, imm, mmae and fuzzy can be exported. The code has fixed sizes and needs only math.h; it comes with
    a C++ class. --single also prints the largest change of an estimate on a training run.
    See docs/howto/export.md.

    Example: thruster export out/ekf-mismatch-seed0.json --out boat
    """
    one_of("a language", language, LANGUAGES)
    watch = monitor_for(monitor, file)
    check_targets((out / "README.md",), json, read=(file,))
    choice, source, seed = read_tuned(file, [*map(find_problem, problem or []), *problems_in(file, model, preset)])
    filter_ = choice.filter(source)
    options: dict[str, Any] = {"single": single, "monitor": watch, "board": board, "dt": source.dt}
    files = [str(path) for path in write_project(filter_, out, name, **options)]
    lines, error = [f"wrote {path}" for path in files], None
    if single:
        announce_compilation()
        data = source.data(source.training_seeds(seed, 2)[:1])
        error = single_error(filter_, programs_of(filter_), data.inputs[0], data.measurements[0])
        lines.append(
            f"Single precision changes estimates by at most {error:.1g} standard deviations on a training run."
        )
    emit(lines, {"files": files, "single_error": error}, json)
