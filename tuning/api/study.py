"""`Study`: the result of a tuning, as a value that can be shown, saved and used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from optuna.trial import FrozenTrial, TrialState

from filters.estimators.find import label_of
from filters.filter import Filter
from filters.monitoring.monitor import Monitor
from thruster_env.core.text_tables import plain_text
from tuning.api.held_out import HeldOut
from tuning.api.run import Tuning
from tuning.api.showing import about, drawn, frame, html, number
from tuning.evaluation.tuned import check_keepable
from tuning.evaluation.worth import worth
from tuning.problems.problem import Problem, score_label
from tuning.search.objectives import reported, reported_name
from tuning.search.outcome import is_consistent
from tuning.search.space import Choice

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure


@dataclass(frozen=True, eq=False, repr=False)
class Study:
    """A tuned filter, the trials that led to it, and its gain on held-out seeds.

    Attributes:
        tuning: all results, as on the command line: plan, result and held-out evaluations.
    """

    tuning: Tuning

    @property
    def name(self) -> str:
        """The study's name in its storage."""
        return self.tuning.study

    @property
    def choice(self) -> Choice:
        """The tuned parameters: those of the model, such as Q and R, and the filter's own."""
        return self.tuning.result.choice

    @property
    def problem(self) -> Problem:
        """The problem it was tuned on; the first of several."""
        return self.tuning.scenario

    @property
    def problems(self) -> tuple[Problem, ...]:
        """All problems that it was tuned on."""
        return self.tuning.plan.scenarios

    @property
    def filter(self) -> Filter:
        """The tuned filter, ready to use: `init`, `predict`, `update`."""
        return self.choice.filter(self.problem)

    @property
    def held_out(self) -> HeldOut:
        """Tuned filter and baselines on held-out seeds; for several problems on the first."""
        return self.evaluations[0]

    @property
    def evaluations(self) -> tuple[HeldOut, ...]:
        """The same on each problem."""
        pairs = zip(self.problems, self.tuning.comparisons, strict=True)
        plan, chosen = self.tuning.plan, self.tuning.chosen
        return tuple(
            HeldOut(self.choice, one, comparison, seed=plan.seed, chosen=chosen, forget=plan.forget)
            for one, comparison in pairs
        )

    @property
    def trials(self) -> list[FrozenTrial]:
        """The trials as Optuna objects."""
        return self.tuning.result.trials

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended it before all trials were finished."""
        return self.tuning.result.interrupted

    @property
    def consistent(self) -> bool | None:
        """Whether any trial's mean NIS was in its band; None without a band."""
        return self.tuning.result.consistent

    def save(self, path: str | Path) -> Path:
        """Write the tuned file for `EstimateState(env, tuned=path)` and all commands; return the path.

        Later reports of the study name this file.

        Raises:
            ValueError: if the file cannot be written, or the filter is an estimator that is code.
        """
        check_keepable(self.choice.name)
        self.tuning.write(path)
        object.__setattr__(self, "tuning", self.tuning._replace(file=Path(path)))
        return Path(path)

    def export_c(
        self,
        folder: str | Path,
        name: str | None = None,
        *,
        single: bool = False,
        monitor: Monitor | Mapping | float | None = None,
        board: bool = False,
    ) -> Path:
        """Write the tuned filter as C99 with a program that filters a log; return the folder.

        Arguments and errors are those of `filters.c.project.write_project`.
        """
        from filters.c.project import write_project

        options: dict = {"single": single, "monitor": monitor, "board": board, "dt": self.problem.dt}
        write_project(self.filter, folder, name, **options)
        return Path(folder)

    def to_frame(self) -> pandas.DataFrame:
        """A row per trial: its number, state, objectives, whether it is consistent, seconds, and parameters.

        Raises:
            ValueError: if pandas is not installed.
        """
        objectives = self.tuning.plan.objectives
        names = list(dict.fromkeys(name for trial in self.trials for name in trial.params))
        columns: dict[str, list] = {"trial": [trial.number + 1 for trial in self.trials]}
        columns["state"] = [trial.state.name.lower() for trial in self.trials]
        for place, objective in enumerate(objectives):
            values = [_value(trial, place) for trial in self.trials]
            columns[reported_name(objective)] = [v if v is None else reported(objective, v) for v in values]
        columns["consistent"] = [is_consistent(trial) for trial in self.trials]
        columns["seconds"] = [_seconds(trial) for trial in self.trials]
        for name in names:
            columns[name] = [trial.params.get(name) for trial in self.trials]
        return frame(columns, "trial")

    def plot_history(self) -> Figure:
        """First objective of every trial, and the best so far."""
        from tuning.reporting.figures import draw_history

        objective = self.tuning.plan.objectives[0]
        label = score_label(self.tuning.plan.scenarios) if objective == "score" else reported_name(objective)
        return drawn(draw_history(self.trials, f"Study {self.name}", label, objective))

    def plot_errors(self) -> Figure:
        """RMSE before and after on held-out seeds, with 95 % intervals and the bound.

        Raises:
            ValueError: without truth, since there is no RMSE.
        """
        return self.held_out.plot_errors()

    def plot_run(self, place: int = 0) -> Figure:
        """One held-out run over time, before and after."""
        return self.held_out.plot_run(place)

    def plot_consistency(self) -> Figure:
        """Whether the tuned filter's covariance is consistent on the held-out seeds, a panel per check."""
        return self.held_out.plot_consistency()

    def plot_sizes(self) -> Figure:
        """RMSE against ensemble size on separate seeds.

        Raises:
            ValueError: for a filter without an ensemble, or a problem without truth.
        """
        from tuning.reporting.search_figures import draw_sizes

        rows = self.tuning.result.sizes
        if not rows:
            raise ValueError(
                f"a figure of ensemble sizes needs an ensemble and true states, but {self!r} lacks one of them"
            )
        return drawn(draw_sizes(rows, self.choice.numbers["ensemble_size"]))

    def report(self, out: str | Path | None = None) -> Path:
        """Write a page on it that any browser shows; see `tuning.report`."""
        from tuning.api.report import report

        return report(self, out)

    def __repr__(self) -> str:
        result, names = self.tuning.result, ", ".join(one.name for one in self.problems)
        said = f"Study({label_of(self.choice.name)} on {names}, {result.finished} trials"
        ended = ", interrupted" if self.interrupted else ""
        if not self.tuning.comparison.tuned.has_truth:
            return f"{said}{ended}: tuning {worth(self.tuning.comparison)})"
        return f"{said}{ended}: score {about(self.held_out.score)}; tuning {worth(self.tuning.comparison)})"

    def __str__(self) -> str:
        """The choice and its reason, a summary line, and the tables of its held-out evaluations."""
        first, tables = plain_text(self.tuning.chosen), [plain_text(one.tables()) for one in self.evaluations]
        return "\n\n".join([*([first] if first else []), repr(self), *tables])

    def _repr_html_(self) -> str:
        from tuning.reporting.units import number_rows

        found = self.held_out
        rows = number_rows(list(found.choices.values()), self.choice.name, self.problem, _text)
        numbers = html(f"Numbers of the {label_of(self.choice.name)} filter", ["", *found.choices], rows)
        said = " ".join([*self.tuning.chosen, f"Tuning {worth(self.tuning.comparison)}."])
        return numbers + found._repr_html_() + f"<p>{escape(said)}</p>"


def _text(value: Any) -> str:
    return "default" if value is None else number(value) if isinstance(value, float) else str(value)


def _value(trial: FrozenTrial, place: int) -> float | None:
    """An objective of a complete trial; of a pruned one the mean of the seeds that it came to."""
    if trial.state == TrialState.COMPLETE:
        return trial.values[place]
    seen = list(trial.intermediate_values.values())
    return sum(seen) / len(seen) if seen and place == 0 else None


def _seconds(trial: FrozenTrial) -> float | None:
    return None if trial.duration is None else trial.duration.total_seconds()
