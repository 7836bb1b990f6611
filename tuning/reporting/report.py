"""The report of a tuning: one page with all that is known of it, and its tables as Markdown."""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from numerics.files import check_target, write_whole
from tuning.evaluation.held_out import prove
from tuning.evaluation.kept import kept_comparison, kept_sizes
from tuning.evaluation.sizes import ensemble_sizes, sufficient_size
from tuning.likelihood.identifiability import identify, sentences, too_many
from tuning.problems.problem import Problem
from tuning.reporting.page import Section, Words, html_page, markdown_page
from tuning.reporting.parts import (
    Sketchbook,
    advice,
    facts_section,
    held_out_section,
    run_sections,
    search_section,
    sizes_section,
)
from tuning.reporting.subject import find_subject, is_file
from tuning.reporting.tables import errors_table, known_table, numbers_table
from tuning.search.objectives import nis_ratio
from tuning.search.space import has_ensemble
from tuning.search.trials import measure


class Report(NamedTuple):
    """What was written, and the sentence that sums it up."""

    page: Path
    tables: Path
    advice: str


def write_report(
    source: str | Path, storage: str, out: str | Path | None = None, problems: Sequence[Problem] = ()
) -> Report:
    """Write a page, NAME.html, and its tables, NAME.md, on a tuned file or a study.

    Held-out metrics and the table of ensemble sizes are those that the file or the study keeps, where they were
    made of the same problems by the same versions of packages; else they are computed anew. `verify` always does.

    Args:
        source: a tuned file, or the name of a study.
        storage: where the study is; without it a page on a tuned file leaves the search out.
        out: folder of the two files, by default that of the tuned file, or `out`.
        problems: what it is of, where that is code: nothing that a file or a study names is imported.

    Raises:
        ValueError: if the tuned file is refused, there is no such study, or the folder cannot be written.
    """
    subject = find_subject(source, storage, problems)
    plan, choice = subject.plan, subject.choice
    folder = Path(out) if out is not None else Path(source).parent if is_file(source) else Path("out")
    name = Path(source).stem if is_file(source) else subject.name
    page, tables = folder / f"{name}.html", folder / f"{name}.md"
    for target in (page, tables):
        check_target(target)
    data = plan.training_data()
    sizes = []
    if has_ensemble(choice.name):
        sizes = kept_sizes(subject.sizes, choice, plan)
        sizes = ensemble_sizes(choice, plan, data, subject.consistent) if sizes is None else sizes
    if sizes and not subject.chosen:
        choice = choice.with_size(sufficient_size(sizes, subject.consistent))
        subject = subject._replace(choice=choice)
    kept = [kept_comparison(subject.content, choice, scenario) for scenario in plan.scenarios]
    proofs = [
        prove(choice, scenario, plan.seed, subject.seeds) if proof is None else proof
        for proof, scenario in zip(kept, plan.scenarios, strict=True)
    ]
    title = f"{choice.name} tuned on {', '.join(_short(scenario.name) for scenario in plan.scenarios)}"
    said = advice(choice, plan, proofs)
    known = identify(choice, plan.scenarios, data, plan.space())
    identified = sentences(known) if known else too_many(choice, plan.space())
    nis = subject.nis or [nis_ratio(found) for found in measure(choice, plan, data)]
    numbers = [
        numbers_table(choice, plan.scenarios[0], plan.seed, proofs[0].default),
        *([known_table(known)] if known else []),
    ]
    with tempfile.TemporaryDirectory() as scratch:
        book = Sketchbook(Path(scratch))
        sections = [
            held_out_section(book, subject, proofs),
            Section("The numbers", [*numbers, *([Words(identified)] if identified else [])]),
            search_section(book, subject),
            *([sizes_section(book, subject, sizes)] if sizes else []),
            *run_sections(book, subject, proofs[0]),
            facts_section(subject, nis),
        ]
    write_whole(page, html_page(title, said, sections))
    errors = [errors_table(scenario, proof) for scenario, proof in zip(plan.scenarios, proofs, strict=True)]
    write_whole(tables, markdown_page(title, said, [*errors, *numbers]))
    return Report(page, tables, said)


def _short(name: str) -> str:
    """A problem's name in a title: of a file its own name alone."""
    return Path(name).stem if name.endswith(".toml") else name
