"""`Bench`: a filter on a problem, as a value whose numbers one may change, and the results for any of them.

In order: export as a tuned file, Python lines or a command; maps and studies of a bench; the bench; and six guided
scenes on Q, R, an ensemble's size and a model's constants. A scene is data: a start, the changes, and the effect
that one then sees, which the tests check.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
from optuna.trial import TrialState

from filters.filter import Filter
from filters.registry import FILTERS
from thruster_env.core.checks import at_least, one_of, short_repr
from thruster_env.model.quantities import Quantity
from tuning.evaluation.baselines import TUNED, baseline_size, baselines, rule_of_thumb
from tuning.evaluation.evaluate import values_of
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import write_tuned
from tuning.exploring.view import (
    AMPLIFIER,
    SENSORS,
    Knob,
    PageData,
    View,
    disturbed,
    knobs_of,
    page_data,
    start_of,
    view_of,
)
from tuning.problems.data import Data
from tuning.problems.find import built_in, find_problem
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Parameter, Problem
from tuning.problems.scenario import plain
from tuning.search.plan import LIKELIHOOD, SCORE, Plan, find_objective, nis_ratio
from tuning.search.space import (
    Choice,
    everything_of,
    fits,
    has_search_space,
    neutral,
    parameters,
    parameters_of,
    untuned_choice,
)
from tuning.search.storage import quiet_optuna
from tuning.search.study import FINISHED, StudyResult, finished_trials, open_study, run_trials

CHANGED = (SENSORS, AMPLIFIER)  # fields of a scenario that a bench changes
BY_HAND = "by hand"  # the method of a tuned file whose numbers a person chose
LINES = """from filters import make_filter
{problem}
model = problem.model({model})
filter_ = make_filter({numbers})
"""
MOST_SEEDS = 64
MOST_ACROSS = 128  # values of each number on a map
OWN = {"Q11": 1.0, "Q22": 4e-4, "R": 0.25}  # the plant's own Q and R, in (rad/s)^2, (m/s)^2 and N^2


def file_of(choice: Choice, plan: Plan) -> str:
    """The tuned file of numbers that were chosen by hand, with their held-out evaluation."""
    result = StudyResult(choice, float("nan"), [], [], 0.0, False)
    comparisons = [evaluate_held_out(choice, problem, plan.seed) for problem in plan.scenarios]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "tuned.json"
        write_tuned(path, plan, result, comparisons, BY_HAND, BY_HAND)
        return path.read_text(encoding="utf-8")


def command_of(problem: Problem, file: str) -> str:
    """The command that evaluates a tuned file on held-out seeds or blocks."""
    model = (
        (problem.as_mapping() or {}).get("options", {}).get("model") if isinstance(problem, LogProblem) else None
    )
    return f"thruster evaluate {file}" + (f" --model {model}" if model else "")


def lines_of(choice: Choice, base: Problem, problem: Problem) -> str:
    """Python lines that make a filter of some numbers.

    Args:
        choice: the numbers.
        base: the problem as it is found.
        problem: the same with other disturbances.
    """
    return LINES.format(
        problem=_found(base, problem),
        model=_arguments(choice.model),
        numbers=", ".join(part for part in (repr(choice.name), "model", _arguments(choice.numbers)) if part),
    )


def _found(base: Problem, problem: Problem) -> str:
    """Lines that find a problem."""
    if isinstance(base, LogProblem):
        content = base.as_mapping()
        if content is None:
            return "\nproblem = ...  # of these logs"
        files = [log["file"] for log in content["logs"]]
        options = f", {_arguments(content['options'])}" if content["options"] else ""
        return f"from tuning.logs.problem import log_problem\n\nproblem = log_problem({files!r}{options})"
    if base.name not in built_in() and not base.name.endswith(".toml") and ":" not in base.name:
        return f"\nproblem = ...  # {short_repr(base.name)}"
    lines = f"from tuning.problems.find import find_problem\n\nproblem = find_problem({base.name!r})"
    if problem is base:
        return lines
    changes = {name: plain(getattr(problem, name)) for name in CHANGED if _differs(base, problem, name)}
    return f"{lines}.replace({_arguments(changes)})"


def _differs(base: Problem, problem: Problem, name: str) -> bool:
    return hasattr(problem, name) and getattr(problem, name) != getattr(base, name)


def _arguments(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in values.items())


class Map(NamedTuple):
    """Score and NIS at each pair of values of two knobs."""

    x: str  # name of the knob
    y: str
    xs: np.ndarray  # (size,), of a whole number its different values, which may be fewer
    ys: np.ndarray  # (size,)
    score: np.ndarray  # (y, x); negative log-likelihood of a run where there is no truth
    nis: np.ndarray  # (y, x), the mean NIS over its expected value: 1 is right; NaN without a covariance


def values_along(knob: Knob, size: int) -> np.ndarray:
    """Values over the range of a knob, on its scale."""
    values = (np.geomspace if knob.log else np.linspace)(knob.low, knob.high, size)
    return np.unique(np.rint(values)) if knob.integer else np.clip(values, knob.low, knob.high)


def map_of(x: Knob, y: Knob, size: int, case: Callable[[float, float], tuple[Filter, Data]], scale) -> Map:
    """Run a filter at each point of the map.

    Args:
        x: the knob along the rows.
        y: the other one.
        size: number of values of each.
        case: the filter at a value of each, and its data.
        scale: of the score, (n,); None without truth.
    """
    xs, ys = values_along(x, size), values_along(y, size)
    figures = np.empty((2, len(ys), len(xs)))
    objective = find_objective(LIKELIHOOD if scale is None else SCORE)

    for row, column in np.ndindex(len(ys), len(xs)):
        evaluation = values_of(*case(xs[column].item(), ys[row].item()), scale)
        figures[:, row, column] = objective.value(evaluation, np.nan), nis_ratio(evaluation)
    return Map(x.name, y.name, xs, ys, *figures)


class Trial(NamedTuple):
    """What a trial of a study tried, and what came of it."""

    values: Mapping[str, float]  # by knob
    score: float  # the study's objective; of a pruned trial that of the seeds that it came to
    pruned: bool = False


def trials_of(plan: Plan, start: Choice, trials: int) -> Iterator[Trial]:
    """Run a study in memory, and yield each trial as soon as it is finished; it ends where the iterator is closed.

    Args:
        plan: of the study.
        start: the first trial.
        trials: how many it shall have.
    """
    quiet_optuna()
    study, data = open_study("explore", plan, None, start), plan.training_data()
    finished: list[int] = []  # of the present round, which ends after one trial
    while finished_trials(study) < trials:
        finished.clear()
        if run_trials(study, plan, data, trials, lambda _, count: finished.append(count), lambda: bool(finished)):
            return
        last = study.get_trials(deepcopy=False, states=FINISHED)[-1]
        pruned = last.state == TrialState.PRUNED
        scores = list(last.intermediate_values.values())
        score = sum(scores) / len(scores) if pruned and scores else last.values[0]
        yield Trial(dict(last.params), score, pruned)


KNOWN = ("given", "rule of thumb", "scaled default", "oracle")  # baselines that are marked


def marks_of(name: str, problem: Problem, tuned: Choice | None = None, seed: int = 0) -> dict[str, dict]:
    """The values of knobs, by name, of a filter's baselines and of a tuned filter."""
    same = tuned if tuned is not None and tuned.name == name else None
    known = baselines(name, problem, seed, ensemble_size=None if same is None else baseline_size(same))
    choices = {label: choice for label, choice in known.items() if label in KNOWN}
    if same is not None:
        choices[TUNED] = same
    return {label: parameters_of(choice) for label, choice in choices.items()}


def checked_values(
    knobs: Sequence[Knob], values: Mapping[str, float], start: Mapping[str, float]
) -> dict[str, float]:
    """A value of each knob, that at the start where none is given; ValueError for others than a knob can have."""
    known = {knob.name: knob for knob in knobs}
    for name in values:
        one_of("a knob", name, known)
    return {name: knob.checked(values.get(name, start[name])) for name, knob in known.items()}


@dataclass(frozen=True)
class Bench:
    """A filter on a problem, with all numbers of both that one may change: a value, which can be pickled.

    Everything is computed by what studies and evaluations use, on the training seeds of a study: what is chosen
    by hand is evaluated on the held-out seeds afterwards, as the choice of a study is.

    Args:
        problem: a plant, or recorded logs.
        filter: name of the filter.
        tuned: a tuned filter, or own numbers, where one starts; the rule of thumb if None.
        seed: of the study to which the seeds belong.
        held_out: whether the runs are those of the held-out seeds, as `thruster evaluate` has them.

    Raises:
        ValueError: for an unknown filter, or one that the problem does not allow.
    """

    problem: Problem
    filter: str = "ekf"
    tuned: Choice | None = None
    seed: int = 0
    held_out: bool = False

    def __post_init__(self):
        """Check that there is such a filter of the problem."""
        one_of("filter", self.filter, FILTERS)
        if not has_search_space(self.filter):
            raise ValueError(f"filter must be one that has a number to change, but got {short_repr(self.filter)}")
        self._started.filter(self.problem)

    @property
    def title(self) -> str:
        """What is seen, for a heading."""
        return f"{self.filter} on {self.problem.name}"

    @cached_property
    def filters(self) -> tuple[str, ...]:
        """Names of the filters that may be chosen on the problem."""
        return tuple(name for name in FILTERS if has_search_space(name) and fits(name, self.problem))

    @property
    def has_truth(self) -> bool:
        """Whether the true states are known, and so errors."""
        return self.problem.scale is not None

    @property
    def states(self) -> tuple[Quantity, ...]:
        """Names, symbols and units of the states."""
        return self.problem.quantities.states

    @property
    def measurements(self) -> tuple[Quantity, ...]:
        """Names, symbols and units of the channels."""
        return self.problem.quantities.measurements

    @cached_property
    def knobs(self) -> tuple[Knob, ...]:
        """All numbers that one may change."""
        marks = marks_of(self.filter, self.problem, self.tuned, self.seed)
        return knobs_of(self.filter, self.problem, marks)

    @cached_property
    def start(self) -> dict[str, float]:
        """Where one starts: each knob's value in the tuned filter, or by rule of thumb."""
        return start_of(self.knobs, self.problem, self._started)

    @property
    def _started(self) -> Choice:
        is_own = self.tuned is not None and self.tuned.name == self.filter
        return self.tuned if is_own and self.tuned is not None else rule_of_thumb(self.filter, self.problem)

    @cached_property
    def _parameters(self) -> tuple[Parameter, ...]:
        return tuple(parameters(self.filter, self.problem, **everything_of(self.problem)))

    def with_filter(self, name: str) -> Bench:
        """The same bench with another filter."""
        return replace(self, filter=name)

    def on_held_out(self, held_out: bool = True) -> Bench:
        """The same bench on the held-out seeds, or back on those of training."""
        return replace(self, held_out=held_out)

    def checked(self, values: Mapping[str, float]) -> dict[str, float]:
        """A value of each knob, by default that of the start; ValueError for one that a knob cannot have."""
        return checked_values(self.knobs, values, self.start)

    def choice(self, values: Mapping[str, float]) -> Choice:
        """The filter's numbers at some values of the knobs, as a study has them."""
        return self._choice(self.checked(values))

    def problem_at(self, values: Mapping[str, float]) -> Problem:
        """The problem at some values of the knobs, with the disturbances that these say."""
        return self._problem(self.checked(values))

    def view(self, values: Mapping[str, float] | None = None, seeds: int = 8) -> View:
        """What one sees at some values of the knobs.

        Args:
            values: by name; the others are those of the start.
            seeds: number of runs; logs are shown whole.

        Raises:
            ValueError: for a value that a knob cannot have.
        """
        checked = self.checked(values or {})
        problem = self._problem(checked)
        return view_of(self._filter(checked), self._page_data(problem, seeds), problem)

    def map(self, values: Mapping[str, float], x: str, y: str, size: int = 32, seeds: int = 8) -> Map:
        """Score and NIS over two knobs, size x size runs of all seeds.

        Args:
            values: of the other knobs.
            x: name of the knob along the rows.
            y: name of the other one.
            size: number of values of each.
            seeds: number of runs at each point; all training blocks of logs.

        Raises:
            ValueError: for a value that a knob cannot have, an unknown knob, or the same one twice.
        """
        checked, known = self.checked(values), {knob.name: knob for knob in self.knobs}
        one_of("x", x, known), one_of("y", y, known)
        if x == y:
            raise ValueError(f"x and y must be different knobs, but got {x!r} for both")
        size = at_least("size", size, 2, MOST_ACROSS)

        def case(of_x: float, of_y: float):
            at = {**checked, x: of_x, y: of_y}
            return self._filter(at), self._page_data(self._problem(at), seeds).counted

        return map_of(known[x], known[y], size, case, self.problem.scale)

    def plan(self, values: Mapping[str, float] | None = None) -> Plan:
        """The study that starts here: of the same filter, on what is seen, within the ranges of the knobs."""
        checked = self.checked(values or {})
        problem, full = (
            self._problem(checked),
            [name for name in checked if "correlation_" in name and checked[name]],
        )
        plan = Plan(
            self.filter,
            (problem,),
            self.seed,
            (SCORE if self.has_truth else LIKELIHOOD,),
            full_q=any(not name.startswith("R") for name in full),
            full_r=any(name.startswith("R") for name in full),
        )
        known = {knob.name: knob for knob in self.knobs}
        chosen = [name for name, parameter in plan.parameters().items() if parameter.first is not None]
        return plan._replace(where=tuple(f"{name} = {known[name].low!r}..{known[name].high!r}" for name in chosen))

    def study(self, values: Mapping[str, float], trials: int = 100) -> Iterator[Trial]:
        """A study from some values on, trial by trial; close the iterator to stop it."""
        return trials_of(self.plan(values), self.choice(values), at_least("trials", trials, 1))

    def tuned_file(self, values: Mapping[str, float]) -> str:
        """The tuned file of some values, evaluated on the held-out seeds as that of a study is."""
        return file_of(self.choice(values), self.plan(values))

    def python_lines(self, values: Mapping[str, float]) -> str:
        """Lines that make the filter of some values."""
        return lines_of(self.choice(values), self.problem, self.problem_at(values))

    def command(self, values: Mapping[str, float], file: str = "tuned.json") -> str:
        """The command that evaluates the tuned file of some values."""
        self.checked(values)
        return command_of(self.problem, file)

    def _choice(self, checked: Mapping[str, float]) -> Choice:
        choice = untuned_choice(self.filter, self.problem)
        for parameter in self._parameters:
            if checked[parameter.name] != neutral(parameter.name):
                choice = parameter.set(choice, checked[parameter.name])
        return choice

    def _filter(self, checked: Mapping[str, float]) -> Filter:
        return self._choice(checked).filter(self.problem)

    def _problem(self, checked: Mapping[str, float]) -> Problem:
        return disturbed(self.problem, checked)

    def _page_data(self, problem: Problem, seeds: int) -> PageData:
        return page_data(problem, at_least("seeds", seeds, 1, MOST_SEEDS), self.seed, self.held_out)


class Step(NamedTuple):
    """One setting of a scene."""

    label: str
    filter: str
    values: Mapping[str, float]  # by knob; the others are those of the start


class Seen(NamedTuple):
    """A figure of the last step over that of the first: what the scene is about."""

    figure: str
    low: float
    high: float


class Scene(NamedTuple):
    """A lesson with its set-up."""

    name: str
    title: str
    text: str  # what it teaches
    todo: str  # what one does
    problem: str
    steps: tuple[Step, ...]  # the first is where one starts
    knobs: tuple[str, ...]  # that one moves
    state: str  # symbol of the state to look at
    seen: tuple[Seen, ...]

    def bench(self, step: int = 0) -> Bench:
        """The bench of a step."""
        return Bench(find_problem(self.problem), self.steps[step].filter)

    def view(self, step: int = 0, seeds: int = 8) -> View:
        """What one sees at a step."""
        return self.bench(step).view(self.steps[step].values, seeds)


SCENES = {
    scene.name: scene
    for scene in (
        Scene(
            "ridge",
            "Only the ratio of Q to R moves the estimate",
            "A Kalman filter weighs its model against the sensor, and only the ratio of Q to R enters the "
            "weights. Multiply both by thirty and every estimate stays where it was; but the filter now claims "
            "errors more than five times as large as they are. On a map of the error that is a ridge, or rather "
            "a valley: all along it the RMSE is the same. What tells one end from the other are the "
            "innovations: their squares over the variance that the filter expects, the NIS, should be about 1.",
            "Raise both Q and R by the same factor. The lines stay, the bands widen, the NIS falls.",
            "nominal",
            (
                Step("the plant's own Q and R", "ekf", OWN),
                Step("both thirty times as large", "ekf", {"Q11": 30.0, "Q22": 0.012, "R": 7.5}),
            ),
            ("Q11", "Q22", "R"),
            "U_a",
            (Seen("RMSE U_a", 0.98, 1.02), Seen("NIS", 0.03, 0.037), Seen("NEES", 0.03, 0.037)),
        ),
        Scene(
            "lag",
            "With too small a Q the estimate lags",
            "Q says how far the state may stray from the model in one step. Here the water flows past the "
            "thruster, slowly changing, and the model knows nothing of it. With a small Q the filter trusts its "
            "model, takes what the sensor says for noise, and follows the flow long after it has changed. The "
            "innovations give it away: they stay on one side for many steps, and one tells the next.",
            "Raise Q of the flow velocity until the estimate follows, and the autocorrelation falls into its "
            "band.",
            "ambient",
            (
                Step("a small Q of the flow", "ekf", {**OWN, "Q22": 4e-6}),
                Step("a Q that lets it follow", "ekf", {**OWN, "Q22": 4e-3}),
            ),
            ("Q22",),
            "U_a",
            (Seen("RMSE U_a", 0.3, 0.6), Seen("NIS", 0.05, 0.4)),
        ),
        Scene(
            "outliers",
            "One outlier in twenty is enough",
            "The sensor's data sheet says 0.5 N, and most of the time that is true; but one measurement in "
            "twenty is off by some 10 N. Squares make few large errors count more than many small ones, and a "
            "Kalman filter knows nothing but squares: with the R of the data sheet each outlier throws the "
            "estimate off. A larger R buys peace at a price, for the good measurements count less, too. A "
            "filter that looks at the size of an innovation before it believes it, ekf-robust, does better than "
            "any R.",
            "Raise R until the jumps are gone: a hundred times the data sheet's leaves less than a quarter of "
            "the error.",
            "outliers",
            (Step("R from the data sheet", "ekf", {}), Step("a hundred times that R", "ekf", {"R": 25.0})),
            ("R",),
            "omega_m",
            (Seen("RMSE omega_m", 0.05, 0.25), Seen("RMSE U_a", 0.2, 0.4)),
        ),
        Scene(
            "tangent",
            "An EKF believes in its tangent",
            "This tachometer has no sign: it reads the magnitude of the speed. An extended Kalman filter "
            "replaces it by its tangent at the estimate, and a tangent at either side of zero knows nothing of "
            "the other side. Where the speed crosses zero the filter takes the wrong branch and is sure of it. "
            "The NIS stays close to 1, so the innovations do not tell; the NEES, errors against the truth, "
            "does. The unscented filter tries several points on both sides and knows that it does not know.",
            "Change the filter from ekf to ukf: the same Q and R, and the errors fit the band again.",
            "speed_magnitude",
            (Step("ekf: one tangent", "ekf", OWN), Step("ukf: points on both sides", "ukf", OWN)),
            (),
            "omega_m",
            (Seen("NEES", 0.2, 0.5), Seen("RMSE omega_m", 0.6, 0.9), Seen("NIS", 0.7, 1.1)),
        ),
        Scene(
            "ensemble",
            "Five members are too few",
            "An ensemble filter measures its covariance from its members. Five of them see a covariance that is "
            "right on average and wrong each time; the gain follows its errors, the mean takes over part of the "
            "noise, and the spread comes out too small for the error that is left. The filter is overconfident, "
            "at the right Q and R. Inflation hides it; more members cure it.",
            "Raise the number of members from 5 to 100 and see NEES fall to the number of states, 2.",
            "nominal",
            (Step("5 members", "enkf", {**OWN, "N": 5}), Step("100 members", "enkf", {**OWN, "N": 100})),
            ("N", "inflation"),
            "U_a",
            (Seen("NEES", 0.1, 0.3), Seen("RMSE U_a", 0.7, 0.95)),
        ),
        Scene(
            "constant",
            "No Q makes up for a wrong constant",
            "The filter's model has 15 % more lift and 5 % less voltage gain than the plant. The thrust that it "
            "expects is that of another speed, so that it takes the motor for too slow, ahead and astern alike. "
            "Noise changes its sign; the error of a wrong constant does not. A larger Q widens the band and "
            "leaves the error where it is: the NIS can be brought to 1, the error cannot be brought down. What "
            "helps is the right constant, estimated with the states or identified from recorded runs.",
            "Raise Q as far as you like: the band grows, and the RMSE of the motor speed stays.",
            "mismatch",
            (
                Step("the plant's own Q", "ekf", OWN),
                Step("a hundred times that Q", "ekf", {**OWN, "Q11": 100.0, "Q22": 0.04}),
            ),
            ("Q11", "Q22"),
            "omega_m",
            (Seen("RMSE omega_m", 0.95, 1.15), Seen("NIS", 0.05, 0.2)),
        ),
    )
}
