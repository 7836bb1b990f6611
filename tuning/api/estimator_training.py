"""`EstimatorTraining`: a trained estimator beside the filters that it has to beat, on held-out runs."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.table import Table

from filters.consistency.intervals import Interval
from filters.filter import Filter
from filters.logs.findings import colour_of
from thruster_env.core.files import panels
from thruster_env.core.text_tables import plain_text, table, verbatim
from tuning.api.display import about, drawn, frame, html, number
from tuning.evaluation.baselines import ORACLE
from tuning.learning.training import HELD_OUT, LONGER, NOISIER, Check, Standing
from tuning.problems.problem import Problem
from tuning.reporting.page import Table as PageTable
from tuning.reporting.training_report import write_training_report

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

COLUMNS = "filter", "score", "over {first}", LONGER, NOISIER, "NEES"


@dataclass(frozen=True, eq=False, repr=False)
class EstimatorTraining:
    """A training and its result.

    Attributes:
        kind: of the estimator.
        problem: on whose runs it was trained.
        file: where the trained estimator is.
        checks: scores of validation runs during the training.
        standings: on held-out runs; the trained estimator comes last, the others are compared with the first.
        seconds: that the training took.
        filters: the same by label.
        seed: of the study to which all runs belong.
        interrupted: whether Ctrl-C ended it; the file has the best weights so far.
    """

    kind: str
    problem: Problem
    file: Path
    checks: tuple[Check, ...]
    standings: tuple[Standing, ...]
    seconds: float
    filters: Mapping[str, Filter]
    seed: int = 0
    interrupted: bool = False

    @property
    def ratio(self) -> Interval:
        """The trained estimator's score over that of the best other filter, paired on held-out runs."""
        return self.standings[-1].ratio(self.best_other)

    @property
    def best_other(self) -> Standing:
        """The filter with the lowest held-out score, without the oracle, which knows the plant's Q and R."""
        candidates = (standing for standing in self.standings[:-1] if not standing.label.endswith(f" {ORACLE}"))
        return min(candidates, key=lambda standing: standing.evaluations[HELD_OUT].score.value)

    def sentences(self) -> list[str]:
        """Whether training paid."""
        ratio, other = self.ratio, self.best_other.label
        sentence = f"{self.kind} has {about(ratio)} of the score of {other}"
        if ratio.low > 1.0:
            verdict = f"{sentence}: it is significantly worse. Take {other}."
        elif ratio.high < 1.0:
            verdict = f"{sentence}: it is significantly better."
        else:
            verdict = f"{sentence}: no significant difference. {other} is cheaper."
        stopped = ["Interrupted: these are the best weights so far."] if self.interrupted else []
        return [verdict, *stopped]

    def rows(self) -> list[list[str]]:
        """Cells of the table, by `COLUMNS`."""
        first, rows = self.standings[0], []
        for standing in self.standings:
            ratios = (standing.ratio(first, name) for name in (HELD_OUT, LONGER, NOISIER))
            cells = [
                "" if standing is first else "-" if np.isnan(ratio.value) else about(ratio) for ratio in ratios
            ]
            evaluation = standing.evaluations[HELD_OUT]
            rows.append(
                [standing.label, number(evaluation.score.value), *cells, number(evaluation.nees.value, ".3g")]
            )
        return rows

    def columns(self) -> list[str]:
        """Heads of the table."""
        return [column.format(first=self.standings[0].label) for column in COLUMNS]

    @property
    def title(self) -> str:
        """Of the table."""
        count = len(self.standings[0].evaluations[HELD_OUT].mean_squares)
        return f"{count} held-out {self.problem.seed_word} of {self.problem.name}"

    def table(self) -> Table:
        """The table for a terminal."""
        caption = f"{LONGER}, {NOISIER}: score over {self.standings[0].label} on such runs."
        return table(self.title, self.columns(), self.rows(), caption=caption)

    def as_data(self) -> dict[str, Any]:
        """The same as plain data, for JSON."""
        first = self.standings[0]
        rows = []
        for standing in self.standings:
            row: dict[str, Any] = {"filter": standing.label, "nees": standing.evaluations[HELD_OUT].nees.value}
            for name, evaluation in standing.evaluations.items():
                row[name] = {"score": evaluation.score.value, "ratio": standing.ratio(first, name)._asdict()}
            rows.append(row)
        return {
            "kind": self.kind,
            "problem": self.problem.name,
            "file": str(self.file),
            "checks": [check._asdict() for check in self.checks],
            "standings": rows,
            "seconds": self.seconds,
            "interrupted": self.interrupted,
        }

    def to_frame(self) -> pandas.DataFrame:
        """A row for each filter: scores on held-out, longer and noisier runs, with their ratios to the first."""
        rows = []
        for standing in self.as_data()["standings"]:
            row = {"filter": standing["filter"], "NEES": standing["nees"]}
            for name in (HELD_OUT, LONGER, NOISIER):
                result = standing.get(
                    name, {"score": np.nan, "ratio": {"value": np.nan, "low": np.nan, "high": np.nan}}
                )
                row[name] = result["score"]
                row |= {f"{name}, ratio {key}": value for key, value in result["ratio"].items()}
            rows.append(row)
        return frame({name: [row[name] for row in rows] for name in rows[0]})

    def plot_training(self) -> Figure:
        """Validation score over updates, beside the held-out score of the first filter."""
        figure, (axis,) = panels(1, 1, (6.0, 3.6))
        steps, scores = [check.step for check in self.checks], [check.score for check in self.checks]
        axis.plot(steps, scores, "o-", color=colour_of(self.kind), label=f"{self.kind}, validation")
        first = self.standings[0]
        level = first.evaluations[HELD_OUT].score.value
        axis.axhline(level, color=colour_of(first.name), linestyle="--", label=f"{first.label}, held out")
        axis.set_xlabel("updates of the weights")
        axis.set_ylabel("score: mean RMSE over scale [-]")
        axis.set_title(verbatim(self.problem.name), fontsize=11)
        axis.legend()
        return drawn(figure)

    def report(self, page: str | Path) -> Path:
        """Write a page, an .html file, with the table, the course of the training and one held-out run."""
        if Path(page).suffix != ".html":
            raise ValueError(f"a page must be a file that ends in .html, but got {page}")
        labels = self.standings[0].label, self.standings[-1].label
        pair = {name: self.filters[name] for name in labels}
        page_table = PageTable(self.title, self.columns(), self.rows())
        title, seed = f"{self.kind} trained on {self.problem.name}", self.problem.held_out_seeds(self.seed, 2)[0]
        course, advice = self.plot_training(), self.sentences()
        return write_training_report(page, title, advice, page_table, course, pair, self.problem, seed)

    def __str__(self) -> str:
        """The table that `thruster train-estimator` prints."""
        return plain_text([self.table(), *self.sentences()])

    def __repr__(self) -> str:
        return f"EstimatorTraining({self.kind} on {self.problem.name}, {self.file})"

    def _repr_html_(self) -> str:
        return html(self.title, self.columns(), self.rows(), " ".join(self.sentences()))
