"""The maximum of a log-likelihood within bounds, by Fisher scoring with Marquardt's damping."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from tuning.identification.objective import Evaluation

ITERATIONS = 60  # at most
ENOUGH = 1e-4  # rise in log-likelihood that one more step promises, below which the search ends
LONGEST = 1.5  # a step, in coordinates
LEAST_CURVATURE = 1e-6  # of the largest one; keeps directions of which the data say nothing in place


class Ascent(NamedTuple):
    """Where a search ended."""

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
    held: np.ndarray | None = None,
    iterations: int = ITERATIONS,
    stop: Callable[[], bool] = lambda: False,
    progress: Callable[[np.ndarray, Evaluation], None] = lambda at, found: None,
) -> Ascent:
    """Climb a log-likelihood: steps d of (J + lambda diag J) d = g, with Fisher's information J and slopes g.

    lambda falls where a step rises as promised, and grows where it does not. Parameters at an end of their range
    that want to go on stay there.

    Args:
        evaluate: value, slopes and information at coordinates (p,).
        start: coordinates (p,) where it begins.
        low: the smallest coordinates.
        high: the largest ones.
        held: which parameters stay as they are, (p,) bool.
        iterations: at most.
        stop: asked before each; True ends the search.
        progress: told where it is after each rise.

    Source: Osborne (1992), "Fisher's method of scoring", International Statistical Review 60(1); Marquardt (1963).
    """
    at, found, damping = np.clip(start, low, high), None, 1e-3
    found = evaluate(at)
    held = np.zeros(len(at), dtype=bool) if held is None else held
    quiet = 0
    for number in range(iterations):
        if stop() or not _usable(found):
            return Ascent(at, found, number, False)
        progress(at, found)
        outward = ((at <= low) & (found.gradient < 0)) | ((at >= high) & (found.gradient > 0))
        moving = ~(held | outward)
        if not moving.any():
            return Ascent(at, found, number, True)
        g, j = found.gradient[moving], found.information[np.ix_(moving, moving)]
        curvature = np.maximum(np.diag(j), LEAST_CURVATURE * max(np.diag(j).max(), 1e-300))
        while True:
            step = np.zeros(len(at))
            matrix = _positive(j) + np.diag(damping * curvature + LEAST_CURVATURE * curvature.max())
            step[moving] = np.linalg.solve(matrix, g)
            step *= min(1.0, LONGEST / max(np.abs(step).max(), 1e-300))
            there = np.clip(at + step, low, high)
            promised = found.gradient @ (there - at) * 0.5
            if promised < ENOUGH or damping > 1e10:
                return Ascent(at, found, number, True)
            next_one = evaluate(there)
            rise = next_one.value - found.value if _usable(next_one) else -np.inf
            if rise > 0.05 * promised:
                break
            damping = max(10.0 * damping, 1e-3)
            if stop():
                return Ascent(at, found, number, False)
        damping = damping / 5.0 if rise > 0.5 * promised else damping
        quiet = quiet + 1 if rise < 20 * ENOUGH else 0
        at, found = there, next_one
        if quiet > 3:
            return Ascent(at, found, number + 1, True)
    return Ascent(at, found, iterations, False)


def _usable(found: Evaluation) -> bool:
    return bool(
        np.isfinite(found.value) and np.isfinite(found.gradient).all() and np.isfinite(found.information).all()
    )


def _positive(information: np.ndarray) -> np.ndarray:
    """An information without negative directions, which differences of gradients may leave."""
    values, axes = np.linalg.eigh(information)
    return axes * np.abs(values) @ axes.T
