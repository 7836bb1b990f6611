"""Q and R by gradients: of maximum likelihood of the innovations, or of the best score at the true states."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from filters.differentiated.recursion import LOG_SCORE as OF_BELIEF
from filters.differentiated.recursion import SQUARES
from filters.likelihood import Likelihood, likelihood
from filters.state_scores import state_score
from numerics.checks import one_of
from numerics.sources import is_array
from tuning.likelihood.identifiability import KNOWN_WITHIN, TWO_SIDED
from tuning.likelihood.noise import noise_family
from tuning.problems.data import Data
from tuning.problems.parameter import Parameter
from tuning.problems.problem import Problem
from tuning.search.objectives import LIKELIHOOD, LOG_SCORE, MSE
from tuning.search.parameters import MeasurementVariance, ProcessVariance, model_parameters
from tuning.search.space import Choice, untuned_choice

DIFFERENTIABLE = ("kf", "ekf")
OF_STATES = {MSE: SQUARES, LOG_SCORE: OF_BELIEF}  # objectives on the true states that have a gradient
BAD_START = (1.0, 1e-2, 1e2)  # factors on Q11, Q22 and R, far from the optimum
STEP = 1e-3  # in the logarithms, of the differences of gradients that give the Hessian
FLAT = 1e-12  # curvature relative to the largest one, below which a direction counts as flat
DIVERGED = 1e12  # in place of -log L where the filter diverges
EQUAL_LOGARITHMS = 0.02  # optima this close in every logarithm are the same
PRECISE = 1e-13  # relative decrease of -log L below which the search ends
FEW_RUNS = 4  # with which the search for a model of many states begins
COARSE = 1e-9  # the same for models of many states, whose log L is of the order of a million


class Optimum(NamedTuple):
    """The result of one start."""

    start: tuple[float, ...]  # factors on the untuned parameters
    variances: np.ndarray  # (p,), the diagonals of Q, then of R; or the problem's parameters
    value: float  # what is maximised: log L of all training runs; or - objective x scored steps
    evaluations: int  # of that and its gradient
    converged: bool


class GradientResult(NamedTuple):
    """A maximum of the likelihood, or the minimum of another objective, and how well the data determine it."""

    choice: Choice
    names: tuple[str, ...]  # of the parameters
    best: Optimum
    optima: tuple[Optimum, ...]  # one for each start
    standard_errors: np.ndarray  # (p,), of the parameters' logarithms, from the scatter between runs
    identified: np.ndarray  # (p,) whether a parameter's 95 % interval is within a factor of ten
    agree: bool  # whether all starts led to the same optimum, in the identified variances
    seconds: float
    objective: str = LIKELIHOOD
    steps: int = 1  # scored steps of all runs

    def level(self, optimum: Optimum) -> float:
        """Log L of all runs at an optimum; of other objectives their value there, as a study has it."""
        return optimum.value if self.objective == LIKELIHOOD else -optimum.value / self.steps


def maximise_likelihood(
    filter_name: str,
    problem: Problem,
    data: Data,
    starts: Sequence[Sequence[float] | float] | None = None,
    objective: str = LIKELIHOOD,
) -> GradientResult:
    """Find the diagonal Q and R under which a Kalman filter's innovations are most likely.

    The search is L-BFGS-B in the logarithms of the variances with the gradient of `filters.likelihood`, within the
    same ranges as an Optuna study. With the Hessian H of -log L and the gradients g_b of B independent runs, the
    standard errors are the roots of the diagonal of H^-1 (sum_b g_b g_b') H^-1, which holds for a wrong model,
    too. If the problem has its own parameters, which determine Q and R, these are estimated.

    With true states the same search minimises the objectives "log-score" and "mse" of a study, by the gradients of
    `filters.state_scores`. A common factor on Q and R changes the mse of a linear filter only through the prior,
    so that the mse determines none, and its covariance is of no use.

    Args:
        filter_name: "kf" or "ekf".
        problem: makes the assumed model, and has the untuned variances.
        data: the training runs.
        starts: factors on the untuned parameters, one for all or one each, (Q11, Q22, ..., R); `starts_of` if
            None.
        objective: "likelihood", "log-score" or "mse".

    Raises:
        ValueError: for another filter or objective, for one on true states without these, or a parameter of the
            problem that changes more than Q and R.

    Source: Huber (1967), "The behavior of maximum likelihood estimates under nonstandard conditions".
    """
    one_of("filter", filter_name, DIFFERENTIABLE)
    one_of("objective", objective, (LIKELIHOOD, *OF_STATES))
    begin = time.perf_counter()
    parameters = model_parameters(problem)
    untuned = untuned_choice(filter_name, problem)
    noise_at = noise_family(untuned, problem, parameters)
    bounds = [tuple(np.log([one.low, one.high])) for one in parameters]
    given = starts_of(parameters) if starts is None else starts
    optima = [optimum(filter_name, problem, data, start, objective) for start in given]
    best = max(optima, key=lambda optimum: optimum.value)
    steps, unit = int(data.scored_counts.sum()), 1.0
    if objective == MSE:  # as in least squares, information is counted in the mean square that remains
        unit = -2.0 * best.value / np.isfinite(_counted(problem, data, objective)).sum()
    errors = _standard_errors(slopes_of(problem, noise_at, data, objective), np.log(best.variances), unit)
    inside = np.array(
        [low < value < high for value, (low, high) in zip(np.log(best.variances), bounds, strict=True)]
    )
    identified = inside & (errors * TWO_SIDED < KNOWN_WITHIN)
    apart = [np.abs(np.log(o.variances / best.variances))[identified] for o in optima]
    choice = untuned
    for one, value in zip(parameters, best.variances.tolist(), strict=True):
        choice = one.set(choice, value)
    return GradientResult(
        choice=choice,
        names=tuple(one.name for one in parameters),
        best=best,
        optima=tuple(optima),
        standard_errors=errors,
        identified=identified,
        agree=all((distances < EQUAL_LOGARITHMS).all() for distances in apart),
        seconds=time.perf_counter() - begin,
        objective=objective,
        steps=steps,
    )


def optimum(
    filter_name: str,
    problem: Problem,
    data: Data,
    start: Sequence[float] | float = 1.0,
    objective: str = LIKELIHOOD,
) -> Optimum:
    """The maximum to which one start leads, without the standard errors of `maximise_likelihood`.

    For models with many states, whose likelihood takes long, the search is first on a few runs, and continues on
    all runs from there; it ends where an iteration gains less than 1e-9 of log L.

    Args:
        filter_name: "kf" or "ekf".
        problem: as for `maximise_likelihood`.
        data: the training runs.
        start: factors on the untuned parameters, one for all or one each, (Q11, Q22, ..., R).
        objective: as for `maximise_likelihood`.
    """
    parameters = model_parameters(problem)
    untuned = untuned_choice(filter_name, problem)
    reference = np.array([one.get(untuned) for one in parameters], dtype=np.float64)
    noise_at = noise_family(untuned, problem, parameters)
    bounds = [tuple(np.log([one.low, one.high])) for one in parameters]
    factors = np.broadcast_to(np.asarray(start, dtype=np.float64), reference.shape)
    point, count = np.log(reference * factors), len(data.measurements)
    large = is_large(problem)
    for runs in (FEW_RUNS, count) if large and count > FEW_RUNS else (count,):
        found = _minimum(slopes_of(problem, noise_at, data.slice(0, runs), objective), point, bounds, large)
        point = found.x
    return Optimum(tuple(factors.tolist()), np.exp(point), -found.fun, found.nfev, bool(found.success))


def slopes_of(
    problem: Problem, noise_at: Callable, data: Data, objective: str = LIKELIHOOD
) -> Callable[[np.ndarray], Likelihood]:
    """Log-likelihood of each run (B,), and its gradients (B, p), as a function of the logarithms of parameters.

    The lead-in of runs, in which the filter settles, is left out of both. Of another objective it is minus the sum
    of its terms over the scored steps.
    """
    if objective != LIKELIHOOD:
        return _of_states(problem, noise_at, data, objective)
    beginning = data.beginning if problem.leads_in and data.first_scored else None

    def slopes(logarithms: np.ndarray) -> Likelihood:
        values = np.exp(logarithms)
        found = likelihood(*noise_at(values, data))
        if beginning is None:
            return found
        before = likelihood(*noise_at(values, beginning))
        return Likelihood(found.values - before.values, found.gradients - before.gradients)

    return slopes


def _of_states(problem: Problem, noise_at: Callable, data: Data, objective: str) -> Callable:
    truth, score = _counted(problem, data, objective), OF_STATES[objective]
    weights = 1.0 / np.square(np.asarray(problem.scale, dtype=np.float64))

    def slopes(logarithms: np.ndarray) -> Likelihood:
        model, inputs, measurements, q_slopes, r_slopes = noise_at(np.exp(logarithms), data)
        return state_score(model, inputs, measurements, truth, q_slopes, r_slopes, score, weights)

    return slopes


def _counted(problem: Problem, data: Data, objective: str) -> np.ndarray:
    """The true states, NaN where an objective does not count them."""
    if data.states is None or problem.scale is None:
        raise ValueError(f"objective must be {LIKELIHOOD!r} without true states, but got {objective!r}")
    return np.where(data.scored[..., None] & np.isfinite(problem.scale), data.states, np.nan)


def is_large(problem: Problem) -> bool:
    """Whether a problem's model has so many states that its likelihood takes long."""
    count = len(problem.quantities.states)
    return is_array(count, count)


def _minimum(slopes: Callable, first: np.ndarray, bounds: list, large: bool):
    """The minimum of -log L of all runs, from a start in logarithms."""
    from scipy.optimize import minimize

    def negative(logarithms: np.ndarray) -> tuple[float, np.ndarray]:
        found = slopes(logarithms)
        value, gradient = -found.values.sum(), -found.gradients.sum(axis=0)
        if np.isfinite(value) and np.isfinite(gradient).all():
            return value, gradient
        return DIVERGED, np.zeros_like(gradient)  # the line search takes a shorter step

    options = {"ftol": COARSE, "maxcor": 2 * len(first)} if large else {"ftol": PRECISE}
    return minimize(negative, first, jac=True, bounds=bounds, method="L-BFGS-B", options=options)


def starts_of(parameters: Sequence[Parameter]) -> list[tuple[float, ...]]:
    """Three starts, as factors on the untuned parameters: 1, a bad start, and a small Q with a large R."""
    channels = [isinstance(one.place, MeasurementVariance) for one in parameters]
    return [(1.0,) * len(parameters), tuple(map(_bad, parameters)), tuple(10.0 if r else 0.1 for r in channels)]


def _bad(parameter: Parameter) -> float:
    """The factor of a bad start: Q too small in every other state, R too large, as in BAD_START."""
    if isinstance(parameter.place, MeasurementVariance):
        return BAD_START[2]
    return BAD_START[parameter.place.index % 2] if isinstance(parameter.place, ProcessVariance) else BAD_START[1]


def _standard_errors(slopes: Callable, logarithms: np.ndarray, unit: float = 1.0) -> np.ndarray:
    """Standard errors of the logarithms, (p,): from the scatter between runs, or from the Hessian if larger.

    The Hessian is counted in a unit of what is maximised, which is 1 where that is a log density. In a direction
    in which the likelihood is flat both scatter and Hessian vanish, and the Hessian decides.
    """
    count = len(logarithms)
    hessian = np.empty((count, count))
    for i, step in enumerate(STEP * np.eye(count)):
        above, below = (slopes(logarithms + sign * step).gradients.sum(axis=0) for sign in (1, -1))
        hessian[i] = (below - above) / (2 * STEP)
    values, axes = np.linalg.eigh((hessian + hessian.T) / 2)
    values = np.maximum(values, FLAT * abs(values).max())
    scores = slopes(logarithms).gradients @ axes / values
    scores -= scores.mean(axis=0)
    scatter = axes @ (scores.T @ scores) @ axes.T * len(scores) / (len(scores) - 1)
    return np.sqrt(np.maximum(np.diag(scatter), unit * np.diag(axes / values @ axes.T)))
