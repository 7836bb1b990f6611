"""The maximum of a log-likelihood within bounds, by Fisher scoring with Marquardt's damping."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tuning.identification.objective import Evaluation

ITERATIONS = 60  # at most
ENOUGH = 1e-4  # predicted rise in log-likelihood below which the search ends
LONGEST = 1.5  # longest step, in coordinates
LEAST_CURVATURE = 1e-6  # of the largest one; fixes directions on which the data have no information


class Ascent(NamedTuple):
    """The end of a search."""

    at: np.ndarray  # (p,), coordinates
    found: Evaluation
    iterations: int
    converged: bool


def climb(
    evaluate: Callable[[np.ndarray], Evaluation],
    start: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    *,
    fixed: np.ndarray | None = None,
    iterations: int = ITERATIONS,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[np.ndarray, Evaluation], None] = lambda at, evaluation: None,
) -> Ascent:
    """Maximise a log-likelihood by steps d of (J + lambda diag J) d = g, Fisher information J and gradient g.

    lambda falls where the log-likelihood rises as predicted, and grows where it does not. Parameters at an end of
    their range whose gradient points outwards stay there.

    Args:
        evaluate: value, gradient and information at coordinates (p,).
        start: coordinates (p,) where the search begins.
        low: the smallest coordinates.
        high: the largest ones.
        fixed: which parameters are held, (p,) bool.
        iterations: largest number of iterations.
        stop: called before each iteration; True ends the search.
        progress: called with coordinates and evaluation after each rise.

    Source: Osborne (1992), "Fisher's method of scoring", International Statistical Review 60(1); Marquardt (1963).
    """
    at, damping = np.clip(start, low, high), 1e-3
    here = evaluate(at)
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
            if promised < ENOUGH or damping > 1e10:
                return Ascent(at, here, number, True)
            next_one = evaluate(trial)
            rise = next_one.value - here.value if _usable(next_one) else -np.inf
            if rise > 0.05 * promised:
                break
            damping = max(10.0 * damping, 1e-3)
            if stop():
                return Ascent(at, here, number, False)
        damping = damping / 5.0 if rise > 0.5 * promised else damping
        quiet = quiet + 1 if rise < 20 * ENOUGH else 0
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
