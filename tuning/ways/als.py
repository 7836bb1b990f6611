"""Autocovariance least squares: Q and R from how the innovations of a fixed gain go together over time."""

from __future__ import annotations

import numpy as np

from filters.tuned_file import NOISE
from tuning.evaluation.baselines import with_covariances
from tuning.ways.lagged import ITERATIONS, Noise, Stationary, by_lags, lagged, observed, stationary
from tuning.ways.task import Task

LEAST = 1e-10  # part of the start's variances below which none falls, so that a gain exists
PRECISE, MOST = 1e-12, 400  # relative change of squares and roots that ends Gauss and Newton's steps; and how many


def als(task: Task) -> None:
    """Least squares of lagged covariances of innovations, with variances not below zero; three times over.

        e_k = z_k - C x^_k,   x^' = A (x^ + L e),   C_j = E[e_{k+j} e_k'],   Ab = A - A L C
        b = (C x O)(I - Ab x Ab)^-1 [vec Q + (A L x A L) vec R] + (I x Gam) vec R,   b = vec(C_0; C_1; ...)
        O = (C; C Ab; ...),   Gam = (I; -C A L; -C Ab A L; ...),   x the product of Kronecker

    Q and R have to be linear in the numbers that are tuned, or are full matrices that stay positive semidefinite.
    The first gain is that of the start. It needs one pass of a filter an iteration. With more unknowns in Q than
    n m the answer is not unique.

    Source: Odelson, Rajamani, Rawlings (2006), "A new autocovariance least-squares method for estimating noise
    covariances", Automatica 42(2); Rajamani, Rawlings (2009), Automatica 45(1).
    """

    def equations(linear: Stationary, gain: np.ndarray, seen: np.ndarray, noise: Noise):
        lags = len(seen)
        design = [lagged(linear, gain, q, r, lags).ravel() for q, r in zip(noise.q, noise.r, strict=True)]
        return np.column_stack(design), (seen - lagged(linear, gain, *noise.rest, lags)).ravel()

    wanted = [bool(task.options.get(one)) for one in ("full_q", "full_r")]
    if any(wanted) and set(NOISE) <= set(task.start.model):
        _matrices(task, *wanted)
    else:
        by_lags(task, "als", equations)


def _matrices(task: Task, full_q: bool, full_r: bool) -> None:
    """The same of Q, R or both in full; of what is not full the diagonal is found."""
    model, held = task.model(task.start), bool(task.options.get("hold_r"))
    linear = stationary(model, task.problems[0].name, "als")
    first = q, r = model.process_noise_cov, model.measurement_noise_cov
    free = _free(q, full_q), _free(r, full_r) & (not held)
    for _ in range(ITERATIONS):
        gain, seen = observed(task, linear, q, r)
        q, r = semidefinite(linear, gain, seen, first, free)
        task.keep(with_covariances(task.start, q, None if held else r))


def semidefinite(
    linear: Stationary,
    gain: np.ndarray,
    seen: np.ndarray,
    first: tuple[np.ndarray, np.ndarray],
    free: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray]:
    """Q = S S' and R = T T' with the least squares of lagged covariances, over their triangular roots S and T.

        d b / d S_ik = 2 sum_j B_ij S_jk,   B_ij the lagged covariances of Q = (e_i e_j' + e_j e_i') / 2

    The squares are convex in Q and R, and roots with as many columns as rows have no minimum but theirs.

    Args:
        linear: the model.
        gain: L (n, m).
        seen: lagged covariances of its innovations, (lags, m, m).
        first: Q (n, n) and R (m, m), at whose diagonals the search begins; what has no free entry stays.
        free: which entries of their roots are free, (n, n) and (m, m) bool.

    Source: Burer, Monteiro (2005), "Local minima and convergence in low-rank semidefinite programming",
    Mathematical Programming 103(3).
    """
    from scipy.optimize import least_squares

    pairs = list(zip(first, free, strict=True))
    roots = [np.sqrt(np.diag(np.diag(one))) if mask.any() else np.linalg.cholesky(one) for one, mask in pairs]
    parts = [one[mask] for one, mask in zip(roots, free, strict=True)]
    by = [_responses(linear, gain, len(seen), side, len(one)) for side, one in enumerate(first)]
    wanted, end = seen.ravel(), len(parts[0])

    def filled(point: np.ndarray) -> list[np.ndarray]:
        for root, mask, some in zip(roots, free, (point[:end], point[end:]), strict=True):
            root[mask] = some
        return roots

    def left(point: np.ndarray) -> np.ndarray:
        expected = [np.tensordot(one, root @ root.T) for one, root in zip(by, filled(point), strict=True)]
        return expected[0] + expected[1] - wanted

    def slopes(point: np.ndarray) -> np.ndarray:
        pairs = zip(by, filled(point), free, strict=True)
        return np.concatenate([2.0 * (one @ root)[:, mask] for one, root, mask in pairs], axis=1)

    ends = {"ftol": PRECISE, "xtol": PRECISE, "gtol": None, "max_nfev": MOST}
    found = least_squares(left, np.concatenate(parts), slopes, x_scale="jac", **ends)
    floors = (LEAST * np.diag(np.diag(one)) for one in first)
    q, r = (root @ root.T + floor for root, floor in zip(filled(found.x), floors, strict=True))
    return q, r


def _free(cov: np.ndarray, full: bool) -> np.ndarray:
    """Which entries of a root are free, (n, n) bool: none of a state without noise."""
    there = np.diag(cov) > 0.0
    return np.tril(np.outer(there, there)) if full else np.diag(there)


def _responses(linear: Stationary, gain: np.ndarray, lags: int, side: int, size: int) -> np.ndarray:
    """Lagged covariances by each entry of Q, side 0, or of R, (lags m m, size, size), symmetric in the entries."""
    n, m = gain.shape
    found = np.empty((lags * m * m, size, size))
    for i in range(size):
        for j in range(i + 1):
            noise = np.zeros((n, n)), np.zeros((m, m))
            noise[side][i, j] += 0.5
            noise[side][j, i] += 0.5
            found[:, i, j] = found[:, j, i] = lagged(linear, gain, *noise, lags).ravel()
    return found
