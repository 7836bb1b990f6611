"""The Rauch-Tung-Striebel smoother: a Gaussian filter's estimates, corrected backwards in time."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from typing import Any

import numpy as np

from filters.engine.batch import Estimates
from filters.engine.layout import own_place
from filters.filter import Filter
from filters.gaussian.schedule import interpolator
from numerics import matrices
from numerics.angles import NAMES, difference, kept, short_way
from numerics.compiled import CompiledOrPython, function_fingerprint, inlined, is_interpreting
from numerics.sources import Source, entrywise
from numerics.threads import spread
from numerics.tuples import matrix_reader, vector_reader, zeros_of
from plants.affine import affine_functions
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape, transition_slopes

ROUNDING = 1e-12  # of angles that were wrapped [rad]
NEGLIGIBLE = 1e-13  # a pivot of a predicted covariance below this part of its variance counts as zero


def smooth_backwards(
    filter_: Filter, relate: Callable, estimates: Estimates, inputs: np.ndarray, lag: int
) -> tuple[np.ndarray, np.ndarray]:
    """Means (B, K + 1, n) and covariances given `lag` later measurements, from a filter's estimates.

        G_k = cov(x_k, x_{k+1}) cov(x_{k+1})^-1, both given the measurements up to k
        mean_k += G_k (smoothed mean_{k+1} - predicted mean_{k+1})
        P_k = (P_k - G_k predicted P_{k+1} G_k') + G_k smoothed P_{k+1} G_k'

    The bracket is computed as a covariance, by `relate`, so that P_k is one. A pass starts `lag` steps after
    each step; the last lag + 1 steps share one. Nothing is carried back over a restart from the prior.

    Args:
        filter_: the filter, whose `kernel_model` and `numbers` are used.
        relate: relate(mean, p, u, numbers) returns the predicted mean, G and the bracket, as tuples.
        estimates: of the filter, from `filters.run`.
        inputs: (B, K, p).
        lag: number of later measurements, 0 ... K.
    """
    model, (count, times, n) = filter_.kernel_model, estimates.means.shape
    angles = model.shape.state_angles
    run_part, numbers = _smoother(relate, n, angles, is_interpreting()), filter_.numbers
    # A restarted belief is the prior; without any restart a belief may be the prior for other reasons.
    apart = np.abs(difference(estimates.means, model.prior_mean, angles))
    means_alike = (apart <= np.where(angles, ROUNDING, 0.0)).all(axis=-1)
    is_prior = means_alike & (estimates.covs == model.prior_cov).all(axis=(-2, -1))
    given = estimates.means, estimates.covs, is_prior & (estimates.divergences > 0)[:, None]
    links = tuple(np.empty((count, times - 1, *shape)) for shape in ((n,), (n, n), (n, n)))
    means, covs = np.empty_like(estimates.means), np.empty_like(estimates.covs)
    spread(lambda first, last: run_part(given, inputs, numbers, lag, links, means, covs, first, last), count)
    return means, covs


@cache
def careful_factor(size: int) -> Callable:
    """Return `factor(a)`: the lower triangular L of a positive semidefinite a, for `matrices.row_solver`.

    Where a pivot is zero the diagonal of L is infinite, so that solving gives zero there. For a right-hand side in
    the range of a that is a solution: components known exactly have no share in a gain.
    """
    return matrices.pivoted_factor(
        size, f"{{d}} ** 0.5 if {{d}} > {NEGLIGIBLE} * {{a}} else infinity", infinity=np.inf
    )


@cache
def linear_link(n: int) -> Callable:
    """Return `link(p, f, q)`: G = P F' (F P F' + Q)^-1 and the bracket (I - G F) P (I - G F)' + G Q G'."""
    times, times_transposed = matrices.multiplier(n, n, n), matrices.transposed_multiplier(n, n, n)
    factor, solve, add, less = (
        careful_factor(n),
        matrices.row_solver(n, n),
        matrices.symmetric_sum(n),
        matrices.identity_less(n),
    )

    @inlined
    def link(p, f, q):
        cross = times_transposed(p, f)
        gain = solve(cross, factor(add(times(f, cross), q)))
        rest = less(times(gain, f))
        return gain, add(times_transposed(times(rest, p), rest), times_transposed(times(gain, q), gain))

    return link


@lru_cache(maxsize=64)
def extended_relation(functions: Functions, shape: Shape) -> Callable:
    """Return `relate(mean, p, u, numbers)` of the extended Kalman filter, with F = df/dx at the mean."""
    n, m, transition = shape.n, shape.m, functions.transition
    source = number_places(n, m)
    substeps_place, constants, control = source.substeps, constants_reader(shape), vector_reader(shape.inputs)
    read_q, read_scales = matrix_reader(n, n, source.q), vector_reader(n, source.scales)
    slopes, times = transition_slopes(functions, shape), matrices.multiplier(n, n, n)
    unit = Source("identity", "", result=(n, n))
    identity = unit.function(unit.matrix(n, n, lambda i, j: unit.if_same(i, j, "1.0", "0.0")))
    link = linear_link(n)

    @inlined
    def relate(mean, p, u, numbers):
        v, c, scales, f = control(u), constants(numbers), read_scales(numbers), identity()
        for _ in range(int(numbers[substeps_place])):
            f = times(slopes(mean, scales, v, c), f)
            mean = transition(mean, v, c)
        gain, kept = link(p, f, read_q(numbers))
        return mean, gain, kept

    return relate


@lru_cache(maxsize=64)
def scheduled_relation(points: int, shape: Shape) -> Callable:
    """Return `relate(mean, p, u, numbers)` of a Kalman filter that is scheduled over `points` inputs."""
    n, m, count = shape.n, shape.m, shape.constants
    transition, _, transition_matrix, _ = affine_functions(n, m, 1).values()
    blend, read_q = interpolator(points, count, own_place(shape)), matrix_reader(n, n, number_places(n, m).q)
    control, link = vector_reader(1), linear_link(n)

    @inlined
    def relate(mean, p, u, numbers):
        v, c = control(u), blend(numbers, u[0])
        gain, kept = link(p, transition_matrix(mean, v, c), read_q(numbers))
        return transition(mean, v, c), gain, kept

    return relate


@cache
def step_writers(n: int, angles: tuple[bool, ...] = ()) -> tuple[Callable, Callable]:
    """Functions `write(a, b, k, x)`: a vector (n,), its angles in (-pi, pi], and a matrix (n, n), into a[b, k]."""
    vector, matrix = Source("write", "a, b, k, x", x=(n,)), Source("write", "a, b, k, x", x=(n, n))
    for i in vector.range(n):
        vector.line(f"a[b, k, {i}] = {short_way(f'x[{i}]', i, angles)}")
    for i in matrix.range(n):
        for j in matrix.range(n):
            matrix.line(f"a[b, k, {i}, {j}] = x[{i}][{j}]")
    return vector.function(**NAMES), matrix.function()


@lru_cache(maxsize=64)
def _smoother(relate: Callable, n: int, angles: tuple[bool, ...], interpreting: bool) -> CompiledOrPython:
    read_vector = entrywise("read", "a, b, k", (n,), lambda i: f"a[b, k, {i}]")
    read_matrix = entrywise("read", "a, b, k", (n, n), lambda i, j: f"a[b, k, {i}, {j}]")
    write_vector, write_matrix = step_writers(n)
    source = Source("total", "x, g", x=(n,), g=(n, n))
    sizes = source.sum(f"abs(x[{i}])" for i in source.range(n))
    all_sizes = (f"abs(g[{i}][{j}])" for i in source.range(n) for j in source.range(n))
    total = source.function(f"{sizes} + {source.sum(all_sizes)}")
    no_mean, no_gain = zeros_of(n), zeros_of(n, n)
    add, times, times_transposed = (
        matrices.symmetric_sum(n),
        matrices.multiplier(n, n, n),
        matrices.transposed_multiplier(n, n, n),
    )
    vectors: dict[str, Any] = dict.fromkeys("xse", (n,))
    source = Source("corrected", "x, g, s, e", result=(n,), g=(n, n), **vectors)

    def sums(i):
        apart = ((j, short_way(f"(s[{j}] - e[{j}])", j, angles)) for j in source.range(n))
        return source.less(f"x[{i}]", (f"g[{i}][{j}] * {distance}" for j, distance in apart), "+")

    corrected = kept(source.function(source.vector(n, sums), **NAMES), "x, g, s, e", angles)
    fingerprint = function_fingerprint(relate, within=__name__)

    @inlined
    def connect(given, inputs, numbers, links, u, b):
        filtered, covs, restarted = given
        expected, gains, kept = links
        for k in range(inputs.shape[1]):
            for i in range(u.shape[0]):
                u[i] = inputs[b, k, i]
            p = read_matrix(covs, b, k)
            mean, gain, rest = relate(read_vector(filtered, b, k), p, u, numbers)
            if restarted[b, k + 1] or not total(mean, gain) < 1e300:
                mean, gain, rest = no_mean(), no_gain(), p
            write_vector(expected, b, k, mean)
            write_matrix(gains, b, k, gain)
            write_matrix(kept, b, k, rest)

    @inlined
    def step_back(filtered, links, b, k, mean, p):
        expected, gains, kept = links
        gain = read_matrix(gains, b, k)
        mean = corrected(read_vector(filtered, b, k), gain, mean, read_vector(expected, b, k))
        return mean, add(read_matrix(kept, b, k), times_transposed(times(gain, p), gain))

    def smooth(given, inputs, numbers, lag, links, means, out_covs, first, last):
        fingerprint  # noqa: B018 - part of the cache's key
        filtered, covs, _ = given
        u, steps = np.zeros(inputs.shape[2]), inputs.shape[1]
        for b in range(first, last):
            connect(given, inputs, numbers, links, u, b)
            for end in range(lag, steps + 1):
                mean, p = read_vector(filtered, b, end), read_matrix(covs, b, end)
                if end == steps or lag == 0:
                    write_vector(means, b, end, mean)
                    write_matrix(out_covs, b, end, p)
                for k in range(end - 1, end - lag - 1, -1):
                    mean, p = step_back(filtered, links, b, k, mean, p)
                    if end == steps or k == end - lag:
                        write_vector(means, b, k, mean)
                        write_matrix(out_covs, b, k, p)

    return CompiledOrPython(smooth)
