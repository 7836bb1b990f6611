"""`Study`: the result of a tuning, as a value that can be shown, saved and used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from optuna.trial import FrozenTrial, TrialState
from rich.console import RenderableType

from filters.estimators.find import label_of
from filters.filter import Filter
from filters.monitoring.monitor import Monitor
from filters.registry import filter_type
from thruster_env.core.checks import short_repr
from thruster_env.core.text_tables import plain_text
from thruster_env.model.state_space import StateSpaceModel
from tuning.api.display import about, drawn, frame, html, number
from tuning.api.held_out import HeldOut
from tuning.api.markers import (
    FILTER,
    INPUT,
    OUTPUT,
    READ,
    SEARCH,
    WRITTEN,
    FilterOption,
    Group,
    Option,
    ProblemOption,
    Progress,
    Seed,
)
from tuning.api.problems import problems_of
from tuning.api.progress import console_for
from tuning.api.read_logs import RecordedRuns
from tuning.api.run import Tuning, aim_of, name_of, run_tuning, sampler_of, with_budget
from tuning.evaluation.tuned import check_keepable
from tuning.evaluation.worth import tuning_effect
from tuning.methods.registry import DEFAULT, METHODS
from tuning.problems.assumed import as_argument, rows_argument
from tuning.problems.problem import Problem, score_label
from tuning.reporting.tuning_report import as_json, report
from tuning.search.objectives import reported, reported_name
from tuning.search.plan import Plan
from tuning.search.space import Choice, untuned_choice
from tuning.search.storage import storage_text
from tuning.search.trials import is_consistent
from tuning.series.column import column_alone

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

STUDIES = "out/studies.journal"  # of commands
INTERRUPTED, NONE_CONSISTENT = 130, 3  # exit codes


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
            HeldOut(self.choice, problem, comparison, seed=plan.seed, chosen=chosen, forget=plan.forget)
            for problem, comparison in pairs
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
        for i, objective in enumerate(objectives):
            values = [_value(trial, i) for trial in self.trials]
            columns[reported_name(objective)] = [v if v is None else reported(objective, v) for v in values]
        columns["consistent"] = [is_consistent(trial) for trial in self.trials]
        columns["seconds"] = [_seconds(trial) for trial in self.trials]
        for name in names:
            columns[name] = [trial.params.get(name) for trial in self.trials]
        return frame(columns, "trial")

    def plot_history(self) -> Figure:
        """First objective of every trial, and the best so far."""
        from tuning.reporting.search_figures import draw_history

        objective = self.tuning.plan.objectives[0]
        label = score_label(self.tuning.plan.scenarios) if objective == "score" else reported_name(objective)
        return drawn(draw_history(self.trials, f"Study {self.name}", label, objective))

    def plot_errors(self) -> Figure:
        """RMSE before and after on held-out seeds, with 95 % intervals and the bound.

        Raises:
            ValueError: without truth, since there is no RMSE.
        """
        return self.held_out.plot_errors()

    def plot_run(self, run: int = 0) -> Figure:
        """One held-out run over time, before and after."""
        return self.held_out.plot_run(run)

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
        result, names = self.tuning.result, ", ".join(problem.name for problem in self.problems)
        summary = f"Study({label_of(self.choice.name)} on {names}, {result.finished} trials"
        ended = ", interrupted" if self.interrupted else ""
        effect = tuning_effect(self.tuning.comparison)
        if not self.tuning.comparison.tuned.has_truth:
            return f"{summary}{ended}: tuning {effect})"
        return f"{summary}{ended}: score {about(self.held_out.score)}; tuning {effect})"

    def tables(self) -> list[RenderableType]:
        """The gain of the tuning, then tables and sentences, for a terminal."""
        return report(self.tuning)

    def as_dict(self) -> dict[str, Any]:
        """All results as plain data, as in `thruster tune --json`."""
        return as_json(self.tuning)

    @property
    def exit_code(self) -> int:
        """Of the command: 130 if it was interrupted, 3 if no trial is consistent."""
        return INTERRUPTED if self.interrupted else NONE_CONSISTENT if self.consistent is False else 0

    def __str__(self) -> str:
        """What `thruster tune` prints."""
        return plain_text(self.tables())

    def _repr_html_(self) -> str:
        from tuning.reporting.choice_words import number_rows

        held_out = self.held_out
        rows = number_rows(list(held_out.choices.values()), self.choice.name, self.problem, _text)
        numbers = html(f"Numbers of the {label_of(self.choice.name)} filter", ["", *held_out.choices], rows)
        text = " ".join([*self.tuning.chosen, f"Tuning {tuning_effect(self.tuning.comparison)}."])
        return numbers + held_out._repr_html_() + f"<p>{escape(text)}</p>"


def _text(value: Any) -> str:
    return "default" if value is None else number(value) if isinstance(value, float) else str(value)


def _value(trial: FrozenTrial, index: int) -> float | None:
    """An objective of a complete trial; of a pruned one the mean of the seeds that it came to."""
    if trial.state == TrialState.COMPLETE:
        return trial.values[index]
    values = list(trial.intermediate_values.values())
    return sum(values) / len(values) if values and index == 0 else None


def _seconds(trial: FrozenTrial) -> float | None:
    return None if trial.duration is None else trial.duration.total_seconds()


# `tuning.tune`: find a filter's Q, R and other parameters, and evaluate them on held-out seeds.


@dataclass(frozen=True)
class SearchSpace:
    """Which parameters a study searches, and what they must obey.

    Attributes:
        hold_r: keep R from the sensor's data sheet, tune only Q.
        full_q: tune the correlations of Q, too.
        full_r: tune the correlations of R, too.
        where: a relation that parameters must obey: 'Q22 = 4 Q11', 'Q33 = Q11', 'R = 0.01' (not tuned),
            'Q11 = 1e-6..1e-2' (its range); may be repeated.
        forget: longest time constant of the filter's gain that is allowed; a smaller Q is raised to it.
    """

    hold_r: Annotated[bool, Option(SEARCH)] = False
    full_q: Annotated[bool, Option(SEARCH)] = False
    full_r: Annotated[bool, Option(SEARCH)] = False
    where: Annotated[Sequence[str], Option(SEARCH, metavar="RELATION")] = ()
    forget: Annotated[float | None, Option(SEARCH, metavar="SECONDS")] = None


def tune(
    problem: Annotated[
        Any,
        ProblemOption(
            INPUT,
            ("--problem", "--scenario"),
            type=list[str],
            default=["mismatch"],
            choices="problems",
            file=READ,
            last="augment",
        ),
    ],
    filter: Annotated[str, replace(FilterOption, default="enkf")] = "ekf",
    *,
    space: Annotated[SearchSpace, Group(SearchSpace)] = SearchSpace(),  # noqa: B008 - it is frozen
    budget: Annotated[float | None, Option(FILTER, metavar="MICROSECONDS")] = None,
    trials: Annotated[int, Option(SEARCH)] = 50,
    objective: Annotated[str | Sequence[str] | None, Option(SEARCH, type=list[str], choices="objectives")] = None,
    worst: Annotated[bool, Option(SEARCH)] = False,
    consistent: Annotated[bool, Option(SEARCH, ("--consistency/--no-consistency",))] = True,
    prune: Annotated[bool, Option(SEARCH, ("--pruning/--no-pruning",))] = True,
    method: Annotated[str, Option(SEARCH, choices=METHODS)] = DEFAULT,
    workers: int = 1,
    storage: Annotated[str | Path | None, Option(OUTPUT, default=STUDIES)] = None,
    name: Annotated[str | None, Option(OUTPUT, ("--study",))] = None,
    out: Annotated[str | Path | bool | None, Option(OUTPUT, type=Path, file=WRITTEN, unset=True)] = None,
    seed: Seed = 0,
    progress: Progress = None,
) -> Study:
    """Find the Q, R and ensemble size that give a filter's best estimate, and evaluate it on held-out seeds.

    The score is the mean over states of RMSE over its scale, on 32 training seeds that every trial shares. The
    first trial is the rule of thumb: R from the sensor's data sheet, Q from 1 % of each state's range. Ctrl-C
    keeps all finished trials, and the same command continues the study. The report compares the filter with its
    baselines, first with your model's own Q and R, on 200 seeds that no trial saw.

        study = tuning.tune("mismatch", filter="enkf", trials=50)
        study.save("tuned.json")
        study.plot_errors()

        study = tuning.tune((model, ["run1.csv", "run2.csv"]), trials=100)

    Q's variances and R are searched from 1e-10 to 1e4 times the rule of thumb, on logarithmic scales, beginning
    from 1e-5 to 1e2 (R: 1e-2 to 1e3) and ten times beyond the best trial; given values lie inside, and the report
    flags a parameter at an end of its range. Besides sampled trials the study tries the baselines (given, rule of
    thumb, scaled default, noise estimation) and the maximum-likelihood values. At the end the best trials are
    compared with the baselines on 100 validation seeds. If none is significantly better, the best baseline is
    chosen, and the report names the runs in which what was given fails.

    RMSE alone barely determines Q and R: only their ratio affects the estimate. The study therefore keeps the mean
    NIS in a band, unless that is switched off, as long as it costs at most 5 % of the score. With true states
    it chooses the trial with the best log score among those within 5 % of the least error. If no trial is in the
    band, the report and the file say so, and the command's exit code is 3.

    --method also selects another sampler, gradients, or a published method, which runs alone: samplers end after
    --trials trials, the others by their own criterion. With a right model and true states use noise-estimation.
    With true states use log-score if the covariance matters, mse if only the estimate does. Without true states
    use likelihood, or als for a linear model on long runs, which accepts --full-q and --full-r. For an ensemble
    use the default, or desroziers without true states. With true states and a wrong model, or a dead band, add
    --full-q (and --full-r) to mse or log-score. `thruster methods` lists all methods.

    With --log the study uses recorded runs, cut into blocks of which every third is held out. It minimises the
    negative log-likelihood of the innovations, unless the logs contain the true states.

    Example: thruster tune --filter ekf --scenario mismatch --scenario outliers --trials 100

    Example: thruster tune --filter ekf --log run1.csv --log run2.csv --trials 100

    Example: thruster tune --filter ekf --method log-score --scenario mismatch

    Example: thruster tune --filter auto --budget 2 --scenario published_noise --trials 100

    Example: thruster tune --filter ekf --augment voltage_gain --scenario mismatch

    Args:
        problem: name of a problem; several for their mean, or the worst with `worst`; mismatch by default. In
            Python also a `Problem`, `tuning.find_problem(...)`, `tuning.read_logs(...)`, a pair (model, data) of a
            model, or a thruster's preset, and recorded runs, or a list.
        filter: name of a filter, as `thruster filters` lists them, or auto: the best of all within `budget`. In
            Python also "module:object" for an estimator of your own, which can be used, but not saved.
        space: what is searched.
        budget: time limit of a step of the filter on one core; of auto by default 2.5 n^2 for n states.
        trials: total number of finished trials of the study.
        objective: what to minimise, two for a Pareto front; by default the score, or without true states the
            negative log-likelihood.
        worst: minimise the worst of several problems instead of their mean.
        consistent: whether to keep the mean NIS between 0.8 and 1.25 of its expected value.
        prune: whether to end trials that are significantly worse than the best on the same seeds.
        method: a study by a sampler (tpe, gp, cma-es, nsga-ii, random, grid), gradient for Kalman filters, or a
            published method; `thruster methods` lists them and when to use which.
        workers: processes on this host that share the study; several need a storage.
        storage: journal file for one host; for several, a database (docs/workers.md). In Python by default none:
            the study ends with the process.
        name: name of the study; by default from the options above.
        out: tuned file; out/STUDY.json by default. In Python none by default, and True for that one.
        seed: seed of all randomness; the same seed gives the same results.
        progress: whether to show progress; by default only in terminals and notebooks.

    Returns:
        `Study`: `filter`, `choice`, `held_out`, `save(path)`, `to_frame()`, `plot_history()`, `plot_errors()`.

    Raises:
        ValueError: states the rule and the value.
        KeyboardInterrupt: after Ctrl-C before any trial is complete, or during the held-out evaluation.
    """
    if isinstance(problem, RecordedRuns) and (column := column_alone(problem.files, problem.reading)) is not None:
        rule = "a log to tune a filter on must have the columns of a model, a thruster's by default"
        way_out = f"`thruster fit {column}` (tuning.fit) finds a model, Q and R"
        raise ValueError(f"{rule}, but {column} has one column of numbers: {way_out}")
    if not isinstance(filter, str):
        raise ValueError(
            f"filter must be a name or 'module:object', by which trials keep it, but got {short_repr(filter)}"
        )
    if out is not None:
        check_keepable(filter)
    sampler, problems = sampler_of(method), problems_of(problem)
    asked = [objective] if isinstance(objective, str) else None if objective is None else list(objective)
    plan = Plan(
        filter,
        problems,
        seed,
        tuple(asked or ["score" if problems[0].scale is not None else "likelihood"]),
        consistent=consistent,
        sampler=sampler,
        hold_r=space.hold_r,
        prune=prune,
        budget=budget,
        full_q=space.full_q,
        full_r=space.full_r,
        where=(space.where,) if isinstance(space.where, str) else tuple(space.where),
        worst=worst,
        forget=space.forget,
    )
    plan, aim = with_budget(plan), aim_of(asked)
    study = name or name_of(plan, method, aim)
    file = None if out in (None, False) else Path("out") / f"{study}.json" if out is True else Path(str(out))
    journal, console = None if storage is None else storage_text(storage), console_for(progress)
    return Study(run_tuning(plan, trials, console, journal, study, file, method=method, aim=aim, workers=workers))


# A user's own parameters as a choice: those of a filter, or of a model with its own Q and R.


DEFAULT_FILTER = "ekf"  # of a model alone


def is_own(argument: Any) -> bool:
    """Whether something is a filter object or a model, with its own parameters."""
    return isinstance(argument, Filter | StateSpaceModel)


def user_choice(filter_or_model: Filter | StateSpaceModel, problem: Problem) -> Choice:
    """The Q, R and other parameters of a filter or model, with its prior, for a problem of the same equations.

    A model means an extended Kalman filter on it.

    Raises:
        ValueError: if the model's functions, states or constants are not those of the problem's.
    """
    model = filter_or_model.model if isinstance(filter_or_model, Filter) else filter_or_model
    name = filter_or_model.name if isinstance(filter_or_model, Filter) else DEFAULT_FILTER
    expected = problem.model(**problem.untuned)
    if model.digest != expected.digest:
        raise ValueError(
            f"own numbers must be of the model of {problem.name}, digest {expected.digest}, but got a model of "
            f"digest {model.digest}: make a problem of it, ModelProblem(truth, model)"
        )
    noise = {
        "process_noise_cov": rows_argument(model.process_noise_cov),
        "measurement_noise_cov": as_argument(model.measurement_noise_cov),
    }
    numbers = untuned_choice(name, problem).numbers
    if isinstance(filter_or_model, Filter):
        numbers = {
            key: getattr(filter_or_model, key)
            for key in filter_type(name).numbers
            if key in numbers or hasattr(filter_or_model, key)
        }
    return Choice(
        name, {**{parameter.name: parameter.start for parameter in problem.parameters or ()}, **noise}, numbers
    )
