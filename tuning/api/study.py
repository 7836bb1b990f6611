"""`Study`: the result of a tuning, as a value that can be shown, saved and used."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from optuna.trial import FrozenTrial, TrialState

from filters.estimators.foreign import label_of
from filters.filter import Filter
from filters.monitoring import Monitor
from filters.registry import filter_type
from thruster_env.core.text_tables import Table
from thruster_env.model.state_space import StateSpaceModel
from tuning.api.held_out import HeldOut
from tuning.api.result import Result, about, drawn, frame, plain_data
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.tuned import check_keepable, write_tuned
from tuning.evaluation.worth import all_warnings, tuning_effect
from tuning.likelihood.gradient import GradientResult
from tuning.likelihood.identifiability import Identifiability
from tuning.methods.task import GRADIENT_METHOD, METHODS, Refused
from tuning.problems.assumed import as_argument, rows_argument
from tuning.problems.problem import Problem, score_label
from tuning.reporting.choice_words import choice_sentences
from tuning.reporting.tuning_report import as_json, report
from tuning.search.plan import Plan, range_warning, reported, reported_name
from tuning.search.space import Choice, untuned_choice
from tuning.search.study import StudyResult
from tuning.search.trials import is_consistent
from tuning.search.validation import as_data

if TYPE_CHECKING:
    import pandas
    from matplotlib.figure import Figure

    from tuning.api.report import Report

STUDIES = "out/studies.journal"  # of commands
NONE_CONSISTENT = 3  # exit code


class MethodAnswer(NamedTuple):
    """The answer of a method that ran alone, and its cost."""

    name: str
    choice: Choice
    runs: float  # passes of the filter over one run each
    seconds: float  # of processor time, without compilation
    refused: Refused | None = None  # where the choice is what the method was given


@dataclass(frozen=True, eq=False, repr=False)
class Study(Result):
    """A tuned filter, the trials that led to it, and its gain on held-out seeds.

    Attributes:
        name: in its storage.
        plan: what is asked.
        result: the trials and the choice.
        comparisons: the held-out evaluation on each problem.
        file: the tuned file, if one was written.
        gradient: if the choice is the optimum that gradients lead to ...
        rival: ... what the study in its stead would have chosen, on held-out seeds.
        known: what the innovations determine; None without a covariance.
        answer: if the choice is that of a method that ran alone.
    """

    name: str
    plan: Plan
    result: StudyResult
    comparisons: tuple[Comparison, ...]
    file: Path | None = None
    gradient: GradientResult | None = None
    rival: Comparison | None = None
    known: Identifiability | None = None
    answer: MethodAnswer | None = None

    @property
    def choice(self) -> Choice:
        """The tuned parameters: those of the model, such as Q and R, and the filter's own."""
        return self.result.choice

    @property
    def problem(self) -> Problem:
        """The problem it was tuned on; the first of several."""
        return self.plan.scenarios[0]

    @property
    def problems(self) -> tuple[Problem, ...]:
        """All problems that it was tuned on."""
        return self.plan.scenarios

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
        pairs = zip(self.problems, self.comparisons, strict=True)
        plan, chosen = self.plan, self.chosen
        return tuple(
            HeldOut(self.choice, problem, comparison, seed=plan.seed, chosen=chosen, forget=plan.forget)
            for problem, comparison in pairs
        )

    @property
    def trials(self) -> list[FrozenTrial]:
        """The trials as Optuna objects."""
        return self.result.trials

    @property
    def interrupted(self) -> bool:
        """Whether Ctrl-C ended it before all trials were finished."""
        return self.result.interrupted

    @property
    def consistent(self) -> bool | None:
        """Whether any trial's mean NIS was in its band; None without a band."""
        return self.result.consistent

    def save(self, path: str | Path) -> Path:
        """Write the tuned file for `EstimateState(env, tuned=path)` and all commands; return the path.

        Later reports of the study name this file.

        Raises:
            ValueError: if the file cannot be written, or the filter is an estimator that is code.
        """
        check_keepable(self.choice.name)
        self.write(path)
        object.__setattr__(self, "file", Path(path))
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
        objectives = self.plan.objectives
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

    def figures(self) -> dict[str, Figure]:
        """The course of the study, the figures of the held-out evaluation and, of an ensemble, its sizes."""
        sizes = {"Error against ensemble size": self.plot_sizes()} if self.result.sizes else {}
        return {"The course of the study": self.plot_history(), **self.held_out.figures(), **sizes}

    def plot_history(self) -> Figure:
        """First objective of every trial, and the best so far."""
        from tuning.reporting.search_figures import draw_history

        objective = self.plan.objectives[0]
        label = score_label(self.plan.scenarios) if objective == "score" else reported_name(objective)
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

        rows = self.result.sizes
        if not rows:
            raise ValueError(
                f"a figure of ensemble sizes needs an ensemble and true states, but {self!r} lacks one of them"
            )
        return drawn(draw_sizes(rows, self.choice.numbers["ensemble_size"]))

    def report(self, out: str | Path | None = None) -> Report:
        """Write a page on it that any browser shows; see `tuning.report`."""
        from tuning.api.report import report

        return report(self, out)

    def __repr__(self) -> str:
        result, names = self.result, ", ".join(problem.name for problem in self.problems)
        summary = f"Study({label_of(self.choice.name)} on {names}, {result.finished} trials"
        ended = ", interrupted" if self.interrupted else ""
        effect = tuning_effect(self.comparison)
        if not self.comparison.tuned.has_truth:
            return f"{summary}{ended}: tuning {effect})"
        return f"{summary}{ended}: score {about(self.held_out.score)}; tuning {effect})"

    def tables(self) -> list[Table | str]:
        """The gain of the tuning, then tables and sentences."""
        return report(self)

    def as_dict(self) -> dict[str, Any]:
        """All results as plain data, as in `thruster tune --json`."""
        return plain_data(as_json(self))

    @property
    def exit_code(self) -> int:
        """Of the command: 130 if it was interrupted, 3 if no trial is consistent."""
        return super().exit_code or NONE_CONSISTENT * (self.consistent is False)

    @property
    def comparison(self) -> Comparison:
        """The held-out evaluation on the first scenario."""
        return self.comparisons[0]

    @property
    def chosen(self) -> tuple[str, ...]:
        """Which trial was chosen and what it replaced, in sentences, and what to beware of in the result."""
        warned = self.warnings
        if self.answer is not None:
            return (method_sentence(self.answer, self.problem.seed_word, self.plan.objectives[0]), *warned)
        return (*choice_sentences(as_data(self.result.validation), self.plan), *warned)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What to beware of in the tuned filter: a covariance that is far off, and where the search ended."""
        messages = all_warnings(self.comparisons, self.plan.scenarios, self.plan.forget)
        return (*messages, *range_warning(self.result.choice, self.plan))

    @property
    def method(self) -> str:
        """Name of the method, one of METHODS."""
        if self.answer is not None:
            return self.answer.name
        return self.plan.sampler if self.gradient is None else GRADIENT_METHOD

    def write(self, file: str | Path) -> None:
        """Write the tuned file."""
        write_tuned(file, self.plan, self.result, self.comparisons, self.name, self.method)


def method_sentence(answer: MethodAnswer, word: str, objective: str) -> str:
    """How the parameters were found, and the cost."""
    method = METHODS[answer.name]
    took = f"It took {answer.seconds:.2g} s, as long as {answer.runs:.0f} runs of the filter over one of the"
    worse = ""
    if answer.refused is not None:
        given_value, value = (reported(objective, value) for value in answer.refused)
        worse = (
            f" On these its answer has a {reported_name(objective)} of {value:.4g} and the given filter "
            f"{given_value:.4g}, so that one is returned."
        )
    return f"Method {answer.name}: {method.about} ({method.source}). {took} training {word}.{worse}"


def _value(trial: FrozenTrial, index: int) -> float | None:
    """An objective of a complete trial; of a pruned one the mean of the seeds that it came to."""
    if trial.state == TrialState.COMPLETE:
        return trial.values[index]
    values = list(trial.intermediate_values.values())
    return sum(values) / len(values) if values and index == 0 else None


def _seconds(trial: FrozenTrial) -> float | None:
    return None if trial.duration is None else trial.duration.total_seconds()


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
