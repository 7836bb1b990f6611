"""Maxima of objectives along their gradients: Fisher scoring and L-BFGS-B.

An objective is a function of coordinates (p,) that returns an `Evaluation`: a log-likelihood or another sum over
runs, which is to be maximised.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from tuning.problems.problem import Coordinates

ITERATIONS = 60  # at most
ENOUGH = 1e-4  # predicted rise in log-likelihood below which the search ends
LONGEST = 1.5  # longest step, in coordinates
LEAST_CURVATURE = 1e-6  # of the largest one; fixes directions on which the data have no information
DIVERGED = 1e12  # in place of minus the objective where the filter diverges
PRECISE = 1e-13  # relative decrease of minus the objective below which L-BFGS-B ends


class Evaluation(NamedTuple):
    """An objective, such as a log-likelihood, and its derivatives in coordinates at one point."""

    value: float  # of all runs
    gradient: np.ndarray  # (p,)
    information: np.ndarray  # (p, p), Fisher, or differences of the gradient; (0, 0) where nobody asked for it
    scores: np.ndarray  # (runs or blocks of them, p), gradients of parts that are nearly independent
    part_values: np.ndarray  # (runs or blocks of them,), values of the same parts


class Ascent(NamedTuple):
    """The end of a search."""

    at: np.ndarray  # (p,), coordinates
    found: Evaluation
    iterations: int
    converged: bool


class Ascending(Protocol):
    """What `climb` maximises: value, gradient and information at coordinates (p,) within their ranges."""

    coordinates: Coordinates

    def __call__(self, point: np.ndarray, /) -> Evaluation:
        """The evaluation at coordinates."""
        ...


def climb(
    objective: Ascending,
    start: np.ndarray,
    *,
    fixed: np.ndarray | None = None,
    iterations: int = ITERATIONS,
    enough: float = ENOUGH,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[np.ndarray, Evaluation], None] = lambda at, evaluation: None,
) -> Ascent:
    """Maximise a log-likelihood by steps d of (J + lambda diag J) d = g, Fisher information J and gradient g.

    lambda falls where the log-likelihood rises as predicted, and grows where it does not. Parameters at an end of
    their range whose gradient points outwards stay there.

    Args:
        objective: value, gradient and information at coordinates (p,).
        start: coordinates (p,) where the search begins.
        fixed: which parameters are held, (p,) bool.
        iterations: largest number of iterations.
        enough: predicted rise in log-likelihood below which the search ends.
        stop: called before each iteration; True ends the search.
        progress: called with coordinates and evaluation after each rise.

    Source: Osborne (1992), "Fisher's method of scoring", International Statistical Review 60(1); Marquardt (1963).
    """
    low, high = objective.coordinates.low, objective.coordinates.high
    at, damping = np.clip(start, low, high), 1e-3
    here = objective(at)
    fixed = np.zeros(len(at), dtype=bool) if fixed is None else fixed
    quiet = 0
    for number in range(iterations):
        if stop() or not _usable(here):
            return Ascent(at, here, number, False)
        progress(at, here)
        outward = ((at <= low) & (here.gradient < 0)) | ((at >= high) & (here.gradient > 0))
        moving = ~(fixed | outward)
        if not moving.any():
            return Ascent(at, here, number, True)
        g, j = here.gradient[moving], here.information[np.ix_(moving, moving)]
        curvature = np.maximum(np.diag(j), LEAST_CURVATURE * max(np.diag(j).max(), 1e-300))
        while True:
            step = np.zeros(len(at))
            matrix = _positive(j) + np.diag(damping * curvature + LEAST_CURVATURE * curvature.max())
            step[moving] = np.linalg.solve(matrix, g)
            step *= min(1.0, LONGEST / max(np.abs(step).max(), 1e-300))
            trial = np.clip(at + step, low, high)
            promised = here.gradient @ (trial - at) * 0.5
            if promised < enough or damping > 1e10:
                return Ascent(at, here, number, True)
            next_one = objective(trial)
            rise = next_one.value - here.value if _usable(next_one) else -np.inf
            if rise > 0.05 * promised:
                break
            damping = max(10.0 * damping, 1e-3)
            if stop():
                return Ascent(at, here, number, False)
        damping = damping / 5.0 if rise > 0.5 * promised else damping
        quiet = quiet + 1 if rise < 20 * enough else 0
        at, here = trial, next_one
        if quiet > 3:
            return Ascent(at, here, number + 1, True)
    return Ascent(at, here, iterations, False)


def _usable(evaluation: Evaluation) -> bool:
    return bool(
        np.isfinite(evaluation.value)
        and np.isfinite(evaluation.gradient).all()
        and np.isfinite(evaluation.information).all()
    )


def _positive(information: np.ndarray) -> np.ndarray:
    """An information matrix with positive eigenvalues: differences of gradients may make some negative."""
    values, axes = np.linalg.eigh(information)
    return axes * np.abs(values) @ axes.T


def lbfgs(
    evaluate: Callable[[np.ndarray], Evaluation], start: np.ndarray, low: np.ndarray, high: np.ndarray, **options
):
    """The result of L-BFGS-B on minus an objective, of which no information is needed.

    Where a filter diverges, or a covariance is singular by rounding, the line search takes a shorter step.

    Args:
        evaluate: value and gradient at coordinates (p,).
        start: coordinates (p,) where the search begins.
        low: the smallest coordinates.
        high: the largest ones.
        **options: of `scipy.optimize.minimize`.
    """
    from scipy.optimize import minimize

    def negative(point: np.ndarray) -> tuple[float, np.ndarray]:
        try:
            here = evaluate(point)
        except ValueError:
            return DIVERGED, np.zeros_like(point)
        if np.isfinite(here.value) and np.isfinite(here.gradient).all():
            return -here.value, -here.gradient
        return DIVERGED, np.zeros_like(point)

    bounds, options = list(zip(low, high, strict=True)), {"ftol": PRECISE} | options
    return minimize(negative, start, jac=True, bounds=bounds, method="L-BFGS-B", options=options)
