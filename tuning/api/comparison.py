"""`FilterComparison`: filters on the same held-out seeds, as a value."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from html import escape
from typing import TYPE_CHECKING, Any

import numpy as np

from filters.consistency.intervals import Interval, slightly
from filters.logs.figure import colour_of
from thruster_env.core.plots import panels
from thruster_env.core.text_tables import TITLE, plain_text, verbatim
from tuning.api.held_out import cells_of
from tuning.api.showing import about, drawn, frame, html, number
from tuning.evaluation.compare import Leaderboard, Row, winners
from tuning.evaluation.evaluate import restart_sentences
from tuning.evaluation.knowledge import noise_sentence
from tuning.problems.problem import Problem
from tuning.reporting.leaderboard import report

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

INTERRUPTED = "Interrupted: these are the rows that were done."


@dataclass(frozen=True, eq=False, repr=False)
class FilterComparison:
    """Filters on one problem or several, in the order in which they were given.

    Attributes:
        boards: a `Leaderboard` for each problem: seeds, bound and rows.
        seed: of the study to which the held-out seeds belong.
        interrupted: whether Ctrl-C ended it; the rows are the finished ones.
        left_out: by label, why a filter could not run.
    """

    boards: tuple[Leaderboard, ...]
    seed: int = 0
    interrupted: bool = False
    left_out: Mapping[str, str] = field(default_factory=dict)

    @property
    def problems(self) -> tuple[Problem, ...]:
        """The problems."""
        return tuple(board.scenario for board in self.boards)

    @property
    def filters(self) -> tuple[str, ...]:
        """Labels of the filters; the others are compared with the first."""
        return tuple(row.label for row in self.boards[0].rows)

    def ranked(self, problem: int = 0) -> list[str]:
        """Labels of the filters on a problem, by its index, the best one (without truth the likeliest) first."""
        return [row.label for row in sorted(self.boards[problem].rows, key=_rank)]

    def sentences(self) -> list[str]:
        """The filters that are significantly better or worse than the first one on each problem, and restarts."""
        found = []
        for board in self.boards:
            found += [winners(board), *restart_sentences({row.label: row.evaluation for row in board.rows})]
        return found

    def to_frame(self) -> pandas.DataFrame:
        """A row for each filter and problem: errors, score and its ratio to the first filter's, consistency, cost.

        Raises:
            ValueError: if pandas is not installed.
        """
        pairs = [(board, row) for board in self.boards for row in board.rows]
        columns: dict[str, list] = {"problem": [board.scenario.name for board, _ in pairs]}
        columns["filter"] = [row.label for _, row in pairs]
        cells: list[dict[str, Any]] = []
        for board, row in pairs:
            ratio, gain = row.score_ratio, row.likelihood_gain
            cells.append(cells_of(row.evaluation))
            cells[-1] |= {"score over first": ratio.value, "score over first low": ratio.low}
            cells[-1] |= {"score over first high": ratio.high, "log-likelihood less first": gain.value}
            cells[-1] |= {"median NEES": row.evaluation.median_nees, "us/step": row.microseconds}
            cells[-1] |= {
                "verdict": "" if row is board.rows[0] else row.verdict
            }  # the first is compared with itself
        for name in dict.fromkeys(name for one in cells for name in one):
            columns[name] = [one.get(name, np.nan) for one in cells]
        return frame(columns)

    def plot_scores(self) -> Figure:
        """Score of each filter with 95 % interval, a panel per problem; without truth the log-likelihood gained.

        Hollow points do not differ significantly from the first.
        """
        count = max(len(board.rows) for board in self.boards)
        figure, axes = panels(len(self.boards), 3, (5.2, 0.9 + 0.38 * count), extra=0.3)
        for axis, board in zip(axes, self.boards, strict=True):
            _draw(axis, board)
        return drawn(figure)

    def __repr__(self) -> str:
        said = []
        for board in self.boards:
            found = [f"{row.label} {_figure(row)}" for row in sorted(board.rows, key=_rank)]
            said.append(f"{board.scenario.name}: {', '.join(found)}")
        ended = ", interrupted" if self.interrupted else ""
        return f"FilterComparison({'; '.join(said)}{ended})"

    def __str__(self) -> str:
        """The tables that `thruster compare` prints."""
        ended = [*left_out_lines(self.left_out), *([INTERRUPTED] if self.interrupted else [])]
        return plain_text([*(part for board in self.boards for part in report(board)), *ended])

    def _repr_html_(self) -> str:
        parts = []
        for board in self.boards:
            truth = board.rows[0].evaluation.has_truth
            heads = ["filter", "score", "over the first"] if truth else ["filter", "log L", "less the first's"]
            rows = []
            for row in board.rows:
                one = row.evaluation
                found = [about(one.score), about(row.score_ratio)]
                if not truth:
                    found = [number(one.log_likelihood, ".2f"), about(row.likelihood_gain, 2)]
                last = [number(one.nees.value, ".3g"), number(one.nis.value, ".3g"), f"{row.microseconds:.3g}"]
                first = row is board.rows[0]  # which is compared with itself
                rows.append(
                    [row.label, found[0], "" if first else found[1], *last, "" if first else _verdict(row)]
                )
            heads += ["NEES", "NIS", "us/step", "verdict"]
            title = f"{len(board.seeds)} held-out {board.scenario.seed_word} of {board.scenario.name}"
            parts.append(html(title, heads, rows, f"{noise_sentence(board.rows)} {winners(board)}".strip()))
        return "".join(parts) + "".join(f"<p>{escape(line)}</p>" for line in left_out_lines(self.left_out))


def left_out_lines(left_out: Mapping[str, str]) -> list[str]:
    """A line for each filter that could not run, and why."""
    return [f"{label} is left out: {why}" for label, why in left_out.items()]


def _rank(row: Row) -> float:
    value = row.evaluation.score.value if row.evaluation.has_truth else -row.evaluation.log_likelihood
    return np.inf if np.isnan(value) else value


def _figure(row: Row) -> str:
    one = row.evaluation
    return number(one.score.value if one.has_truth else one.log_likelihood)


def _verdict(row: Row) -> str:
    slight = slightly(row.score_ratio)
    return f"{row.verdict} by {slight}" if slight else row.verdict


def _draw(axis: Any, board: Leaderboard) -> None:
    truth = board.rows[0].evaluation.has_truth
    for place, row in enumerate(board.rows):
        value: Interval = row.evaluation.score if truth else row.likelihood_gain
        if np.isnan(value.value):
            continue
        colour = colour_of(row.filter_name)
        face = "white" if row.verdict == "tie" and place else colour
        axis.plot([value.low, value.high], [-place, -place], "|-", color=colour, linewidth=1.4)
        axis.plot(value.value, -place, "o", color=colour, markerfacecolor=face, markersize=6)
    axis.set_yticks([-place for place in range(len(board.rows))], [verbatim(row.label) for row in board.rows])
    axis.set_ylim(0.6 - len(board.rows), 0.6)
    axis.grid(axis="y", visible=False)
    gained = f"log L of a run less that of {verbatim(board.rows[0].label)}"
    axis.set_xlabel("score: mean RMSE over scale [-]" if truth else gained)
    axis.set_title(verbatim(board.scenario.name, most=TITLE), fontsize=11)
