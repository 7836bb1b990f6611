"""Parameters by gradients: of maximum likelihood of the innovations, or of the best score on the true states."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from tuning.likelihood.ascent import Evaluation, lbfgs
from tuning.likelihood.identifiability import KNOWN_WITHIN, TWO_SIDED
from tuning.likelihood.objective import Objective
from tuning.likelihood.parametric import Family, check_gradient
from tuning.problems.data import Data
from tuning.problems.problem import Parameter, Problem
from tuning.search.parameters import MeasurementVariance, ProcessVariance, model_parameters
from tuning.search.plan import LIKELIHOOD
from tuning.search.space import Choice, untuned_choice

BAD_START = (1.0, 1e-2, 1e2)  # factors on Q11, Q22 and R, far from the optimum
STEP = 1e-3  # in coordinates, of the differences of gradients that give the Hessian
FLAT = 1e-12  # curvature relative to the largest one, below which a direction counts as flat
EQUAL = 0.02  # optima this close in every coordinate are the same
SAME_LEVEL = 1e-4  # relative difference of their levels, up to which they may be
FEW_RUNS = 4  # with which the search for a model of many states begins
COARSE = 1e-9  # relative decrease of -log L that ends a search for a model of many states: log L is some million
LINEAR_WITHIN = 2.5  # a quarter of the range, in coordinates of parameters on linear scales


def objective_of(
    choice: Choice,
    problems: Sequence[Problem],
    data: Sequence[Data],
    parameters: Sequence[Parameter],
    objective: str = LIKELIHOOD,
    **options: Any,
) -> Objective:
    """The objective of a Kalman filter's parameters on the data of each problem; options are of `Objective`."""
    pairs = zip(problems, data, strict=True)
    return Objective([Family(choice, problem, parameters, runs) for problem, runs in pairs], objective, **options)


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
) -> Objective:
    """What `tune_by_gradient` maximises, with the parameters of the first problem; arguments are its."""
    listed = [problems] if isinstance(problems, Problem) else list(problems)
    runs = [data] if isinstance(data, Data) else list(data)
    parameters = model_parameters(listed[0], **(options or {}))
    return objective_of(untuned_choice(filter_name, listed[0]), listed, runs, parameters, objective)


def start_at(goal: Objective, factors: Sequence[float]) -> np.ndarray:
    """Coordinates of a start, given factors on the untuned parameters; those on linear scales stay untuned."""
    log = goal.coordinates.log
    return goal.coordinates.of(np.where(log, goal.untuned * np.asarray(factors), goal.untuned))


def optimum(goal: Objective, start: np.ndarray) -> Optimum:
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
        first = goal.with_changes(objective=LIKELIHOOD)
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


def _minimum(goal: Objective, first: np.ndarray, large: bool, prior: float, centre: np.ndarray):
    """L-BFGS-B on the sum over all runs and a prior about a centre, from a start."""

    def with_prior(point: np.ndarray) -> Evaluation:
        away, here = point - centre, goal(point)
        value, gradient = here.value - 0.5 * prior * (away @ away), here.gradient - prior * away
        return here._replace(value=value, gradient=gradient)

    options = {"ftol": COARSE, "maxcor": 2 * len(first)} if large else {}
    return lbfgs(with_prior, first, goal.coordinates.low, goal.coordinates.high, **options)


def _standard_errors(goal: Objective, point: np.ndarray, unit: float = 1.0) -> np.ndarray:
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
