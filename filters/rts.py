"""The Rauch-Tung-Striebel smoother: a Gaussian filter's estimates, corrected backwards in time.

    G_k = cov(x_k, x_{k+1}) cov(x_{k+1})^-1, both given the measurements up to k
    x_k += G_k (smoothed x_{k+1} - predicted x_{k+1})
    P_k = (P_k - G_k predicted P_{k+1} G_k') + G_k smoothed P_{k+1} G_k'

The bracket is computed as a covariance, so that P_k is one. A `Relation`, the page of a smoother, relates two
successive states by the filter's own linearisation or by its sigma points X = x 1' + g L U, L L' = P, with

    G = cov(x, f(X)) (predicted P)^-1,  bracket = cov(X - G f(X)) + G Q G'

a sum of squares that equals P - G (predicted P) G'.

Source: Sarkka (2008), "Unscented Rauch-Tung-Striebel smoother", algorithm 1, with additive noise; for cubature
points Arasaratnam, Haykin (2011), "Cubature Kalman smoothers".
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache, partial
from typing import NamedTuple

import numpy as np

from filters.algebra.operations import eye, quotient, sym
from filters.algebra.points import first, ones, root, square, units, without_first
from filters.algebra.roots import careful
from filters.algebra.tangents import after_reset, differences, move, reset, reset_back
from filters.engine.batch import Estimates
from filters.engine.belief import memory_offsets
from filters.filter import Filter, PageFilter
from filters.gaussian import sigma_points
from filters.gaussian.extended import ExtendedKalmanFilter, IteratedExtendedKalmanFilter
from filters.gaussian.kalman import KalmanFilter, constants_at
from filters.gaussian.sigma_points import CubatureKalmanFilter, UnscentedKalmanFilter, propagate_points, scatter
from filters.pages.kernels import Stage, as_tuple, programs_of, stored
from filters.pages.page import Equations, Page, RowMemory
from thruster_env.core.angles import difference
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.parallel import spread
from thruster_env.model.shape import Functions, Shape
from thruster_env.model.turns import refuse_rotations

ROUNDING = 1e-12  # of angles that were wrapped [rad]
Given = tuple[np.ndarray, np.ndarray, np.ndarray]  # means, covariances, and which are restarts, (B, K + 1, ...)


class Relation(NamedTuple):
    """A page of a smoother: from x and P at a step to the next one, and the link between the two."""

    represent: Callable  # represent(model, x, P): the representation of the belief that is propagated
    propagate: Callable  # propagate(model, *predicted, u), in each of the model's substeps
    link: Callable  # link(model, x, P, *predicted): predicted x, G and the bracket


def represent_jacobian(model, x, P):
    """The mean, and the Jacobian of zero substeps, the identity."""
    return x, eye(P)


def propagate_jacobian(model, x, F, u):
    """Propagate the mean by one substep, and multiply its Jacobian."""
    return model.f(x, u), model.F(x, u) @ F


def link(model, x, P, mean, F):
    """G = P F' (F P F' + Q)^-1, and the bracket (I - G F) P (I - G F)' + G Q G'."""
    C = P @ F.T
    G = quotient(C, careful(sym(F @ C + model.Q)))
    A = eye(P) - G @ F
    return mean, G, sym(A @ P @ A.T) + sym(G @ model.Q @ G.T)


def propagate_scheduled_jacobian(model, x, F, u):
    """`propagate_jacobian` of the affine model at an input."""
    return propagate_jacobian(model.at(constants_at(model, u)), x, F, u)


LINEARISED = Relation(represent_jacobian, propagate_jacobian, link)
SCHEDULED = Relation(represent_jacobian, propagate_scheduled_jacobian, link)


def back(model, x, P, linked, later):
    """Correct the estimate of a step by that of the next one, `later`."""
    (mean, G, C), (later_x, later_P) = linked, later
    change = differences(model, later_x, mean)
    d, later_P = G @ change, reset_back(model, later_P, mean, change)
    return move(model, x, d), reset(model, sym(C + sym(G @ later_P @ G.T)), x, d)


def smooth_backwards(
    filter_: PageFilter,
    relation: Relation,
    estimates: Estimates,
    inputs: np.ndarray,
    lag: int,
    process_noise: np.ndarray,
    rows: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Means (B, K + 1, n) and covariances given `lag` later measurements, from a filter's estimates.

    A pass starts `lag` steps after each step; the last lag + 1 steps share one. Nothing is carried back over a
    restart from the prior.

    Args:
        filter_: the filter, whose `kernel_model` and `numbers` are used.
        relation: of two successive states.
        estimates: of the filter, from `filters.run`.
        inputs: (B, K, p).
        lag: number of later measurements, 0 ... K.
        process_noise: rows (Q, its root) of each step, of `filters.engine.batch.noise_rows`; none for the model's.
        rows: those of the measurements that `lag` counts, where others have none; None for all.
    """
    model, angles = filter_.kernel_model, filter_.kernel_model.any_shape.state_angles
    # A restarted belief is the prior; a belief may also be the prior without a restart.
    apart = np.abs(difference(estimates.means, model.prior_mean, angles))
    means_alike = (apart <= np.where(angles, ROUNDING, 0.0)).all(axis=-1)
    is_prior = means_alike & (estimates.covs == model.prior_cov).all(axis=(-2, -1))
    filtered = estimates.means, estimates.covs, is_prior & (estimates.divergences > 0)[:, None]
    numbers = filter_.numbers[None]
    if process_noise.shape[1] == numbers.shape[1]:
        numbers = process_noise
    elif len(process_noise):
        numbers, q = np.repeat(numbers, len(process_noise), axis=0), model.any_shape.offsets.q
        numbers[:, q : q + process_noise.shape[1]] = process_noise
    return passes(filter_, relation)(filtered, inputs, lag, numbers, rows)


def earliest_rows(times: int, lag: int, rows: np.ndarray | None = None) -> np.ndarray:
    """The row that a measurement in each of `times` rows reaches back to: that of `lag` measurements before."""
    rows, earliest = np.arange(times) if rows is None else rows, np.arange(float(times))
    earliest[rows] = rows[np.maximum(np.arange(len(rows)) - lag, 0)]
    return earliest


def passes(filter_: PageFilter, relation: Relation) -> Callable[..., tuple]:
    """Return the function that makes the smoother's passes.

    It takes a filter's estimates, the inputs, the lag, and the numbers that the filter used: (1, count) for all
    steps or (K, count) for each; those of the filter if None; and the rows that the lag counts, all if None.
    """
    functions, of_filter, model = filter_.kernel_model.functions, filter_.numbers[None], filter_.kernel_model
    shape = model.any_shape
    run_part = _smoother(relation, filter_.written_page, functions, shape, is_interpreting())

    def smoothed(
        filtered: Given,
        inputs: np.ndarray,
        lag: int,
        numbers: np.ndarray | None = None,
        rows: np.ndarray | None = None,
    ) -> tuple[np.ndarray, np.ndarray]:
        numbers = of_filter if numbers is None else numbers
        arrays = tuple(np.ascontiguousarray(part, dtype=np.float64) for part in (*filtered, inputs))
        means, covs = np.empty_like(arrays[0]), np.empty_like(arrays[1])
        earliest = earliest_rows(inputs.shape[1] + 1, lag, rows)
        begin = lag if rows is None else int(rows[lag])
        work = partial(run_part, arrays[:3], arrays[3], numbers, begin, earliest, means, covs)
        work(0, 1) if len(means) == 1 else spread(work, len(means))
        return means, covs

    return smoothed


@lru_cache(maxsize=64)
def _smoother(relation: Relation, page: Page, functions: Functions, shape: Shape, interpreting: bool) -> Callable:
    """The compiled passes over runs, for a relation."""

    def stages(memory: RowMemory, model: Equations) -> list[Stage]:
        x, p = memory.x, memory.P
        begun = as_tuple(relation.represent(model, x, p))
        predicted = [memory.another(matrix) for matrix in begun]
        linked = relation.link(model, x, p, *predicted)
        links = [memory.another(matrix, symmetric=matrix.symmetric) for matrix in linked]
        later = memory.another(x), memory.another(p, symmetric=True)
        advanced = as_tuple(relation.propagate(model, *predicted, memory.u))
        return [
            stored(begun, predicted),
            stored(advanced, predicted),
            stored(linked, links),
            stored(back(model, x, p, links, later), (x, p)),
        ]

    memory, works, _ = programs_of(page, functions, shape, stages)
    first_step, substep, connect, correct = works
    n, t, length = shape.n, shape.t, memory.end
    belief, mean_offset = n + t * t, memory_offsets(n, shape.m, t).mean
    later_offset, width = length - belief, belief + t * t  # after the link: predicted mean, gain, bracket
    link_offset, substeps = later_offset - width, shape.offsets.substeps

    def put(row, at, means, covs, b, k):
        for i in range(n):
            row[at + i] = means[b, k, i]
        for i in range(t):
            for j in range(t):
                row[at + n + i * t + j] = covs[b, k, i, j]

    def copy(target, at, source, first, count):
        for i in range(count):
            target[at + i] = source[first + i]

    def smooth(estimates, inputs, numbers, begin, earliest, means, out_covs, first, last):
        filtered, covs, restarted = estimates
        steps = inputs.shape[1]
        u, row, links = np.zeros(inputs.shape[2]), np.zeros(length), np.zeros(steps * width)
        now = np.zeros(numbers.shape[1])  # one per thread: slices of shared arrays cost reference counts
        for b in range(first, last):
            for k in range(steps):
                if k < numbers.shape[0]:
                    for i in range(now.shape[0]):
                        now[i] = numbers[k, i]
                for i in range(u.shape[0]):
                    u[i] = inputs[b, k, i]
                put(row, mean_offset, filtered, covs, b, k)
                first_step(row, u, now)
                for _ in range(int(now[substeps])):
                    substep(row, u, now)
                connect(row, u, now)
                total = 0.0
                for i in range(belief):
                    total += abs(row[link_offset + i])
                if restarted[b, k + 1] > 0.0 or not total < 1e300:
                    for i in range(t * t):  # a gain of zero, whatever the predicted mean
                        row[link_offset + n + i] = 0.0
                    copy(row, link_offset, row, mean_offset, n)
                    copy(row, link_offset + belief, row, mean_offset + n, t * t)
                copy(links, k * width, row, link_offset, width)
            for end in range(begin, steps + 1):
                put(row, later_offset, filtered, covs, b, end)
                back_to = int(earliest[end])
                for k in range(end, back_to - 1, -1):
                    if k < end:
                        for i in range(n):
                            row[mean_offset + i] = filtered[b, k, i]
                        copy(row, link_offset, links, k * width, width)
                        correct(row, u, now)
                        copy(row, later_offset, row, mean_offset, belief)
                    if end == steps or k == back_to:
                        for i in range(n):
                            means[b, k, i] = row[later_offset + i]
                        for i in range(t):
                            for j in range(t):
                                out_covs[b, k, i, j] = row[later_offset + n + i * t + j]

    estimates = [(None, None, n), (None, None, t, t), (None, None)]
    shapes = estimates, (None, None, None), (None, None), None, (None,), *estimates[:2], None, None
    from thruster_env.graphs.loops import Loops

    return Loops(smooth, shapes)


def link_unscented(model, x, P, X):
    """The link of an unscented filter."""
    g, w, L = model.own.spread, model.own.weight, root(P)
    U = without_first(units(first(L)))
    D = differences(model, without_first(X), first(X))
    s = (D @ ones(D)) * w
    mean = move(model, first(X), s)
    s, D = (after_reset(model, part, first(X), s) for part in (s, D))
    C = (L @ (U @ D.T)) * (w * g)
    G = quotient(C, careful(scatter(model, D, s) + model.Q))
    left = scatter(model, (L * g) @ U - G @ D, G @ s)
    return mean, G, left + sym(G @ model.Q @ G.T)


def link_cubature(model, x, P, X):
    """The link of a cubature filter."""
    (g, w), L = model.own, root(P)
    U = without_first(units(first(L)))
    mean, D = sigma_points.cubature_state(model, X)
    C = (L @ (U @ D.T)) * (w * g)
    G = quotient(C, careful(square(D) * w + model.Q))
    return mean, G, square((L * g) @ U - G @ D) * w + sym(G @ model.Q @ G.T)


UNSCENTED = Relation(sigma_points.represent_unscented, propagate_points, link_unscented)
CUBATURE = Relation(sigma_points.represent_cubature, propagate_points, link_cubature)


# Filters that have a smoother of Rauch, Tung and Striebel.
RELATIONS: dict[type[Filter], Relation] = {
    KalmanFilter: LINEARISED,
    ExtendedKalmanFilter: LINEARISED,
    IteratedExtendedKalmanFilter: LINEARISED,
    UnscentedKalmanFilter: UNSCENTED,
    CubatureKalmanFilter: CUBATURE,
}


def relation_of(filter_: Filter, what: str, alternatives: str = "") -> Relation:
    """The relation of a filter for `smooth_backwards`; ValueError if it has no such smoother."""
    kind = filter_.of_recursion()
    if kind not in RELATIONS:
        refuse_rotations(filter_.model)
    if filter_.model.bounds:
        raise ValueError(f"{what} needs a model without bounds, but got {filter_.model.bounds}")
    if isinstance(filter_, KalmanFilter) and kind is KalmanFilter and filter_.schedule > 1:
        return SCHEDULED
    if kind in RELATIONS:
        return RELATIONS[kind]
    known = ", ".join(known.name for known in RELATIONS)
    raise ValueError(f"{what} needs a filter of {known}{alternatives}, but got {filter_.name!r}")
