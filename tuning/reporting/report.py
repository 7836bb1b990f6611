"""The report of a tuning: one page with all results, its tables as Markdown, and the report of two studies."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import zip_longest
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from filters.consistency.intervals import Interval
from filters.consistency.report import rounded
from filters.registry import filter_type
from thruster_env.core.files import check_target, write_whole
from tuning.evaluation.evaluate import evaluate, likelihood_gain, score_ratio
from tuning.evaluation.held_out import Comparison, evaluate_held_out, stored_comparison, stored_sizes
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
from tuning.reporting.tables import errors_table, known_table, numbers_table
from tuning.search.objectives import nis_ratio
from tuning.search.plan import at_ends
from tuning.search.trials import measure


class Report(NamedTuple):
    """The files written, and a summary sentence per study."""

    page: Path
    tables: Path
    advice: str


class Pages(NamedTuple):
    """All results of one study, ready for a page."""

    subject: Subject
    title: str
    advice: str
    sections: list[Section]
    tables: list[Table]  # of errors and parameters
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
    write_whole(tables, markdown_page(contents.title, contents.advice, contents.tables))
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
    numbers = [
        numbers_table(choice, plan.scenarios[0], plan.seed, comparisons[0].default),
        *([known_table(known)] if known else []),
    ]
    book = Sketchbook(prefix)
    sections = [
        held_out_section(book, subject, comparisons),
        *data_sections(plan.scenarios),
        score_section(subject),
        Section("The parameters", [*numbers, *([Words(identified)] if identified else [])]),
        model_section(choice, plan.scenarios[0]),
        search_section(book, subject),
        *([sizes_section(book, subject, sizes)] if sizes else []),
        *run_sections(book, subject, comparisons[0]),
        lines_section(choice, plan.scenarios[0], file),
        facts_section(subject, nis),
    ]
    errors = [
        errors_table(scenario, comparison)
        for scenario, comparison in zip(plan.scenarios, comparisons, strict=True)
    ]
    return Pages(
        subject,
        title,
        advice(choice, plan, comparisons, subject.validation),
        sections,
        [*errors, *numbers],
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
    every = [table, *pages[0].tables, *pages[1].tables]
    write_whole(tables, markdown_page(title, "\n".join(advice), every))
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
