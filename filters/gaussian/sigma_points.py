"""What unscented and cubature filters share: moments of a model's values at points around the mean."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from typing import NamedTuple

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place, row_access
from filters.gaussian.extended import gaussian_start, in_stages, nothing_to_summarise
from numerics import matrices
from numerics.angles import NAMES, circular_mean, is_angle, short_way
from numerics.compiled import inlined
from numerics.tuples import (
    matrix_of,
    matrix_reader,
    matrix_writer,
    scaled_sum,
    tuple_of,
    vector_reader,
    written_out,
)
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape, innovation_of
from plants.state_space import StateSpaceModel


class PointSet(NamedTuple):
    """Points mean +- spread L_i, where L_i are the columns of the lower triangular root of P.

    A filter's own numbers: kernels read them in this order.
    """

    spread: float
    weight: float  # of each of the 2n points
    bend: float  # weight of the outer product of the shift: of the mean of values less the value at the centre


@cache
def points_around(n: int, centre: bool) -> Callable:
    """Return `points(mean, l, spread)`: the mean first, if it is a point, then mean + and mean - spread L_i."""
    points = [tuple_of(f"x[{a}] {sign} s * l[{a}][{i}]" for a in range(n)) for sign in "+-" for i in range(n)]
    return written_out("points", "x, l, s", tuple_of(["x"] * centre + points))


@cache
def deviations(size: int, count: int, centre: bool, angles: tuple[bool, ...] = ()) -> Callable:
    """Return `deviate(y, w)`: mean, shift and deviations of values at the points, y of shape (.., size).

    With a centre, d_i = y_i - y_0, shift = w sum d_i, mean = y_0 + shift; without, mean = w sum y_i,
    d_i = y_i - mean, shift = 0. Of angles d_i are taken the short way round from y_0; without a centre the y_i are
    put on the branch of their circular mean before.
    """
    places, first = range(size), int(centre)
    values = range(first, first + count)
    lines = []

    def value(i, a):
        return f"y{i}_{a}" if is_angle(a, angles) else f"y[{i}][{a}]"

    for a in places:
        if centre:
            apart = (short_way(f"(y[{i}][{a}] - y[0][{a}])", a, angles) for i in values)
            lines.append(f"s{a} = w * ({' + '.join(apart)})")
            lines.append(f"m{a} = y[0][{a}] + s{a}")
        else:
            lines.append(f"s{a} = 0.0")
            if is_angle(a, angles):
                lines.append(f"r{a} = {circular_mean([f'y[{i}][{a}]' for i in values])}")
                lines += [f"y{i}_{a} = r{a} + wrapped(y[{i}][{a}] - r{a})" for i in values]
            lines.append(f"m{a} = w * ({' + '.join(value(i, a) for i in values)})")

    def distance(i, a):
        return short_way(f"y[{i}][{a}] - y[0][{a}]", a, angles) if centre else f"{value(i, a)} - m{a}"

    apart = (tuple_of(distance(i, a) for a in places) for i in values)
    mean, shift = (tuple_of(f"{name}{a}" for a in places) for name in "ms")
    return written_out("deviate", "y, w", *lines, f"({mean}, {shift}, {tuple_of(apart)})", **NAMES)


@cache
def scatter(size: int, count: int) -> Callable:
    """Return `scatter(d, shift, w, b)`: w sum d_i d_i' + b shift shift', exactly symmetric, (size, size)."""
    lines = []
    for a in range(size):
        for b in range(a + 1):
            products = " + ".join(f"d[{i}][{a}] * d[{i}][{b}]" for i in range(count))
            lines.append(f"p{a}_{b} = w * ({products}) + b * (shift[{a}] * shift[{b}])")
    return written_out(
        "scatter", "d, shift, w, b", *lines, matrix_of(size, size, lambda i, j: f"p{max(i, j)}_{min(i, j)}")
    )


@cache
def cross_scatter(n: int, m: int) -> Callable:
    """Return `cross(l, e, f)`: f sum_i L_i (e_i - e_{n+i})', (n, m), for f = weight times spread."""

    def entry(a, c):
        return f"f * ({' + '.join(f'l[{a}][{i}] * (e[{i}][{c}] - e[{n + i}][{c}])' for i in range(n))})"

    return written_out("cross", "l, e, f", matrix_of(n, m, entry))


@cache
def residuals(n: int, m: int) -> Callable:
    """Return `rest(l, s, k, e)`: what the gain k (n, m) leaves of the points' deviations, +-s L_i - K e_i."""
    lines = (
        tuple_of(
            f"{sign}s * l[{a}][{i}] - (" + " + ".join(f"k[{a}][{c}] * e[{first + i}][{c}]" for c in range(m)) + ")"
            for a in range(n)
        )
        for sign, first in (("", 0), ("-", n))
        for i in range(n)
    )
    return written_out("rest", "l, s, k, e", tuple_of(lines))


@cache
def silenced_columns(count: int, m: int) -> Callable:
    """Return `silence(d, z)`: vectors d (count, m) with zeros in the channels that are NaN in z."""
    return written_out(
        "silence", "d, z", matrix_of(count, m, lambda i, c: f"(d[{i}][{c}] if z[{c}] == z[{c}] else 0.0)")
    )


@lru_cache(maxsize=64)
def sigma_point_kernels(functions: Functions, shape: Shape, centre: bool) -> Kernels:
    """Kernels of the sigma-point filter for a model; `centre`: whether the mean is a point."""
    n, m, transition, observe = shape.n, shape.m, functions.transition, functions.observe
    places, source, own = memory_places(n, m), number_places(n, m), own_place(shape)
    step_place, likelihood_place, first = places.step, places.log_likelihood, places.extras
    count = 2 * n + centre
    (read_mean, read_cov), (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    read_points, store_points = matrix_reader(count, n, first), matrix_writer(count, n, first)
    read_q, read_r = matrix_reader(n, n, source.q), matrix_reader(m, m, source.r)
    constants, control, measured = constants_reader(shape), vector_reader(shape.inputs), vector_reader(m)
    read_set = vector_reader(3, own)
    moved = written_out(
        "moved", "x, u, c", tuple_of(f"transition(x[{i}], u, c)" for i in range(count)), transition=transition
    )
    seen = written_out("seen", "x, c", tuple_of(f"observe(x[{i}], c)" for i in range(count)), observe=observe)
    root_of, around = matrices.semidefinite_factor(n), points_around(n, centre)
    state_deviations = deviations(n, 2 * n, centre, shape.state_angles)
    measured_deviations = deviations(m, 2 * n, centre, shape.measurement_angles)
    state_scatter, measured_scatter, cross = scatter(n, 2 * n), scatter(m, 2 * n), cross_scatter(n, m)
    add_n, add_m = matrices.symmetric_sum(n), matrices.symmetric_sum(m)
    silence, silence_shift, mask = silenced_columns(2 * n, m), silenced_columns(1, m), matrices.masked(m)
    present, factor = innovation_of(shape), matrices.cholesky_factor(m)
    rest, apply, likelihood = residuals(n, m), matrices.vector_multiplier(n, m), matrices.innovation_likelihood(m)
    k_r, k_r_kt = matrices.multiplier(n, m, m), matrices.transposed_multiplier(n, m, n)
    solve, corrected = matrices.row_solver(n, m), scaled_sum(n)

    @inlined
    def begin(memory, u, numbers, size):
        row, _, _ = memory
        spread, _, _ = read_set(numbers)
        store_points(row, around(read_mean(row), root_of(read_cov(row)), spread))

    @inlined
    def advance(memory, u, numbers, size):
        row, _, _ = memory
        store_points(row, moved(read_points(row), control(u), constants(numbers)))

    @inlined
    def finish(memory, u, numbers, size):
        row, _, _ = memory
        _, weight, bend = read_set(numbers)
        mean, shift, d = state_deviations(read_points(row), weight)
        store_mean(row, mean)
        store_cov(row, add_n(state_scatter(d, shift, weight, bend), read_q(numbers)))
        row[step_place] += 1.0

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        spread, weight, bend = read_set(numbers)
        mean, root, z = read_mean(row), root_of(read_cov(row)), measured(z)
        y, shift, e = measured_deviations(seen(around(mean, root, spread), constants(numbers)), weight)
        e, (shift,) = silence(e, z), silence_shift((shift,), z)
        r, innovation = mask(read_r(numbers), z), present(z, y)
        s = add_m(measured_scatter(e, shift, weight, bend), r)
        s_root = factor(s)
        k = solve(cross(root, e, weight * spread), s_root)
        store_mean(row, corrected(mean, 1.0, apply(k, innovation)))
        left = state_scatter(rest(root, spread, k, e), apply(k, shift), weight, bend)
        store_cov(row, add_n(left, k_r_kt(k_r(k, r), k)))
        store_innovation(row, innovation)
        store_s(row, s)
        row[likelihood_place] = likelihood(innovation, s_root, z)

    stages = begin, advance, finish
    predict = in_stages(n, m, *stages)
    start = gaussian_start(shape)
    return Kernels(n, m, n, 0, start, predict, update, nothing_to_summarise, scratch=n * count, stages=stages)


def kernels_of(model: StateSpaceModel, *, centre: bool) -> Kernels:
    """Sigma-point kernels for a model."""
    return sigma_point_kernels(model.functions, model.shape, centre)
