"""`Task`: what a method of tuning works on, and the methods by name, which `method` registers where they stand.

A task runs the filter, counts passes and keeps the best choice so far.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from typing import Any, NamedTuple, TypeVar

import numpy as np

from filters.registry import filter_type
from thruster_env.core.checks import one_of
from thruster_env.core.modules import to_install
from thruster_env.core.streams import METHOD_OF_TUNING, derived_generator
from thruster_env.model.affine import linearize
from thruster_env.model.state_space import StateSpaceModel
from tuning.evaluation.baselines import same_filter
from tuning.evaluation.evaluate import compute_metrics
from tuning.evaluation.runs import metrics_of_all
from tuning.likelihood.ascent import Evaluation
from tuning.likelihood.gradient import objective_of
from tuning.likelihood.objective import Objective
from tuning.likelihood.parametric import check_gradient
from tuning.problems.data import FIRST_SCORED_STEP, Data
from tuning.problems.problem import Parameter, Problem
from tuning.search.parameters import Q, R, model_parameters
from tuning.search.plan import LIKELIHOOD, LOG_SCORES, NEES, SCORE, VARIANCES, find_objective, penalised
from tuning.search.space import Choice, has_search_space, neutral, parameters, untuned_choice

FEW = 32  # runs, by which passes are priced
TIMED = 3  # calls, of which the shortest counts, of what is priced
ALIKE = 1e-9  # relative difference, up to which two linearisations are the same
ROUNDING = 1e-6  # part of an objective: an answer that is worse by less is as good
F = TypeVar("F", bound=Callable[..., None])

GRADIENT_METHOD = "gradient"
DEFAULT = "tpe"
ONLY = "-only"  # behind a sampler: without what a study does besides

TPE = "Bergstra, Bardenet, Bengio, Kegl (2011)"
HANSEN = "Hansen (2016), arXiv 1604.00772"
GAUSSIAN = "Optuna's GPSampler"
UNIFORM = "Bergstra, Bengio (2012)"

# What a method may need.
TRUTH = "truth"  # true states
GRADIENT = "gradient"  # a Kalman filter with derivatives
COVARIANCE = "covariance"  # a filter with a covariance
LINEAR = "linear"  # a linear model with a stationary filter
NUTPIE = "nutpie"  # the package
NOISE = "noise"  # that Q and R are tuned, and not a model's own parameters
MODEL = "model"  # that some number of the model is tuned
INFLATION = "inflation"  # the parameter of a filter with an ensemble

OPTIONS = ("hold_r", "full_q", "full_r", "prior", "where")  # of a model's numbers
DIAGONAL = ("hold_r", "prior")
MATRICES = (*DIAGONAL, "full_q", "full_r")  # of methods that find matrices as a whole, and know no relations


class Budget(NamedTuple):
    """What a method may take."""

    runs: float = math.inf  # passes of the filter over one run each
    seconds: float = math.inf  # of processor time, without compilation


class Answer(NamedTuple):
    """A choice that was the best so far from a time on."""

    runs: float
    seconds: float
    choice: Choice


class Refused(NamedTuple):
    """An answer that was worse than what the method was given, which then is the answer."""

    before: float  # the objective of what the method was given
    after: float  # that of the answer


class Stationary(NamedTuple):
    """A linear model x' = A x + B u + a, z = C x + d."""

    a: np.ndarray
    b: np.ndarray
    offset: np.ndarray
    c: np.ndarray
    zero: np.ndarray


class Spent(Exception):
    """The budget is spent: the method ends here."""


class Task:
    """A filter to be tuned on the runs of some problems, within a budget.

    Every pass of the filter over a run counts 1, a smoother's 2, and a pass with gradients as much as it was
    measured to take. Compilation takes no time. A method calls `keep` for each choice that it would now return;
    the last of them is `best`.

    Args:
        filter_name: name of a filter.
        problems: make the models that it assumes.
        data: the training runs of each problem.
        options: hold_r, full_q, full_r and prior of `model_parameters`.
        objective: what methods that search minimise; the score, or without truth the likelihood, if None.
        budget: what the method may take.
        start: where it begins; the rule of thumb if None.
        given: what one had before, than which an answer must not be worse, as than the start.
        seed: of a method's own random numbers.
    """

    def __init__(
        self,
        filter_name: str,
        problems: Problem | Sequence[Problem],
        data: Data | Sequence[Data],
        *,
        options: Mapping[str, Any] | None = None,
        objective: str | None = None,
        budget: Budget = Budget(),  # noqa: B008 - a value that nothing changes
        start: Choice | None = None,
        given: Choice | None = None,
        seed: int = 0,
    ):
        """Begin with the start."""
        self.filter = filter_name
        self.problems = (problems,) if isinstance(problems, Problem) else tuple(problems)
        self.data = (data,) if isinstance(data, Data) else tuple(data)
        self.options = dict(options or {})
        self.objective = objective or (SCORE if self.has_truth else LIKELIHOOD)
        self.budget, self.given, self.seed = budget, given, seed
        self.stop: Callable[[], bool] = lambda: False  # whether somebody asked for an end
        self.start = untuned_choice(filter_name, self.problems[0]) if start is None else start
        self.runs, self._excluded = 0.0, 0.0
        self._prices: dict[str, float] = {}
        self.answers = [Answer(0.0, 0.0, self.start)]
        self.refused: Refused | None = None
        self._seen: set[tuple] = set()
        self._begun = time.process_time()

    @property
    def has_truth(self) -> bool:
        """Whether the true states are known, on all problems."""
        pairs = zip(self.problems, self.data, strict=True)
        return all(problem.scale is not None and data.states is not None for problem, data in pairs)

    @property
    def passes(self) -> int:
        """Runs of all problems: what one evaluation takes."""
        return sum(len(runs.seeds) for runs in self.data)

    @property
    def seconds(self) -> float:
        """Processor time so far, without compilation [s]."""
        return time.process_time() - self._begun - self._excluded

    @property
    def best(self) -> Choice:
        """The last choice that was kept."""
        return self.answers[-1].choice

    def best_within(self, runs: float = math.inf, seconds: float = math.inf) -> Choice:
        """The choice that the method would have given for a smaller budget."""
        return [entry for entry in self.answers if entry.runs <= runs and entry.seconds <= seconds][-1].choice

    @cached_property
    def generator(self) -> np.random.Generator:
        """A method's own random numbers."""
        return derived_generator(self.seed, METHOD_OF_TUNING, len(self.data[0].seeds))

    @cached_property
    def free(self) -> list[Parameter]:
        """The numbers of the model that are tuned, in the part of their ranges in which a search begins."""
        return model_parameters(self.problems[0], **self.options)

    @cached_property
    def searched(self) -> list[Parameter]:
        """What a search without gradients tunes: the same and the filter's own numbers, but no ensemble size."""
        if not filter_type(self.filter).has_covariance:
            return [parameter for parameter in parameters(self.filter, self.problems[0]) if not parameter.integer]
        tunable = parameters(self.filter, self.problems[0], **self.options)
        return [within_first_range(parameter) for parameter in tunable if not parameter.integer]

    def values_of(self, choice: Choice, parameters: Sequence[Parameter]) -> list[float]:
        """The values of parameters in a choice."""
        pairs = ((parameter, parameter.get(choice)) for parameter in parameters)
        return [neutral(parameter.name) if value is None else value for parameter, value in pairs]  # type: ignore[misc]

    def with_values(self, values: Sequence[float] | np.ndarray, parameters: Sequence[Parameter]) -> Choice:
        """The start with other values of some parameters."""
        choice = self.start
        for parameter, value in zip(parameters, values, strict=True):
            choice = parameter.set(choice, float(value))
        return choice

    def keep(self, choice: Choice, *, late: bool = False) -> None:
        """From now on this is what the method would give; Spent once the budget is over, unless it comes late."""
        if not late:
            self.check()
        if not same_filter(choice, self.best):
            self.answers.append(Answer(self.runs, self.seconds, choice))

    def charge(self, runs: float) -> None:
        """Count passes of the filter; Spent once the budget is over."""
        self.runs += runs
        self.check()

    def check(self) -> None:
        """Raise Spent once the budget is over, or an end is asked for."""
        if self.runs > self.budget.runs or self.seconds > self.budget.seconds or self.stop():
            raise Spent

    def refuse_worse(self) -> None:
        """Return to what was given if the best is worse on the same runs, by objective and likelihood."""
        before = [self.start] if self.given is None else [self.start, self.given]
        earlier = [choice for choice in before if not same_filter(choice, self.best)]
        names = self.objective, LIKELIHOOD
        with self.uncounted():
            new_scores = [self._value(self.best, name, self.data) for name in names]
            values = [[self._value(choice, name, self.data) for name in names] for choice in earlier]
        worse = [
            (scores[0], i)
            for i, scores in enumerate(values)
            if all(not new <= old + ROUNDING * abs(old) for new, old in zip(new_scores, scores, strict=True))
        ]
        if worse:
            least, i = min(worse, key=lambda pair: math.inf if math.isnan(pair[0]) else pair[0])
            self.answers.append(Answer(self.runs, self.seconds, earlier[i]))
            self.refused = Refused(least, new_scores[0])

    @contextmanager
    def uncounted(self) -> Iterator[None]:
        """Within this context no time passes: it is that of compilation, or of measuring prices."""
        begin, before = time.process_time(), self._excluded
        try:
            yield
        finally:
            self._excluded = before + time.process_time() - begin  # what was within this is part of it

    def value(self, choice: Choice, objective: str | None = None, data: Sequence[Data] | None = None) -> float:
        """An objective of a choice on all training runs, the mean over problems, as a study has it.

        Args:
            choice: of which.
            objective: the task's if None.
            data: the same runs as a filter shall see them; the task's if None.
        """
        name = self.objective if objective is None else objective
        if ("value", name) not in self._seen:
            self._seen.add(("value", name))
            with self.uncounted():
                self._value(self.start, name, [runs.slice(0, 1) for runs in self.data])
        value = self._value(choice, name, self.data if data is None else data)
        self.charge(self.passes)
        return value

    def _value(self, choice: Choice, name: str, data: Sequence[Data]) -> float:
        objective, values = find_objective(name), []
        for problem, batch in zip(self.problems, data, strict=True):
            filter_, needs = choice.filter(problem), objective.needs
            scale = problem.scale if LOG_SCORES in needs else None
            runs = metrics_of_all(filter_, batch, NEES in needs, bool(objective.output), scale)
            evaluation = compute_metrics(filter_, runs, batch, problem.scale, False, VARIANCES in needs)
            values.append(penalised(objective.value(evaluation, math.nan), evaluation))
        return float(np.mean(values))

    def goal(self, objective: str, keeps: bool = True, information: bool = False) -> Objective:
        """What gradients of an objective lead to: each evaluation counts; by default the best point is kept.

        Args:
            objective: by its name.
            keeps: whether the best point is kept.
            information: whether evaluations are with Fisher's information, which is priced.
        """
        best: dict[tuple, float] = {}
        last = objective, self.passes

        def watch(goal: Objective, point: np.ndarray, here: Evaluation) -> None:
            self.charge(prices[goal.objective] * len(here.part_values))
            if not keeps:
                return
            key = goal.objective, len(here.part_values)
            if (
                np.isfinite(here.value)
                and here.value > best.get(key, -math.inf)
                and (key == last or last not in best)
            ):
                best[key] = here.value
                self.keep(goal.choice_at(point))

        with self.uncounted():
            arguments = self.start, self.problems, self.data, self.free, objective
            goal = objective_of(*arguments, information=information, watch=watch)
            needed = {objective, LIKELIHOOD} if goal.is_of_squares else {objective}
            unwatched = {name: Objective(goal.parts, name, information=information) for name in needed}
            prices = {name: self._price_of_gradients(plain) for name, plain in unwatched.items()}
        return goal

    def _price_of_gradients(self, plain: Objective) -> float:
        few, point = plain.of_few(FEW), plain.start
        return self.price("information" if plain.informative else plain.objective, lambda: few(point))

    def price(self, name: str, call: Callable[[], object]) -> float:
        """What a call over the first 32 runs takes, in passes of the filter, at least 1: measured once a name."""
        if name not in self._prices:
            with self.uncounted():
                few = [runs.slice(0, FEW) for runs in self.data]
                plain = shortest(lambda: self._value(self.start, LIKELIHOOD, few))
                self._prices[name] = max(shortest(call) / plain, 1.0)
        return self._prices[name]

    def model(self, choice: Choice, index: int = 0) -> StateSpaceModel:
        """The model that a choice's filter assumes: of a linear filter its affine approximation."""
        return choice.filter(self.problems[index]).kernel_model


def stationary(model: StateSpaceModel, name: str, method: str) -> Stationary:
    """The matrices of a linear model; ValueError for another one."""
    about = np.zeros(model.n), np.zeros(model.inputs)
    away = np.ones(model.n) * model.scales, np.ones(model.inputs)
    matrices, other = (linearize(model, *point).matrices() for point in (about, away))
    pairs = zip(matrices, other, strict=True)
    if not all(
        np.allclose(first, two, rtol=ALIKE, atol=ALIKE * max(abs(first).max(initial=0), 1.0))
        for first, two in pairs
    ):
        raise ValueError(
            f"method {method!r} needs a linear model, such as that of the filter kf, but {name} has another one"
        )
    return Stationary(*matrices)


def shortest(call: Callable[[], object]) -> float:
    """The shortest of some calls, after one that may compile [s of processor time]."""
    call()
    seconds = []
    for _ in range(TIMED):
        begin = time.process_time()
        call()
        seconds.append(time.process_time() - begin)
    return max(min(seconds), 1e-6)


def way_out(name: str) -> str:
    """How P0 is not tuned, for the message of a method that cannot; nothing for other parameters."""
    if name != "P0":
        return ""
    return (
        f", as the first steps of runs are scored: leave out {FIRST_SCORED_STEP} of them (first_scored_step="
        f"{FIRST_SCORED_STEP} of RunsProblem), or take method 'likelihood'"
    )


def within_first_range(parameter: Parameter) -> Parameter:
    """A parameter of Q or R in the part of its range in which a search begins."""
    return (
        parameter
        if parameter.first is None
        else replace(parameter, low=parameter.first[0], high=parameter.first[1], default=None)
    )


class Method(NamedTuple):
    """A method that finds a filter's numbers."""

    about: str  # what it does, in one sentence
    when: str  # when to use it
    function: Callable[[Task], None]  # keeps choices of a task until it is done, or the task raises Spent
    source: str
    needs: tuple[str, ...] = ()  # of the above
    # Options of the model's numbers with which it can work.
    options: tuple[str, ...] = OPTIONS
    by_trials: bool = False  # whether it ends after a number of trials; others have their own criterion
    sampler: str = ""  # of a study; empty if the method runs alone

    @property
    def is_study(self) -> bool:
        """Whether it is a study, which draws its runs, tries the baselines and validates its best trials."""
        return bool(self.sampler)

    def check(self, name: str, task: Task) -> None:
        """Raise ValueError if a task lacks what the method needs."""
        if not has_search_space(task.filter):
            raise ValueError(f"filter must be one that has something to tune, but got {task.filter!r}")
        if GRADIENT in self.needs:
            check_gradient(task.filter, f"a filter for method {name!r}")
        if COVARIANCE in self.needs and not filter_type(task.filter).has_covariance:
            raise ValueError(f"method {name!r} needs a filter with a covariance, but got {task.filter!r}")
        if INFLATION in self.needs and INFLATION not in filter_type(task.filter).numbers:
            raise ValueError(f"method {name!r} tunes the inflation of an ensemble, but {task.filter!r} has none")
        if TRUTH in self.needs and not task.has_truth:
            pairs = zip(task.problems, task.data, strict=True)
            lacking = next(problem.name for problem, data in pairs if problem.scale is None or data.states is None)
            raise ValueError(f"method {name!r} needs true states, but {lacking} has none")
        if NOISE in self.needs and not {Q, R} <= set(task.start.model):
            raise ValueError(
                f"method {name!r} tunes Q and R, but {task.problems[0].name} has parameters of its own"
            )
        if MODEL in self.needs and not task.free:
            raise ValueError(
                f"method {name!r} tunes the model, but {task.problems[0].name} has no free parameter of it"
            )
        if LINEAR in self.needs:
            stationary(task.model(task.start), task.problems[0].name, name)
        if NUTPIE in self.needs and importlib.util.find_spec(NUTPIE) is None:
            raise ValueError(f"method {name!r} needs {NUTPIE}, which is not installed: {to_install('nuts')}")
        unable = [option for option, wanted in task.options.items() if wanted and option not in self.options]
        if unable:
            rest = f": P0 is tuned{way_out('P0')}" if "prior" in unable else ""
            raise ValueError(f"method {name!r} must come without {', '.join(unable)}{rest}")

    def run(self, name: str, task: Task, guarded: bool = True) -> None:
        """Run the method until it is done or the budget spent; ValueError if the task lacks what it needs.

        The answer is `task.best`; `task.answers` holds those for smaller budgets. If the answer is worse than the
        start or the model's own numbers, these replace it (`task.refused`).
        """
        self.check(name, task)
        try:
            self.function(task)
        except Spent:
            pass
        if guarded and not task.stop():  # whoever asks for an end waits for no more
            task.refuse_worse()


def study(task: Task) -> None:
    """Trials of the objective, of the ensemble size, too, with the mean NIS in a band.

    The first trials are the baselines and the maximum-likelihood values. The best trials then meet the baselines
    on validation seeds, and the best baseline is chosen unless one of them is significantly better
    (docs/appendix/tuning.md).
    """
    raise ValueError("a study must be run by tuning.tune or thruster tune, but got a task")


def gradient(task: Task) -> None:
    """The maximum of log L, or the least score, mse or log-score if that is the objective, with standard errors.

    A study by `tpe` runs beside it. The optimum meets the baselines on validation seeds, as trials do.
    """
    study(task)


METHODS: dict[str, Method] = {  # studies; `method` adds those that run alone
    DEFAULT: Method(
        "the default: a study by Optuna's tree-structured Parzen estimator, its best trials validated",
        "for any filter and objective, also for an ensemble's size and among filters",
        study,
        TPE,
        sampler="tpe",
    ),
    "gp": Method(
        "the same study by Optuna's Gaussian process",
        "for any filter, if a trial takes seconds",
        study,
        GAUSSIAN,
        sampler="gp",
    ),
    "cma-es": Method(
        "the same study by covariance matrix adaptation",
        "for any filter, with hundreds of trials",
        study,
        HANSEN,
        sampler="cma-es",
    ),
    "nsga-ii": Method(
        "the same study by a genetic algorithm",
        "with two objectives, for a Pareto front",
        study,
        "Deb, Pratap, Agarwal, Meyarivan (2002)",
        sampler="nsga-ii",
    ),
    "random": Method(
        "the same study by independent draws",
        "to compare: every sampler has to beat it",
        study,
        UNIFORM,
        sampler="random",
    ),
    "grid": Method(
        "the same study over five values of each parameter, in random order",
        "with up to three parameters, to see the whole range",
        study,
        UNIFORM,
        sampler="grid",
    ),
    GRADIENT_METHOD: Method(
        "`likelihood` with standard errors, or `score`, `mse` or `log-score` if that is the objective, validated; "
        "a study by `tpe` runs beside it",
        "for Kalman filters, if the accuracy of Q and R counts, too",
        gradient,
        "Gupta, Mehra (1974)",
        (GRADIENT,),
        sampler="tpe",
    ),
}

ALONE: dict[str, Method] = {}  # those that run alone


def method(
    name: str,
    about: str,
    when: str,
    source: str,
    needs: tuple[str, ...] = (),
    options: tuple[str, ...] = OPTIONS,
    by_trials: bool = False,
) -> Callable[[F], F]:
    """The decorator that registers a function as the method of a name; for the other arguments see `Method`."""

    def register(function: F) -> F:
        METHODS[name] = ALONE[name] = Method(about, when, function, source, needs, options, by_trials)
        return function

    return register


def find_method(name: str) -> Method:
    """A method by its name; ValueError for an unknown one."""
    return METHODS[one_of("method", name, tuple(METHODS))]
