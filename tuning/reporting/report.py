"""The report of a tuning: one page with all results, and its tables as Markdown."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from filters.registry import filter_type
from thruster_env.core.files import check_target, write_whole
from tuning.evaluation.held_out import Comparison, evaluate_held_out
from tuning.evaluation.sizes import SizeRow, ensemble_sizes, sufficient_size
from tuning.evaluation.stored import stored_comparison, stored_sizes
from tuning.likelihood.identifiability import identify, sentences, too_many
from tuning.problems.problem import Problem
from tuning.reporting.facts_parts import facts_section, model_section, score_section
from tuning.reporting.lines_parts import lines_section
from tuning.reporting.page import Section, Table, Words, html_page, markdown_page
from tuning.reporting.parts import advice, held_out_section, search_section, sizes_section
from tuning.reporting.run_parts import run_sections
from tuning.reporting.sketchbook import Sketchbook
from tuning.reporting.subject import Subject, find_subject, is_file
from tuning.reporting.tables import errors_table, known_table, numbers_table
from tuning.search.objectives import nis_ratio
from tuning.search.ranges import at_ends
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
    found = pages_of(source, subject, file=file)
    write_whole(page, html_page(found.title, found.advice, found.sections))
    write_whole(tables, markdown_page(found.title, found.advice, found.tables))
    return Report(page, tables, found.advice)


def report_files(source: str | Path, name: str, out: str | Path | None) -> tuple[Path, Path]:
    """Page and tables of a name, in `out` or beside the tuned file; ValueError if they cannot be written."""
    folder = Path(out) if out is not None else Path(source).parent if is_file(source) else Path("out")
    found = folder / f"{name}.html", folder / f"{name}.md"
    for target in found:
        check_target(target)
    return found


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
    kept = [stored_comparison(subject.content, choice, scenario) for scenario in plan.scenarios]
    comparisons = [
        evaluate_held_out(choice, scenario, plan.seed, subject.seeds) if comparison is None else comparison
        for comparison, scenario in zip(kept, plan.scenarios, strict=True)
    ]
    title = f"{choice.name} tuned on {', '.join(_short(scenario.name) for scenario in plan.scenarios)}"
    known = identify(choice, plan.scenarios, data, plan.space())
    identified = at_ends(choice, plan)
    identified += sentences(known) if known else too_many(choice, plan.space())
    nis = subject.nis or [nis_ratio(found) for found in measure(choice, plan, data)]
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
    said = [one for problem in problems for one in problem.remarks]
    return [Section("The data", [Words(said)])] if said else []


def _short(name: str) -> str:
    """A problem's name in a title: for a file only its name."""
    return Path(name).stem if name.endswith(".toml") else name
