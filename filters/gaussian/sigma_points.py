"""What unscented and cubature filters share: moments of a model's values at points around the mean."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache
from typing import NamedTuple

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place, row_access
from filters.gaussian.extended import gaussian_start, in_stages, nothing_to_summarise
from numerics import arrays, matrices
from numerics.angles import NAMES, row_brancher, short_way
from numerics.compiled import inlined
from numerics.sources import Source, entrywise, tuple_of
from numerics.tuples import matrix_reader, matrix_writer, scaled_sum, vector_reader
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape, innovation_of
from plants.state_space import StateSpaceModel


class PointSet(NamedTuple):
    """Points mean +- spread L_i, where L_i are the columns of the lower triangular root of P.

    A filter's own numbers: kernels read them in this order.
    """

    spread: float
    weight: float  # of each of the 2n points
    shift_weight: float  # of the outer product of the shift, the mean of values minus the value at the centre


@cache
def points_around(n: int, centre: bool) -> Callable:
    """Return `points(mean, l, spread)`: the mean first, if it is a point, then mean + and mean - spread L_i."""
    first, count = int(centre), 2 * n + centre
    source = Source("points", "x, l, s", result=(count, n), x=(n,), l=(n, n))
    if not source.loops:
        points = [tuple_of(f"x[{a}] {sign} s * l[{a}][{i}]" for a in range(n)) for sign in "+-" for i in range(n)]
        return source.function(tuple_of(["x"] * centre + points))
    table = source.local("points", count, n)
    for a in source.range(n):
        source.line(f"{table[0, a]} = x[{a}]")
    for i in source.range(n):
        for a in source.range(n):
            source.line(f"{table[i + first, a]} = x[{a}] + s * l[{a}][{i}]")
            source.line(f"{table[i + (n + first), a]} = x[{a}] - s * l[{a}][{i}]")
    return source.function(source.whole(table))


@cache
def at_points(function: Callable, arguments: str, size: int, results: int, count: int) -> Callable:
    """Return `values(x, ...)`: the values (count, results) of a function at points x (count, size)."""
    name, others = ("transition", "u, c") if arguments == "x, u, c" else ("observe", "c")
    source = Source("values", arguments, result=(count, results), x=(count, size))
    if not source.loops:
        calls = tuple_of(f"{name}(x[{i}], {others})" for i in range(count))
        return source.function(calls, **{name: function})
    values = source.local("values", count, results)
    for i in source.range(count):
        source.line(f"store({values.name}, {i}, {name}(point({source.array_of('x')}, {i}), {others}))")
    store = Source("store", "out, i, y", y=(results,))
    for a in store.range(results):
        store.line(f"out[i, {a}] = y[{a}]")
    point = entrywise("point", "x, i", (size,), lambda a: f"x[i, {a}]")
    return source.function(source.whole(values), store=store.function(), point=point, **{name: function})


@cache
def deviations(size: int, count: int, centre: bool, angles: tuple[bool, ...] = ()) -> Callable:
    """Return `deviate(y, w)`: mean, shift and deviations of values at the points, y of shape (.., size).

    With a centre, d_i = y_i - y_0, shift = w sum d_i, mean = y_0 + shift; without, mean = w sum y_i,
    d_i = y_i - mean, shift = 0. Of angles d_i are taken the short way round from y_0; without a centre the y_i are
    put on the branch of their circular mean before.
    """
    first = int(centre)
    source = Source("deviate", "y, w", result=(count, size), y=(count + first, size))
    shift, mean = source.local("s", size), source.local("m", size)
    for a in source.range(size):
        values = source.range(first, first + count)
        if centre:
            distances = (short_way(f"(y[{i}][{a}] - y[0][{a}])", a, angles) for i in values)
            source.line(f"{shift[a]} = w * ({source.sum(distances)})")
            source.line(f"{mean[a]} = y[0][{a}] + {shift[a]}")
        else:
            source.line(f"{shift[a]} = 0.0")
            source.line(f"{mean[a]} = w * ({source.sum(f'y[{i}][{a}]' for i in values)})")

    def distance(i, a):
        value = f"y[{i + first}][{a}]"
        return short_way(f"{value} - y[0][{a}]", a, angles) if centre else f"{value} - {mean[a]}"

    apart = source.matrix(count, size, distance)
    deviate = source.function(f"({source.whole(mean)}, {source.whole(shift)}, {apart})", **NAMES)
    if centre or not any(angles):
        return deviate
    on_one_branch = row_brancher(count, angles)

    @inlined
    def deviate_on_one_branch(y, w):
        return deviate(on_one_branch(y), w)

    return deviate_on_one_branch


@cache
def scatter(size: int, count: int) -> Callable:
    """Return `scatter(d, shift, w, b)`: w sum d_i d_i' + b shift shift', exactly symmetric, (size, size)."""
    shapes = {"d": (count, size), "shift": (size,)}
    source = Source("scatter", "d, shift, w, b", result=(size, size), work=size * size * count // 2, **shapes)
    if source.loops:
        source.line(f"sums = square_of_rows({source.array_of('d')}.T.copy())")

    def entry(a, b):
        if source.loops:
            return f"w * sums[{a}, {b}] + b * (shift[{a}] * shift[{b}])"
        products = source.sum(f"d[{i}][{a}] * d[{i}][{b}]" for i in source.range(count))
        return f"w * ({products}) + b * (shift[{a}] * shift[{b}])"

    return source.function(source.symmetric("p", size, entry), square_of_rows=arrays.square_of_rows)


@cache
def cross_scatter(n: int, m: int) -> Callable:
    """Return `cross(l, e, f)`: f sum_i L_i (e_i - e_{n+i})', (n, m), for f = weight times spread."""
    source = Source("cross", "l, e, f", result=(n, m), l=(n, n), e=(2 * n, m), work=n * n * m)

    def entry(a, c):
        products = (f"l[{a}][{i}] * (e[{i}][{c}] - e[{n + i}][{c}])" for i in source.range(n))
        return f"f * ({source.sum(products)})"

    return source.function(source.matrix(n, m, entry))


@cache
def residuals(n: int, m: int) -> Callable:
    """Return `rest(l, s, k, e)`: what the gain k (n, m) leaves of the points' deviations, +-s L_i - K e_i."""
    shapes = {"l": (n, n), "k": (n, m), "e": (2 * n, m)}
    source = Source("rest", "l, s, k, e", result=(2 * n, n), work=2 * n * n * m, **shapes)
    left = source.local("x", 2 * n, n)
    for sign, first in (("", 0), ("-", n)):
        for i in source.range(n):
            for a in source.range(n):
                known = source.sum(f"k[{a}][{c}] * e[{i + first}][{c}]" for c in source.range(m))
                source.line(f"{left[i + first, a]} = {sign}s * l[{a}][{i}] - ({known})")
    return source.function(source.whole(left))


@cache
def silenced_columns(count: int, m: int) -> Callable:
    """Return `silence(d, z)`: vectors d (count, m) with zeros in the channels that are NaN in z."""
    shape = count, m
    return entrywise(
        "silence", "d, z", shape, lambda i, c: f"(d[{i}][{c}] if z[{c}] == z[{c}] else 0.0)", d=shape, z=(m,)
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
    moved, seen = at_points(transition, "x, u, c", n, n, count), at_points(observe, "x, c", n, m, count)
    root_of, around = matrices.semidefinite_factor(n), points_around(n, centre)
    state_deviations = deviations(n, 2 * n, centre, shape.state_angles)
    measured_deviations = deviations(m, 2 * n, centre, shape.measurement_angles)
    state_scatter, measured_scatter, cross = scatter(n, 2 * n), scatter(m, 2 * n), cross_scatter(n, m)
    add_n, add_m = matrices.symmetric_sum(n), matrices.symmetric_sum(m)
    silence, mask = silenced_columns(2 * n, m), matrices.masked(m)
    silence_shift = entrywise(
        "silence", "d, z", (m,), lambda c: f"(d[{c}] if z[{c}] == z[{c}] else 0.0)", d=(m,), z=(m,)
    )
    present, factor, solve = innovation_of(shape), matrices.cholesky_factor(m), matrices.row_solver(n, m)
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
        _, weight, shift_weight = read_set(numbers)
        mean, shift, d = state_deviations(read_points(row), weight)
        store_mean(row, mean)
        store_cov(row, add_n(state_scatter(d, shift, weight, shift_weight), read_q(numbers)))
        row[step_place] += 1.0

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        spread, weight, shift_weight = read_set(numbers)
        mean, root, z = read_mean(row), root_of(read_cov(row)), measured(z)
        y, shift, e = measured_deviations(seen(around(mean, root, spread), constants(numbers)), weight)
        e, shift = silence(e, z), silence_shift(shift, z)
        r, innovation = mask(read_r(numbers), z), present(z, y)
        s = add_m(measured_scatter(e, shift, weight, shift_weight), r)
        s_root = factor(s)
        k = solve(cross(root, e, weight * spread), s_root)
        store_mean(row, corrected(mean, 1.0, apply(k, innovation)))
        left = state_scatter(rest(root, spread, k, e), apply(k, shift), weight, shift_weight)
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
