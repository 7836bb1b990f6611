"""The report of two studies: their results, section by section and side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import zip_longest
from math import isfinite
from pathlib import Path
from typing import Any, NamedTuple

from filters.consistency.intervals import Interval
from filters.consistency.verdicts import rounded
from thruster_env.core.files import write_whole
from tuning.evaluation.evaluate import evaluate, likelihood_gain, score_ratio
from tuning.problems.problem import Problem
from tuning.reporting.page import Pair, Section, Table, Words, html_page, markdown_page
from tuning.reporting.report import Pages, Report, pages_of, report_files
from tuning.reporting.subject import find_subject, is_file


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
    subjects = [find_subject(one.name, one.storage, one.problems) for one in sources]
    names = [
        Path(one.name).stem if is_file(one.name) else subject.name
        for one, subject in zip(sources, subjects, strict=True)
    ]
    names = (
        names if names[0] != names[1] else [f"{name} ({which})" for name, which in zip(names, "12", strict=True)]
    )
    page, tables = report_files(sources[0].name, "-beside-".join(names), out)
    found = [
        pages_of(one.name, subject, prefix, one.file)
        for one, subject, prefix in zip(sources, subjects, "ab", strict=True)
    ]
    title = " beside ".join(names)
    told = [f"{name}: {one.advice}" for name, one in zip(names, found, strict=True)]
    table, said = _summary(names, found)
    sections = [Section("Side by side", [table, *([Words([said])] if said else [])]), *_paired(names, found)]
    write_whole(page, html_page(title, told, sections, two_columns=True))
    every = [table, *found[0].tables, *found[1].tables]
    write_whole(tables, markdown_page(title, "\n".join(told), every))
    return Report(page, tables, "\n".join(told))


def _paired(names: Sequence[str], found: Sequence[Pages]) -> list[Section]:
    """Sections of both, those of the same title beside each other."""
    first, second = ({section.title: section.parts for section in one.sections} for one in found)
    sections = []
    for title in [*first, *(title for title in second if title not in first)]:
        rows: Iterable[Any] = zip_longest(first.get(title, []), second.get(title, []))
        sections.append(Section(title, [Pair(names, row) for row in rows]))
    return sections


def _summary(names: Sequence[str], found: Sequence[Pages]) -> tuple[Table, str]:
    """Held-out metrics of both tuned filters, and the paired ratio if the problem is the same."""
    choices = [one.subject.choice for one in found]
    tuned = [one.comparisons[0].tuned for one in found]
    rows = [
        ["filter", *(choice.name for choice in choices)],
        ["problem", *(one.subject.plan.scenarios[0].name for one in found)],
    ]
    labels = dict.fromkeys(state.label for evaluation in tuned for state in evaluation.states)
    by_state = [{state.label: rmse for state, rmse in zip(one.states, one.rmse, strict=True)} for one in tuned]
    rows += [[f"RMSE {label}", *(_value(one.get(label)) for one in by_state)] for label in labels]
    rows += [
        ["score", *(_value(one.score) for one in tuned)],
        ["mean NEES", *(_value(one.nees) for one in tuned)],
        ["mean NIS", *(_value(one.nis) for one in tuned)],
        ["log-likelihood of a run", *(_value(Interval(*[one.log_likelihood] * 3)) for one in tuned)],
    ]
    rows = [row for row in rows if any(row[1:])]
    return Table("On held-out data, with 95 % intervals", ["", *names], rows), _ratio(names, found)


def _ratio(names: Sequence[str], found: Sequence[Pages]) -> str:
    """The ratio of both scores, or the difference of likelihoods, paired; empty where problems differ."""
    problems = [one.subject.plan.scenarios[0] for one in found]
    seeds = [one.comparisons[0].seeds for one in found]
    if problems[0].digest != problems[1].digest or seeds[0] != seeds[1]:
        return "The two have different problems or held-out data, so their scores are not paired."
    data = problems[0].data(seeds[0])
    a, b = (evaluate(one.subject.choice.filter(problems[0]), data, problems[0].scale) for one in found)
    if a.has_truth:
        ratio = score_ratio(a, b)
        return f"Score of {names[0]} over that of {names[1]}, paired by run: {_value(ratio)}."
    gain = likelihood_gain(a, b)
    return f"Log-likelihood of a run of {names[0]} less that of {names[1]}, paired by run: {_value(gain)}."


def _value(found: Interval | None) -> str:
    """A value with its interval; empty where there is none."""
    if found is None or not isfinite(found.value):
        return ""
    if found.low == found.high:
        return rounded(found.value)
    return f"{rounded(found.value)} [{rounded(found.low)}, {rounded(found.high)}]"
