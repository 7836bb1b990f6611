"""Tables and sentences on a panel: scores over those of each baseline, and where tuning lost."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from typing import NamedTuple

from filters.consistency.intervals import slightly
from thruster_env.core.text_tables import markdown_table
from tuning.evaluation.baselines import ORACLE
from tuning.experiments.users.runs import Case, Paired
from tuning.experiments.users.significance import LEVEL, holm

MARK = "!"  # of a ratio that is significantly above 1
FIRST = ("given", "scaled default", "rule of thumb", "noise estimation")  # the order of columns; others follow
TAIL = 0.025  # of a 95 % interval on one side


class Loss(NamedTuple):
    """A tuned filter that is significantly worse than a baseline."""

    case: Case
    baseline: str
    paired: Paired


class Verdict(NamedTuple):
    """What all comparisons of a panel but those with the oracle say together."""

    comparisons: int  # of filters that are not the same
    losses: tuple[Loss, ...]  # significant over all comparisons together, by Holm's procedure
    above: int  # comparisons whose 95 % interval lies above 1
    wins: int  # comparisons whose 95 % interval lies below 1

    @property
    def by_chance(self) -> float:
        """Intervals that chance would put above 1 if no tuned filter were better or worse than a baseline."""
        return TAIL * self.comparisons


def verdict_of(cases: Sequence[Case]) -> Verdict:
    """Which tuned filters are significantly worse than a baseline; the oracle's is no baseline that one has."""
    pairs = [
        Loss(case, name, paired) for case in cases for name, paired in case.baselines.items() if name != ORACLE
    ]
    other = [pair for pair in pairs if not pair.paired.ratio.low == pair.paired.ratio.high == 1.0]
    worse = holm([pair.paired.chance for pair in other])
    losses = tuple(pair for pair, is_worse in zip(other, worse, strict=True) if is_worse)
    above = sum(pair.paired.ratio.low > 1.0 for pair in other)
    return Verdict(len(other), losses, above, sum(pair.paired.ratio.high < 1.0 for pair in other))


def baselines_of(cases: Sequence[Case]) -> list[str]:
    """The names of all baselines of some cases, in the order of columns."""
    names = dict.fromkeys(name for case in cases for name in case.baselines)
    return sorted(names, key=lambda name: FIRST.index(name) if name in FIRST else len(FIRST) + (name == ORACLE))


def header(cases: Sequence[Case]) -> list[str]:
    """The heads of columns."""
    return ["problem", "filter", *(f"over {name}" for name in baselines_of(cases)), "NIS", "chosen"]


def rows_of(cases: Sequence[Case]) -> list[list[str]]:
    """A row a case: ratios to each baseline with 95 % intervals, mean NIS, and what the study chose."""
    lost = {(loss.case.problem, loss.case.filter, loss.baseline) for loss in verdict_of(cases).losses}
    names, rows, before = baselines_of(cases), [], ""
    for case in cases:
        cells = [
            _ratio(case.baselines.get(name), (case.problem, case.filter, name) in lost) if not case.error else ""
            for name in names
        ]
        ended = _ended(case)
        nis = "" if math.isnan(case.nis) else f"{case.nis:.2f}"
        rows.append([case.problem if case.problem != before else "", case.filter, *cells, nis, ended])
        before = case.problem
    return rows


def markdown(cases: Sequence[Case]) -> str:
    """The table of a page."""
    rows = [[f"`{row[0]}`" if row[0] else "", f"`{row[1]}`", *row[2:]] for row in rows_of(cases)]
    return markdown_table(header(cases), rows)


def sentences(cases: Sequence[Case]) -> list[str]:
    """What the table says, in words."""
    verdict, failed = verdict_of(cases), [case for case in cases if case.error]
    lines = [
        f"The tuned filter is significantly worse than a baseline in {len(verdict.losses)} of "
        f"{verdict.comparisons} comparisons (Holm's procedure, {100 * LEVEL:g} % for all together, without the "
        f"oracle), and better in {verdict.wins}, by the 95 % interval of each.",
        f"95 % intervals that lie above 1: {verdict.above}; with equally good filters and baselines one would "
        f"expect {verdict.by_chance:.1f} by chance.",
    ]
    for loss in verdict.losses:
        ratio = loss.paired.ratio
        small = slightly(ratio)
        lines.append(
            f"{loss.case.problem}, {loss.case.filter}: {ratio.value:.3f} [{ratio.low:.3f}, {ratio.high:.3f}] "
            f"times the score of {_article(loss.baseline)}"
            + (f", {small}, which is practically none." if small else ".")
        )
    return lines + [f"{case.problem}, {case.filter} failed: {case.error}" for case in failed]


def csv_text(cases: Sequence[Case]) -> str:
    """A row a comparison, with a header."""
    lost = {(loss.case.problem, loss.case.filter, loss.baseline) for loss in verdict_of(cases).losses}
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    heads = "problem", "filter", "baseline", "ratio", "low", "high", "chance_if_no_worse", "significantly_worse"
    writer.writerow([*heads, "score", "nis", "restarts", "chosen", "seconds"])
    for case in cases:
        ended = _ended(case)
        of_case = f"{case.score:.6g}", f"{case.nis:.4g}", case.restarts, ended, f"{case.seconds:.1f}"
        for name, paired in case.baselines.items():
            worse = (case.problem, case.filter, name) in lost
            ratio = [f"{value:.6g}" for value in paired.ratio]
            writer.writerow([case.problem, case.filter, name, *ratio, f"{paired.chance:.3g}", worse, *of_case])
    return text.getvalue()


def _ended(case: Case) -> str:
    """What the study wrote: its best trial, or the baseline to which that gave way."""
    return "failed" if case.error else case.gave_way or "a trial"


def _article(baseline: str) -> str:
    return "what was given" if baseline == "given" else f"the {baseline}"


def _ratio(paired: Paired | None, is_worse: bool) -> str:
    if paired is None:
        return "none"
    value, low, high = paired.ratio
    if low == high == 1.0:
        return "1, the same"
    return f"{value:.3f} [{low:.3f}, {high:.3f}]" + f" {MARK}" * is_worse
