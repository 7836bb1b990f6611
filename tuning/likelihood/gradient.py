"""Parameters by gradients: of maximum likelihood of the innovations, or of the best score on the true states."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from filters.consistency.nees import pooled_mean
from filters.differentiated import recursion
from filters.differentiated.runs import ModelSlopes, Truth
from thruster_env.core.checks import one_of
from thruster_env.core.sources import is_array
from thruster_env.model.state_space import StateSpaceModel
from tuning.evaluation.runs import metrics_of_all
from tuning.likelihood.ascent import Evaluation, lbfgs
from tuning.likelihood.family import Family, check_gradient
from tuning.likelihood.identifiability import KNOWN_WITHIN, TWO_SIDED
from tuning.problems.data import Data
from tuning.problems.problem import Parameter, Problem
from tuning.search.objectives import LIKELIHOOD, LOG_SCORE, MSE, SCORE
from tuning.search.parameters import MeasurementVariance, ProcessVariance, model_parameters
from tuning.search.space import Choice, neutral, untuned_choice

OF_STATES = {  # objectives on the true states: what of them is summed over steps
    SCORE: recursion.SQUARES,
    MSE: recursion.SQUARES,
    LOG_SCORE: recursion.LOG_SCORE,
}
BAD_START = (1.0, 1e-2, 1e2)  # factors on Q11, Q22 and R, far from the optimum
STEP = 1e-3  # in coordinates, of the differences of gradients that give the Hessian
FLAT = 1e-12  # curvature relative to the largest one, below which a direction counts as flat
EQUAL = 0.02  # optima this close in every coordinate are the same
SAME_LEVEL = 1e-4  # relative difference of their levels, up to which they may be
FEW_RUNS = 4  # with which the search for a model of many states begins
COARSE = 1e-9  # relative decrease of -log L that ends a search for a model of many states: log L is some million
LINEAR_WITHIN = 2.5  # a quarter of the range, in coordinates of parameters on linear scales


class RunsObjective:
    """A function of coordinates that is to be maximised, and its gradient, for each run of some problems.

    It is the log-likelihood of a run; or minus the sum of an objective's terms over the scored steps of a run. Of
    several problems the mean of their objectives counts, as in a study, and the likelihood of all their runs.

    The score, sum_i sqrt(M_i) / (n s_i) with M_i the mean square error of state i over all runs and s_i its scale,
    is that of squares with the weights w_i = 1 / (n s_i sqrt(M_i)), and its derivative half of theirs.

    Args:
        choice: of a Kalman filter.
        problems: make its models, which have the same parameters.
        data: of each problem.
        parameters: the p parameters.
        objective: "likelihood", "score", "mse" or "log-score".
        watch: called with this goal, the coordinates and what was found there, after each evaluation.

    Raises:
        ValueError: for another objective, one on true states without these, or a parameter that has no gradient.
    """

    def __init__(
        self,
        choice: Choice,
        problems: Sequence[Problem],
        data: Sequence[Data],
        parameters: Sequence[Parameter],
        objective: str = LIKELIHOOD,
        watch: Callable[[RunsObjective, np.ndarray, Evaluation], None] = lambda goal, point, evaluation: None,
    ):
        """Find the truth that counts."""
        self._watch = watch
        self.objective = one_of("objective", objective, (LIKELIHOOD, *OF_STATES))
        self._choice, self._problems, self._data = choice, tuple(problems), tuple(data)
        self._families = [Family(choice, problem, parameters) for problem in problems]
        self._truths = [self._truth(*those) for those in zip(problems, data, self._families, strict=True)]
        self.coordinates = self._families[0].coordinates
        self.steps = sum(int(runs.scored_counts.sum()) for runs in data)

    def __call__(self, point: np.ndarray, information: bool = False) -> Evaluation:
        """The sum over all runs at coordinates, with Fisher's information in the innovations if that is wanted."""
        blocks, matrices = [], []
        parts = zip(self._problems, self._data, self._families, self._truths, strict=True)
        for problem, data, family, truth in parts:
            score = OF_STATES.get(self.objective, recursion.LIKELIHOOD)
            if truth is not None and self.objective == SCORE:
                truth = truth._replace(weights=self._of_score(point, problem, data, family))
            out, of_runs = family.derivatives(point, data, score=score, truth=truth, information=information)
            blocks.append(out * self._weight(data))
            matrices.append(of_runs)
        runs = np.concatenate(blocks)
        if self.objective == SCORE:
            runs[:, 1:] *= 0.5
        values, scores = runs[:, 0], runs[:, 1:]
        total = np.concatenate(matrices).sum(axis=0)
        evaluation = Evaluation(float(values.sum()), scores.sum(axis=0), total, scores, values)
        self._watch(self, point, evaluation)
        return evaluation

    def by_noise(self, choice: Choice) -> tuple[float, np.ndarray, np.ndarray]:
        """The sum over all runs at a choice, and its derivatives by the matrices Q (n, n) and R (m, m).

        They are those of `Family.by_noise`, for every objective but the score, which is no sum over runs.
        """
        if self.objective == SCORE:
            raise ValueError(f"an objective whose slopes by matrices are known must not be {SCORE!r}")
        score, parts = OF_STATES.get(self.objective, recursion.LIKELIHOOD), []
        for data, family, truth in zip(self._data, self._families, self._truths, strict=True):
            values, by_q, by_r = family.by_noise(choice, data, score=score, truth=truth)
            parts.append([self._weight(data) * term for term in (values.sum(), by_q, by_r)])
        value, by_q, by_r = (np.sum(np.array(of_all), axis=0) for of_all in zip(*parts, strict=True))
        return float(value), by_q, by_r

    def model_at(self, point: np.ndarray) -> tuple[StateSpaceModel, ModelSlopes]:
        """The model of the first problem at coordinates, and its derivatives by them."""
        return self._families[0].at(point)

    def of_few(self, runs: int) -> RunsObjective:
        """The same of the first runs of each problem."""
        few = [data.slice(0, runs) for data in self._data]
        return RunsObjective(self._choice, self._problems, few, self.coordinates.free, self.objective, self._watch)

    def of(self, objective: str) -> RunsObjective:
        """Another objective of the same runs."""
        return RunsObjective(
            self._choice, self._problems, self._data, self.coordinates.free, objective, self._watch
        )

    @property
    def is_of_squares(self) -> bool:
        """Whether squared errors are minimised, in which the covariance does not count."""
        return self.objective in (SCORE, MSE)

    def choice_at(self, point: np.ndarray) -> Choice:
        """The choice at coordinates."""
        return self._families[0].choice_at(point)

    @property
    def untuned(self) -> np.ndarray:
        """The parameters of the choice that the goal was made of, (p,)."""
        values = [(parameter.get(self._choice), neutral(parameter.name)) for parameter in self.coordinates.free]
        return np.array([other if value is None else value for value, other in values], dtype=np.float64)

    @property
    def is_large(self) -> bool:
        """Whether a model has so many states that a run takes long."""
        return any(is_array(family.states, family.states) for family in self._families)

    @property
    def runs(self) -> int:
        """The most runs of a problem."""
        return max(len(runs.measurements) for runs in self._data)

    def level(self, value: float) -> float:
        """Log L of all runs for their sum; of other objectives their value, as a study has it."""
        return value if self.objective == LIKELIHOOD else -value / self.steps

    def unit(self, value: float) -> float:
        """In what information is counted at an optimum: in a log density, or in the mean square that remains."""
        if not self.is_of_squares:
            return 1.0
        counted = sum(int(np.isfinite(truth.states).sum()) for truth in self._truths if truth is not None)
        return (-2.0 if self.objective == MSE else -1.0) * value / counted

    def _weight(self, data: Data) -> float:
        if self.objective == LIKELIHOOD:
            return 1.0
        return self.steps / (len(self._data) * int(data.scored_counts.sum()))

    def _truth(self, problem: Problem, data: Data, family: Family) -> Truth | None:
        """The true states, NaN where the objective does not count them: those that the plant lacks, too."""
        if self.objective == LIKELIHOOD:
            return None
        if data.states is None or problem.scale is None:
            raise ValueError(f"objective must be {LIKELIHOOD!r} without true states, but got {self.objective!r}")
        scale = np.asarray(problem.scale, dtype=np.float64)
        known = np.where(data.scored[..., None] & np.isfinite(scale), data.states, np.nan)
        states = np.full((*known.shape[:2], family.states), np.nan)
        states[..., : len(scale)] = known
        weights = np.zeros(family.states)
        weights[: len(scale)] = 1.0 / np.square(scale)
        return Truth(states, weights)

    def _of_score(self, point: np.ndarray, problem: Problem, data: Data, family: Family) -> np.ndarray:
        """The weights of squares that give the score, (n,), from the filter's mean square errors."""
        metrics = metrics_of_all(family.choice_at(point).filter(problem), data, nees=False, outputs=False)
        scale, weights = np.asarray(problem.scale, dtype=np.float64), np.zeros(family.states)
        deviations = np.sqrt(pooled_mean(np.asarray(metrics.mean_squares), metrics.weights))
        with np.errstate(divide="ignore"):
            weights[: len(scale)] = 1.0 / (np.isfinite(scale).sum() * scale * deviations)
        return weights


class Optimum(NamedTuple):
    """The result of one start."""

    parameters: np.ndarray  # (p,)
    value: float  # what is maximised
    level: float  # log L of all training runs; or the objective as a study has it
    evaluations: int  # of that and its gradient
    converged: bool


class GradientResult(NamedTuple):
    """A maximum of the likelihood, or the minimum of another objective, and how well the data determine it."""

    choice: Choice
    free: tuple[Parameter, ...]
    best: Optimum
    starts: tuple[tuple[float, ...], ...]  # factors on the untuned parameters
    optima: tuple[Optimum, ...]  # one for each start
    standard_errors: np.ndarray  # (p,), of logarithms, or of parameters on linear scales; from the runs' scatter
    identified: np.ndarray  # (p,) whether a 95 % interval is within a factor of ten, or half of a linear range
    agree: bool  # whether all starts led to the same optimum, in its level and the identified parameters
    seconds: float
    objective: str = LIKELIHOOD

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(parameter.name for parameter in self.free)


def tune_by_gradient(
    filter_name: str,
    problems: Problem | Sequence[Problem],
    data: Data | Sequence[Data],
    starts: Sequence[Sequence[float] | float] | None = None,
    objective: str = LIKELIHOOD,
    options: Mapping[str, Any] | None = None,
) -> GradientResult:
    """Find the parameters of a model under which a Kalman filter's innovations are most likely.

    They are those of a study: the variances of Q and R, with `full_q` and `full_r` their
    correlations, or a problem's own. The
    search is L-BFGS-B in their coordinates, which are the logarithms of variances, with the gradient of
    `filters.differentiated` and within the ranges of an Optuna study. With the Hessian H of -log L and the
    gradients g_b of B independent runs, the standard errors are the roots of the diagonal of
    H^-1 (sum_b g_b g_b') H^-1, which holds for a wrong model, too.

    With true states the same search minimises the objectives "score", "mse" and "log-score" of a study. A common
    factor on Q and R changes a linear filter's errors only through the prior, so that the first two determine none
    (`optimum` keeps it near the likeliest one).

    Args:
        filter_name: a Kalman filter but "kf-steady", "gsf", "imm", "mmae", "mhe" and "fuzzy".
        problems: make the assumed models, and have the untuned parameters; ranges are those of the first.
        data: the training runs of each problem.
        starts: factors on the untuned parameters, one for all or one each; `starts_of` if None.
        objective: "likelihood", "score", "mse" or "log-score"; of several problems their mean.
        options: hold_r, full_q, full_r and prior of `model_parameters`.

    Raises:
        ValueError: for another filter or objective, for one on true states without these, or a parameter that
            changes functions of the model.

    Source: Huber (1967), "The behavior of maximum likelihood estimates under nonstandard conditions".
    """
    check_gradient(filter_name)
    begin = time.perf_counter()
    goal = goal_of(filter_name, problems, data, objective, options)
    free, coordinates = goal.coordinates.free, goal.coordinates
    factors = [_factors(start, len(free)) for start in (starts_of(free) if starts is None else starts)]
    optima = [optimum(goal, start_at(goal, start)) for start in factors]
    best = max(optima, key=lambda optimum: optimum.value)
    point = coordinates.of(best.parameters)
    errors = _standard_errors(goal, point, goal.unit(best.value))
    inside = (coordinates.low < point) & (point < coordinates.high)
    identified = inside & (errors * TWO_SIDED < np.where(coordinates.log, KNOWN_WITHIN, LINEAR_WITHIN))
    apart = [abs(coordinates.of(reached.parameters) - point)[identified] for reached in optima]
    levels = [abs(reached.level - best.level) <= SAME_LEVEL * max(abs(best.level), 1.0) for reached in optima]
    return GradientResult(
        choice=goal.choice_at(point),
        free=free,
        best=best,
        starts=tuple(factors),
        optima=tuple(optima),
        standard_errors=errors * coordinates.units,
        identified=identified,
        agree=all(levels) and all((distances < EQUAL).all() for distances in apart),
        seconds=time.perf_counter() - begin,
        objective=objective,
    )


def goal_of(
    filter_name: str,
    problems: Problem | Sequence[Problem],
    data: Data | Sequence[Data],
    objective: str = LIKELIHOOD,
    options: Mapping[str, Any] | None = None,
) -> RunsObjective:
    """What `tune_by_gradient` maximises, with the parameters of the first problem; arguments are its."""
    listed = [problems] if isinstance(problems, Problem) else list(problems)
    runs = [data] if isinstance(data, Data) else list(data)
    parameters = model_parameters(listed[0], **(options or {}))
    return RunsObjective(untuned_choice(filter_name, listed[0]), listed, runs, parameters, objective)


def start_at(goal: RunsObjective, factors: Sequence[float]) -> np.ndarray:
    """Coordinates of a start, given factors on the untuned parameters; those on linear scales stay untuned."""
    log = goal.coordinates.log
    return goal.coordinates.of(np.where(log, goal.untuned * np.asarray(factors), goal.untuned))


def optimum(goal: RunsObjective, start: np.ndarray) -> Optimum:
    """The maximum to which one start leads, without the standard errors of `tune_by_gradient`.

    Squared errors hardly know the scale of Q and R, nor what of them no estimate depends on: where these are
    minimised, the search begins at the likeliest parameters, and a weak prior about those counts, as one
    observation each would that says "within a factor of ten".

    For models with many states, whose likelihood takes long, the search is first on a few runs, and continues on
    all runs from there; it ends where an iteration gains less than 1e-9 of log L.

    Args:
        goal: what is maximised.
        start: coordinates.
    """
    prior = 0.0
    if goal.is_of_squares:
        first = goal.of(LIKELIHOOD)
        start = first.coordinates.of(optimum(first, start).parameters)
        prior = goal.unit(goal(start).value) / KNOWN_WITHIN**2
    point, large, evaluations = start, goal.is_large, 0
    for part in (goal.of_few(FEW_RUNS), goal) if large and goal.runs > FEW_RUNS else (goal,):
        minimum = _minimum(part, point, large, prior * (part.steps / goal.steps), start)
        point, evaluations = minimum.x, evaluations + minimum.nfev
    value = goal(point).value if prior else -float(minimum.fun)
    return Optimum(goal.coordinates.values(point), value, goal.level(value), evaluations, bool(minimum.success))


def _factors(start: Sequence[float] | float, count: int) -> tuple[float, ...]:
    return tuple(np.broadcast_to(np.asarray(start, dtype=np.float64), count).tolist())


def starts_of(parameters: Sequence[Parameter]) -> list[tuple[float, ...]]:
    """Three starts, as factors on the untuned parameters: 1, a bad start, and a small Q with a large R."""
    return [(1.0,) * len(parameters), tuple(map(_bad, parameters)), tuple(map(_small, parameters))]


def _small(parameter: Parameter) -> float:
    """The factor of a small Q with a large R; nothing of a number on a linear scale."""
    return 1.0 if not parameter.log else 10.0 if isinstance(parameter.place, MeasurementVariance) else 0.1


def _bad(parameter: Parameter) -> float:
    """The factor of a bad start: Q too small in every other state, R too large, as in BAD_START."""
    if not parameter.log:
        return 1.0
    if isinstance(parameter.place, MeasurementVariance):
        return BAD_START[2]
    return BAD_START[parameter.place.index % 2] if isinstance(parameter.place, ProcessVariance) else BAD_START[1]


def _minimum(goal: RunsObjective, first: np.ndarray, large: bool, prior: float, centre: np.ndarray):
    """L-BFGS-B on the sum over all runs and a prior about a centre, from a start."""

    def with_prior(point: np.ndarray) -> Evaluation:
        away, here = point - centre, goal(point)
        value, gradient = here.value - 0.5 * prior * (away @ away), here.gradient - prior * away
        return here._replace(value=value, gradient=gradient)

    options = {"ftol": COARSE, "maxcor": 2 * len(first)} if large else {}
    return lbfgs(with_prior, first, goal.coordinates.low, goal.coordinates.high, **options)


def _standard_errors(goal: RunsObjective, point: np.ndarray, unit: float = 1.0) -> np.ndarray:
    """Standard errors of coordinates, (p,): from the scatter between runs, or from the Hessian if larger.

    The Hessian is counted in a unit of what is maximised, which is 1 where that is a log density. In a direction
    in which the likelihood is flat both scatter and Hessian vanish, and the Hessian decides.
    """
    count = len(point)
    point = np.clip(point, goal.coordinates.low + STEP, goal.coordinates.high - STEP)
    hessian = np.empty((count, count))
    for i, step in enumerate(STEP * np.eye(count)):
        above, below = (goal(point + sign * step).gradient for sign in (1, -1))
        hessian[i] = (below - above) / (2 * STEP)
    if not np.isfinite(hessian).all():  # the filter diverges
        return np.full(count, np.inf)
    values, axes = np.linalg.eigh((hessian + hessian.T) / 2)
    values = np.maximum(values, FLAT * abs(values).max())
    scores = goal(point).scores @ axes / values
    scores -= scores.mean(axis=0)
    scatter = axes @ (scores.T @ scores) @ axes.T * len(scores) / (len(scores) - 1)
    return np.sqrt(np.maximum(np.diag(scatter), unit * np.diag(axes / values @ axes.T)))
