"""`thruster report`: a page on a tuned filter, its study and its evaluation on held-out seeds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tuning.api.study import STUDIES
from tuning.cli.options import INPUT, OUTPUT, CodeOption, JsonOption, LogModelOption, TunedPresetOption
from tuning.cli.output import announce_compilation, emit, working
from tuning.logs.problem import problems_in
from tuning.problems.find import find_problem
from tuning.reporting.report import Source, write_report, write_two_studies
from tuning.reporting.subject import is_file
from tuning.search.study import quiet_optuna


def command(
    sources: Annotated[
        list[str],
        typer.Argument(
            metavar="FILE_OR_STUDY...", help="Tuned file, or name of a study; two are shown side by side."
        ),
    ],
    storage: Annotated[
        str,
        typer.Option(
            help="Storage of the study: a journal file, or an Optuna storage URL.", rich_help_panel=INPUT
        ),
    ] = STUDIES,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER", help="Page to write; by default beside the tuned file.", rich_help_panel=OUTPUT
        ),
    ] = None,
    problem: CodeOption = None,
    model: LogModelOption = None,
    preset: TunedPresetOption = None,
    json: JsonOption = None,
) -> None:
    """Write a report page on a tuned filter, for any browser without a network, and its tables as Markdown.

    It shows errors and consistency before and after on held-out seeds, the convergence of the study, the
    importance of parameters, the error against ensemble size, one run over time with 95 % bands, and advice.

    With two files it shows both side by side and, for the same problem, the paired ratio of their scores.

    Example: thruster report out/enkf-mismatch-seed0.json

    Example: thruster report out/ekf-outliers-seed0.json out/ekf-robust-outliers-seed0.json
    """
    quiet_optuna()
    announce_compilation()
    of_files = [
        stored for source in sources if is_file(source) for stored in problems_in(Path(source), model, preset)
    ]
    problems = [*map(find_problem, problem or []), *of_files]
    with working(f"reporting on {' and '.join(sources)}"):
        if len(sources) == 1:
            report = write_report(sources[0], storage, out, problems)
        else:
            report = write_two_studies([Source(source, storage, problems) for source in sources], out)
    data = {"advice": report.advice, "page": str(report.page), "tables": str(report.tables)}
    emit([report.advice, f"Page: {report.page}", f"Tables: {report.tables}"], data, json)
