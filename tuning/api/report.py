"""`tuning.report` and `thruster report`: a page on a tuned filter, its tables as Markdown, and on two studies."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from math import isfinite
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import optuna
from optuna.study import StudyDirection

from filters.consistency.nees import Interval
from filters.consistency.report import rounded
from filters.registry import filter_type
from thruster_env.core.checks import short_repr
from thruster_env.core.files import check_target, write_whole
from tuning.api.held_out import HeldOut
from tuning.api.markers import (
    INPUT,
    OUTPUT,
    Argument,
    CodeProblem,
    ModelOption,
    Option,
    PresetOption,
    Progress,
)
from tuning.api.problems import given_for, problems_of
from tuning.api.progress import console_for, working
from tuning.api.result import Result
from tuning.api.study import STUDIES, Study
from tuning.evaluation.evaluate import evaluate, likelihood_gain, score_ratio
from tuning.evaluation.held_out import (
    Comparison,
    evaluate_held_out,
    sizes_as_data,
    stored_comparison,
    stored_sizes,
)
from tuning.evaluation.sizes import SizeRow, ensemble_sizes, sufficient_size
from tuning.likelihood.identifiability import identify, sentences, too_many
from tuning.problems.problem import Problem
from tuning.reporting.page import Pair, Section, Table, Words, html_page, markdown_page
from tuning.reporting.search_figures import Sketchbook
from tuning.reporting.sections import (
    advice,
    facts_section,
    held_out_section,
    lines_section,
    model_section,
    run_sections,
    score_section,
    search_section,
    sizes_section,
)
from tuning.reporting.subject import Subject, find_subject, is_file
from tuning.reporting.tables import known_table
from tuning.search.among_types import SIZES
from tuning.search.objectives import nis_ratio
from tuning.search.plan import at_ends
from tuning.search.storage import open_storage, quiet_optuna, storage_text
from tuning.search.trials import measure


@dataclass(frozen=True)
class Report(Result):
    """The files of a report, and a summary sentence per study; `open` and `Path` take it as its page.

    Attributes:
        page: for any browser.
        markdown: its tables.
        advice: the summary.
    """

    page: Path
    markdown: Path
    advice: str

    def __fspath__(self) -> str:
        return str(self.page)

    def tables(self) -> list[str]:
        """The summary and the files, for a terminal."""
        return [self.advice, f"Page: {self.page}", f"Tables: {self.markdown}"]

    def as_dict(self) -> dict[str, str]:
        """The same as plain data, as in `thruster report --json`."""
        return {"advice": self.advice, "page": str(self.page), "tables": str(self.markdown)}


def report(
    source: Annotated[
        str | Path | Study | Sequence[str | Path | Study], Argument(INPUT, (), "FILE_OR_STUDY...", list[str])
    ],
    out: Annotated[str | Path | None, Option(OUTPUT, metavar="FOLDER")] = None,
    *,
    storage: Annotated[str | Path, Option(INPUT)] = STUDIES,
    problem: CodeProblem = None,
    model: Annotated[Any, ModelOption] = None,
    preset: Annotated[str | Path | None, PresetOption] = None,
    progress: Progress = None,
) -> Report:
    """Write a page on a tuned filter, for any browser without a network, and its tables as Markdown.

    It shows errors and consistency before and after on held-out seeds, the convergence of the study, the
    importance of parameters, the error against ensemble size, one run over time with 95 % bands, and advice.

    With two files it shows both side by side and, for the same problem, the paired ratio of their scores.

        tuning.report("tuned.json", out="report.html")
        tuning.report(["ekf.json", "ukf.json"], out="both.html")

    Example: thruster report out/enkf-mismatch-seed0.json

    Example: thruster report out/ekf-outliers-seed0.json out/ekf-robust-outliers-seed0.json

    Args:
        source: tuned file, or name of a study in the storage; two are shown side by side. In Python also a
            `Study`, or a list of two.
        out: the page, a .html file, or a folder for it; by default beside the tuned file, or in the folder out.
        storage: storage of the study, a journal file or an Optuna storage URL; without it the page on a file omits
            the search.
        problem: the problem it was tuned on, if that is code: names in files and studies are never imported. In
            Python also a `Problem`.
        model: the model of the logs that it was tuned on, if that is code. In Python also what makes or offers
            one.
        preset: the preset with which it was tuned, by default as the tuned file names it:
        progress: whether to show progress; by default only in terminals and notebooks.

    Returns:
        `Report`: `page`, `markdown` and `advice`.

    Raises:
        ValueError: if the source is refused, or the page cannot be written.
    """
    console = console_for(progress)
    several: list[Any] = [source] if isinstance(source, str | Path | Study) else source  # type: ignore[assignment]
    several = list(several) if isinstance(several, list | tuple) else [several]
    if isinstance(out, Study) or (out is not None and Path(out).suffix == ".json"):
        rule = "a page must be a file that ends in .html, or a folder for it, and two studies must be in one list"
        raise ValueError(f"{rule}, but got out={short_repr(out if isinstance(out, Study) else str(out))}")
    page = None if out is None or Path(out).suffix != ".html" else Path(out)
    if page is not None:
        check_target(page)
    names = [subject.name if isinstance(subject, Study) else str(subject) for subject in several]
    doing = f"reporting on {' and '.join(names)}"
    with quiet_optuna(), working(doing, console), tempfile.TemporaryDirectory() as scratch:
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
            return written
        write_whole(page, written.page.read_bytes())
        write_whole(page.with_suffix(".md"), written.markdown.read_bytes())
        return Report(page, page.with_suffix(".md"), written.advice)


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
    journal, plan, sizes = str(folder / "study.journal"), study.plan, study.result.sizes
    directions = [StudyDirection.MINIMIZE] * len(plan.objectives)
    copied = optuna.create_study(study_name=study.name, storage=open_storage(journal), directions=directions)
    copied.set_user_attr("identity", plan.identity)
    if sizes:
        copied.set_user_attr(SIZES, sizes_as_data(sizes, study.result.sized or study.choice, plan))
    copied.add_trials(study.trials)
    file = folder / f"{study.name}.json"
    study.write(file)
    return Source(file, journal, study.problems, str(study.file) if study.file else "")


# The page of one study.


class Pages(NamedTuple):
    """All results of one study, ready for a page."""

    subject: Subject
    title: str
    advice: str
    sections: list[Section]
    results: list[Table | str]  # tables and sentences, also for Markdown
    comparisons: list[Comparison]


def write_report(
    source: str | Path,
    storage: str,
    out: str | Path | None = None,
    problems: Sequence[Problem] = (),
    file: str | None = None,
) -> Report:
    """Write a page, NAME.html, and its tables, NAME.md, on a tuned file or a study.

    Held-out metrics and the table of ensemble sizes come from the file or the study if they were made from the
    same problems by the same versions of packages; otherwise they are recomputed. `verify` always recomputes.

    Args:
        source: a tuned file, or the name of a study.
        storage: where the study is; without it a page on a tuned file leaves the search out.
        out: folder of the two files, by default that of the tuned file, or `out`.
        problems: what it is of, where that is code: nothing that a file or a study names is imported.
        file: what the page calls the tuned file, empty for one that is not saved; the source itself if None.

    Raises:
        ValueError: if the tuned file is refused, there is no such study, or the folder cannot be written.
    """
    subject = find_subject(source, storage, problems)
    name = Path(source).stem if is_file(source) else subject.name
    page, tables = report_files(source, name, out)
    contents = pages_of(source, subject, file=file)
    write_whole(page, html_page(contents.title, contents.advice, contents.sections))
    write_whole(tables, markdown_page(contents.title, [contents.advice, *contents.results]))
    return Report(page, tables, contents.advice)


def report_files(source: str | Path, name: str, out: str | Path | None) -> tuple[Path, Path]:
    """Page and tables of a name, in `out` or beside the tuned file; ValueError if they cannot be written."""
    folder = Path(out) if out is not None else Path(source).parent if is_file(source) else Path("out")
    targets = folder / f"{name}.html", folder / f"{name}.md"
    for target in targets:
        check_target(target)
    return targets


def pages_of(source: str | Path, subject: Subject, prefix: str = "p", file: str | None = None) -> Pages:
    """The contents of a page on a study, whose pictures' names begin with a prefix."""
    plan, choice = subject.plan, subject.choice
    file = str(source) if file is None and is_file(source) else file or None
    data = plan.training_data()
    sizes: Sequence[SizeRow] = []
    if filter_type(choice.name).has_ensemble:
        kept_rows = stored_sizes(subject.sizes, choice, plan)
        sizes = ensemble_sizes(choice, plan, data, subject.consistent) if kept_rows is None else kept_rows
    if sizes and not subject.chosen:
        choice = choice.with_size(sufficient_size(sizes, subject.consistent))
        subject = subject._replace(choice=choice)
    stored = [stored_comparison(subject.content, choice, scenario) for scenario in plan.scenarios]
    comparisons = [
        evaluate_held_out(choice, scenario, plan.seed, subject.seeds) if comparison is None else comparison
        for comparison, scenario in zip(stored, plan.scenarios, strict=True)
    ]
    title = f"{choice.name} tuned on {', '.join(_short(scenario.name) for scenario in plan.scenarios)}"
    known = identify(choice, plan.scenarios, data, plan.space())
    identified = at_ends(choice, plan)
    identified += sentences(known) if known else too_many(choice, plan.space())
    nis = subject.nis or [nis_ratio(values) for values in measure(choice, plan, data)]
    results = [
        HeldOut(choice, scenario, comparison, seed=plan.seed, forget=plan.forget).tables()
        for scenario, comparison in zip(plan.scenarios, comparisons, strict=True)
    ]
    determined = [known_table(known)] if known else []
    words = [Words(identified)] if identified else []
    book = Sketchbook(prefix)
    sections = [
        held_out_section(book, subject, comparisons, results),
        *data_sections(plan.scenarios),
        score_section(subject),
        *([Section("What the data determine", [*determined, *words])] if determined or words else []),
        model_section(choice, plan.scenarios[0]),
        search_section(book, subject),
        *([sizes_section(book, subject, sizes)] if sizes else []),
        *run_sections(book, subject, comparisons[0]),
        lines_section(choice, plan.scenarios[0], file),
        facts_section(subject, nis),
    ]
    return Pages(
        subject,
        title,
        advice(choice, plan, comparisons, subject.validation),
        sections,
        [*sum(results, []), *determined, *identified],
        comparisons,
    )


def data_sections(problems: Sequence[Problem]) -> list[Section]:
    """A section with remarks on the data, if there are any."""
    remarks = [remark for problem in problems for remark in problem.remarks]
    return [Section("The data", [Words(remarks)])] if remarks else []


def _short(name: str) -> str:
    """A problem's name in a title: for a file only its name."""
    return Path(name).stem if name.endswith(".toml") else name


# The report of two studies: their results, section by section and side by side.


class Source(NamedTuple):
    """One side of a page: a tuned file or a study, and its location."""

    name: str | Path  # a tuned file, or the name of a study
    storage: str  # where the study is
    problems: Sequence[Problem] = ()  # what it is of, where that is code
    file: str | None = None  # what the page calls the tuned file, as in `write_report`


def write_two_studies(sources: Sequence[Source], out: str | Path | None = None) -> Report:
    """Write a page, A-beside-B.html, and its tables, A-beside-B.md, on two tuned files or studies.

    If both are of the same problem, a table has the ratio of their scores, paired on the same held-out seeds.

    Args:
        sources: two tuned files or studies.
        out: folder of the two files, by default that of the first tuned file, or `out`.

    Raises:
        ValueError: as `write_report`, or if these are not two.
    """
    if len(sources) != 2:
        raise ValueError(f"a side-by-side report must be of two studies, but got {len(sources)}")
    subjects = [find_subject(source.name, source.storage, source.problems) for source in sources]
    names = [
        Path(source.name).stem if is_file(source.name) else subject.name
        for source, subject in zip(sources, subjects, strict=True)
    ]
    names = (
        names if names[0] != names[1] else [f"{name} ({which})" for name, which in zip(names, "12", strict=True)]
    )
    page, tables = report_files(sources[0].name, "-beside-".join(names), out)
    pages = [
        pages_of(source.name, subject, prefix, source.file)
        for source, subject, prefix in zip(sources, subjects, "ab", strict=True)
    ]
    title = " beside ".join(names)
    advice = [f"{name}: {contents.advice}" for name, contents in zip(names, pages, strict=True)]
    table, remark = _summary(names, pages)
    sections = [Section("Side by side", [table, *([Words([remark])] if remark else [])]), *_paired(names, pages)]
    write_whole(page, html_page(title, advice, sections, two_columns=True))
    every = [table, *pages[0].results, *pages[1].results]
    write_whole(tables, markdown_page(title, [*advice, *every]))
    return Report(page, tables, "\n".join(advice))


def _paired(names: Sequence[str], pages: Sequence[Pages]) -> list[Section]:
    """Sections of both, those of the same title beside each other."""
    first, second = ({section.title: section.parts for section in page.sections} for page in pages)
    sections = []
    for title in [*first, *(title for title in second if title not in first)]:
        rows: Iterable[Any] = zip_longest(first.get(title, []), second.get(title, []))
        sections.append(Section(title, [Pair(names, row) for row in rows]))
    return sections


def _summary(names: Sequence[str], pages: Sequence[Pages]) -> tuple[Table, str]:
    """Held-out metrics of both tuned filters, and the paired ratio if the problem is the same."""
    choices = [page.subject.choice for page in pages]
    tuned = [page.comparisons[0].tuned for page in pages]
    rows = [
        ["filter", *(choice.name for choice in choices)],
        ["problem", *(page.subject.plan.scenarios[0].name for page in pages)],
    ]
    labels = dict.fromkeys(state.label for evaluation in tuned for state in evaluation.states)
    by_state = [
        {state.label: rmse for state, rmse in zip(evaluation.states, evaluation.rmse, strict=True)}
        for evaluation in tuned
    ]
    rows += [[f"RMSE {label}", *(_value(rmse.get(label)) for rmse in by_state)] for label in labels]
    rows += [
        ["score", *(_value(evaluation.score) for evaluation in tuned)],
        ["mean NEES", *(_value(evaluation.nees) for evaluation in tuned)],
        ["mean NIS", *(_value(evaluation.nis) for evaluation in tuned)],
        ["log-likelihood of a run", *(_value(Interval(*[evaluation.log_likelihood] * 3)) for evaluation in tuned)],
    ]
    rows = [row for row in rows if any(row[1:])]
    return Table("On held-out data, with 95 % intervals", ["", *names], rows), _ratio(names, pages)


def _ratio(names: Sequence[str], pages: Sequence[Pages]) -> str:
    """The ratio of both scores, or the difference of likelihoods, paired; empty where problems differ."""
    problems = [page.subject.plan.scenarios[0] for page in pages]
    seeds = [page.comparisons[0].seeds for page in pages]
    if problems[0].digest != problems[1].digest or seeds[0] != seeds[1]:
        return "The two have different problems or held-out data, so their scores are not paired."
    data = problems[0].data(seeds[0])
    a, b = (evaluate(page.subject.choice.filter(problems[0]), data, problems[0].scale) for page in pages)
    if a.has_truth:
        ratio = score_ratio(a, b)
        return f"Score of {names[0]} over that of {names[1]}, paired by run: {_value(ratio)}."
    gain = likelihood_gain(a, b)
    return f"Log-likelihood of a run of {names[0]} less that of {names[1]}, paired by run: {_value(gain)}."


def _value(interval: Interval | None) -> str:
    """A value with its interval; empty where there is none."""
    if interval is None or not isfinite(interval.value):
        return ""
    if interval.low == interval.high:
        return rounded(interval.value)
    return f"{rounded(interval.value)} [{rounded(interval.low)}, {rounded(interval.high)}]"
