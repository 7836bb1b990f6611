"""`tuning.report`: a page on a tuned filter that any browser shows without a network."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import optuna
from optuna.study import StudyDirection

from thruster_env.core.checks import short_repr
from thruster_env.core.files import check_target, write_whole
from tuning.api.problems import given_for, problems_of
from tuning.api.progress import console_for, working
from tuning.api.study import STUDIES, Study
from tuning.evaluation.held_out import sizes_as_data
from tuning.problems.problem import Problem
from tuning.reporting.report import Source, write_report, write_two_studies
from tuning.reporting.subject import is_file
from tuning.search.among_types import SIZES
from tuning.search.storage import open_storage, quiet_optuna, storage_text


def report(
    source: str | Path | Study | Sequence[str | Path | Study],
    out: str | Path | None = None,
    *,
    storage: str | Path = STUDIES,
    problem: Any = None,
    model: Any = None,
    preset: str | Path | None = None,
    progress: bool | None = None,
) -> Path:
    """Write a page on a tuned filter, its study and its evaluation on held-out seeds; return the page's path.

    The page's tables are also written as Markdown beside it. The page is self-contained and needs no network. For
    a list of two it shows both side by side and, for the same problem, the paired ratio of their scores.

        tuning.report("tuned.json", out="report.html")
        tuning.report(["ekf.json", "ukf.json"], out="both.html")

    Args:
        source: a `Study`, a tuned file, or the name of a study in the storage; or a list of two of them.
        out: the page, a .html file, or a folder for it; by default beside the tuned file, or in the folder out.
        storage: storage of the study; without it the page on a file omits the search.
        problem: the problem it was tuned on, if that is code or has changed: a file only names it.
        model: of the logs of a tuned file, if it is code: a model, what makes or offers one, or "module:object".
        preset: the preset with which a tuned file was made, such as the new path of its FILE.toml.
        progress: whether to show progress; by default only in terminals and notebooks.

    Raises:
        ValueError: if the source is refused, or the page cannot be written.
    """
    console = console_for(progress)
    several: list[Any] = list(source) if isinstance(source, list | tuple) else [source]
    if isinstance(out, Study) or (out is not None and Path(out).suffix == ".json"):
        rule = "a page must be a file that ends in .html, or a folder for it, and two studies must be in one list"
        raise ValueError(f"{rule}, but got out={short_repr(out if isinstance(out, Study) else str(out))}")
    page = None if out is None or Path(out).suffix != ".html" else Path(out)
    if page is not None:
        check_target(page)
    with quiet_optuna(), working("reporting", console), tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "page" if page is not None else None if out is None else Path(out)
        if folder is None and several and isinstance(several[0], Study):
            folder = Path("out")  # beside its scratch file the page would be lost
        sources = [
            _of_value(subject, Path(scratch) / str(i))
            if isinstance(subject, Study)
            else Source(subject, storage_text(storage), _given(subject, problem, model, preset))
            for i, subject in enumerate(several)
        ]
        if len(sources) == 1:
            single = sources[0]
            written = write_report(single.name, single.storage, folder, single.problems, single.file)
        else:
            written = write_two_studies(sources, folder)
        if page is None:
            return written.page
        write_whole(page, written.page.read_bytes())
        write_whole(page.with_suffix(".md"), written.tables.read_bytes())
        return page


def _given(source: str | Path, problem: Any, model: Any, preset: str | Path | None) -> Sequence[Problem]:
    """What the user gives of the problems that a file or a study names."""
    if not isinstance(source, str | Path):
        raise ValueError(
            f"a report must be of a Study, a tuned file or the name of a study, but got {short_repr(source)}"
        )
    if is_file(source) and Path(source).is_file():
        return given_for(source, problem, model, preset)
    return [] if problem is None else problems_of(problem)


def _of_value(study: Study, folder: Path) -> Source:
    """A study as a tuned file and a journal that holds its trials, in a folder of its own."""
    folder.mkdir()
    journal, tuning = str(folder / "study.journal"), study.tuning
    plan, sizes = tuning.plan, tuning.result.sizes
    directions = [StudyDirection.MINIMIZE] * len(plan.objectives)
    copied = optuna.create_study(study_name=study.name, storage=open_storage(journal), directions=directions)
    copied.set_user_attr("identity", plan.identity)
    if sizes:
        copied.set_user_attr(SIZES, sizes_as_data(sizes, tuning.result.sized or study.choice, plan))
    copied.add_trials(study.trials)
    file = folder / f"{study.name}.json"
    tuning.write(file)
    return Source(file, journal, study.problems, str(tuning.file) if tuning.file else "")
