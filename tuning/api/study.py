"""`Study`: the result of a tuning, as a value that can be shown, saved and used."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

from optuna.trial import FrozenTrial, TrialState

from filters.estimators.find import label_of
from filters.filter import Filter
from filters.monitoring.monitor import Monitor
from filters.registry import filter_type
from thruster_env.core.checks import short_repr
from thruster_env.core.text_tables import plain_text
from thruster_env.model.state_space import StateSpaceModel
from tuning.api.display import about, drawn, frame, html, number
from tuning.api.held_out import HeldOut
from tuning.api.problems import problems_of
from tuning.api.progress import console_for
from tuning.api.run import Tuning, aim_of, run_tuning, sampler_of, with_budget
from tuning.evaluation.tuned import check_keepable
from tuning.evaluation.worth import tuning_effect
from tuning.problems.assumed import as_argument, augmented, rows_argument, unknowns_of
from tuning.problems.problem import Problem, score_label
from tuning.search.objectives import reported, reported_name
from tuning.search.plan import Plan
from tuning.search.space import Choice, untuned_choice
from tuning.search.storage import storage_text
from tuning.search.trials import is_consistent

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

    def __str__(self) -> str:
        """The choice and its reason, a summary line, and the tables of its held-out evaluations."""
        first = plain_text(self.tuning.chosen)
        tables = [plain_text(evaluation.tables()) for evaluation in self.evaluations]
        return "\n\n".join([*([first] if first else []), repr(self), *tables])

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


def tune(
    problem: Any,
    filter: str = "ekf",
    *,
    trials: int = 50,
    seed: int = 0,
    objective: str | Sequence[str] | None = None,
    consistent: bool = True,
    worst: bool = False,
    hold_r: bool = False,
    full_q: bool = False,
    full_r: bool = False,
    where: Sequence[str] = (),
    forget: float | None = None,
    augment: Sequence[str] | Mapping[str, Any] = (),
    budget: float | None = None,
    prune: bool = True,
    method: str = "tpe",
    workers: int = 1,
    storage: str | Path | None = None,
    name: str | None = None,
    progress: bool | None = None,
    preset: str | Path | None = None,
    sensors: Sequence[str] | None = None,
    columns: Any = None,
    clock_offset: Any = None,
    dt: float | None = None,
    grid: bool = True,
    stamps: str | None = None,
    held_out: Any = None,
    blocks: int | None = None,
    lead: int | None = None,
    hold_gaps: bool | None = None,
    start: str | None = None,
    outliers: str | None = None,
) -> Study:
    """Find the Q, R and ensemble size that give a filter's best estimate, and evaluate it on held-out seeds.

    The score is the mean over states of RMSE over its bound, on 32 training seeds that every trial shares; for
    recorded runs without true states it is the negative log-likelihood of the innovations. The first trial is the
    rule of thumb. The mean NIS is kept in a band, because RMSE barely determines Q and R: only their ratio affects
    the estimate. Ctrl-C keeps all finished trials: the study then consists of these and is marked `interrupted`.

        study = tuning.tune("mismatch", filter="enkf", trials=50)
        study.save("tuned.json")
        study.plot_errors()

        study = tuning.tune((model, ["run1.csv", "run2.csv"]), trials=100)

    Args:
        problem: a name, such as "mismatch" or "auv:motion", a .toml file, or "module:object"; a
            `Problem`; a pair (model, data) of a model, or a thruster's preset, and recorded runs; or a list of
            problems, for the mean of their objectives or the `worst`. Recorded runs are paths,
            pandas tables, mappings from headers to arrays, or `Log`s.
        filter: name of a filter; "auto" for the best of all within the budget; or "module:object" for an estimator
            of your own, which can be used and evaluated, but not saved.
        trials: total number of finished trials of the study.
        seed: of all randomness; the same seed gives the same results.
        objective: the quantity to minimise, or two for a Pareto front, as `thruster tune --objective` lists them;
            by default the score, or without truth the negative log-likelihood.
        consistent: whether the mean NIS is kept between 0.8 and 1.25 times its expected value; the objective
            "log-score" needs no such band.
        worst: of several problems, minimise the objective of the worst one.
        hold_r: keep R at the data sheet's value, tune only Q.
        full_q: tune the correlations of Q, too.
        full_r: tune the correlations of R, too.
        where: relations that parameters must obey, such as "Q22 = 4 Q11", "Q33 = Q11", "R = 0.01"
            (not tuned), "Q11 = 1e-6..1e-2" (its range).
        forget: the longest time constant of the filter's gain that is allowed [s]; a smaller Q is raised to it.
        augment: constants of the model, such as "voltage_gain", that the filter also estimates, as further states
            whose random walks are tuned with Q; by name with an `Unknown`, or (std, walk).
        budget: time limit of a step of the filter [microseconds of one core]; for "auto" by default 2.5 times the
            square of the number of states.
        prune: end a trial that is significantly worse than the best on the same seeds.
        method: one of `thruster methods`: a study by a sampler of Optuna, by default "tpe"; "gradient", a study
            and the optimum that gradients lead to, with standard errors; or a method that runs alone, such as
            "noise-estimation" or "em", to its own end or, if it samples, for `trials` trials.
        workers: processes on this host that share the study; several need a storage.
        storage: journal file or URL of a database that saves the study, so that the same call continues it; by
            default it ends with the process.
        name: of the study; by default from the arguments above.
        progress: whether to show progress; by default only in terminals and notebooks.
        preset: the problem of another thruster, by name or file.
        sensors: for recorded runs of a thruster, the channels that the filter sees.
        columns: for recorded runs, headers by quantity.
        clock_offset: for recorded runs, seconds by quantity that a channel's clock is ahead.
        dt: for recorded runs, the sample time [s].
        grid: for recorded runs, whether they are put on a grid; else on their own stamps, as in `estimate`.
        stamps: for bags, "header" or "receipt", as in `estimate`.
        held_out: recorded runs used only for the held-out evaluation; by default every third.
        blocks: number of blocks per recorded run.
        lead: rows at the beginning of a block that are not scored.
        hold_gaps: hold the last input over gaps of a log; by default runs are split there.
        start: initial state of blocks of logs: "prior", or "measurement", from their first measurement, as
            ekf-robust does by default.
        outliers: samples that the findings in logs call outliers: "kept", or "missing", which leaves them out.

    Returns:
        `Study`: `filter`, `choice`, `held_out`, `save(path)`, `to_frame()`, `plot_history()`, `plot_errors()`.

    Raises:
        ValueError: states the rule and the value.
        KeyboardInterrupt: after Ctrl-C before any trial is complete, or during the held-out evaluation.
    """
    asked = [objective] if isinstance(objective, str) else objective
    sampler, aim = sampler_of(method), aim_of(None if asked is None else list(asked))
    if not isinstance(filter, str):
        raise ValueError(
            f"filter must be a name or 'module:object', by which trials keep it, but got {short_repr(filter)}"
        )
    of_logs: dict[str, Any] = {"sensors": sensors, "columns": columns, "clock_offset": clock_offset, "dt": dt}
    of_logs |= {"grid": None if grid else False, "stamps": stamps}
    of_logs |= {"held_out": held_out, "blocks": blocks, "lead": lead, "hold_gaps": hold_gaps, "start": start}
    of_logs |= {"outliers": outliers}
    unknown = unknowns_of(augment)
    problems = tuple(augmented(base, unknown) for base in problems_of(problem, preset, **of_logs))
    if objective is None:
        objective = "score" if problems[0].scale is not None else "likelihood"
    plan = Plan(
        filter,
        problems,
        seed,
        (objective,) if isinstance(objective, str) else tuple(objective),
        consistent=consistent,
        sampler=sampler,
        hold_r=hold_r,
        prune=prune,
        budget=budget,
        full_q=full_q,
        full_r=full_r,
        where=(where,) if isinstance(where, str) else tuple(where),
        worst=worst,
        forget=forget,
    )
    plan = with_budget(plan)
    journal = None if storage is None else storage_text(storage)
    console = console_for(progress)
    return Study(run_tuning(plan, trials, console, journal, name, method=method, aim=aim, workers=workers))


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
