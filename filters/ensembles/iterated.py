"""The iterated ensemble Kalman filter: the measurement function linearised where the members come to lie."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import ClassVar

from filters.engine.layout import own_place
from filters.ensembles.deterministic import member_mover, moved_member
from filters.ensembles.ensemble import EnsembleFilter, measurement_moments, silencer
from filters.ensembles.members import row_covariances, row_means
from filters.ensembles.transform import geometric_mean, transform_gain
from numerics import matrices
from numerics.checks import at_least
from numerics.compiled import inlined
from numerics.sources import Source, entrywise, is_array
from numerics.tuples import column_writer, vector_reader, zeros_of
from plants.layout import constants_reader
from plants.shape import Shape, innovation_of

MOST_ITERATIONS = 1000


@cache
def transform_undone(n: int, m: int) -> Callable:
    """Return `undone(table, j, means, d)`: y_j - mean(y) + D Y_j, (m,), with y in rows n ... and Y after them.

    The means are those of the rows, d is (m, m).
    """
    source = Source("undone", "table, j, means, d", result=(m,), means=(n + 2 * m,), d=(m, m))

    def entry(i):
        first = f"table[{n + i}, j] - means[{n + i}]"
        return source.less(first, (f"d[{i}][{k}] * table[{n + m + k}, j]" for k in source.range(m)), "+")

    return source.function(source.vector(m, entry))


@cache
def linear_prediction(m: int) -> Callable:
    """Return `predict(e, d, s, r, w)`: (E + D (S - R)) w, (m,), what the latest slopes make of the last move."""
    square = m, m
    source = Source("predict", "e, d, s, r, w", result=(m,), e=square, d=square, s=square, r=square, w=(m,))
    v = source.local("v", m)
    for i in source.range(m):
        terms = (f"(s[{i}][{k}] - r[{i}][{k}]) * w[{k}]" for k in source.range(m))
        source.line(f"{v[i]} = {source.sum(terms)}")

    def entry(i):
        return source.sum(f"e[{i}][{k}] * w[{k}] + d[{i}][{k}] * {v[k]}" for k in source.range(m))

    return source.function(source.vector(m, entry))


@lru_cache(maxsize=64)
def iterated_analysis(observe: Callable, shape: Shape) -> Callable:
    """The analysis of the iterated ensemble Kalman filter; see `ensemble_kernels`."""
    n, m = shape.n, shape.m
    slopes, iterations_place = n + m, own_place(shape) + 2  # Y lies in rows n + m ... of the table
    compare, gain, geometric = measurement_moments(observe, shape), transform_gain(n, m), geometric_mean(m)
    constants, measured, difference = constants_reader(shape), vector_reader(m), innovation_of(shape, n)
    store_predicted, store_slopes = column_writer(m, n), column_writer(m, slopes)
    move, moved, undone, predict = (
        member_mover(n, m, slopes),
        moved_member(n, m, slopes),
        transform_undone(n, m),
        linear_prediction(m),
    )
    add, factor, solve = matrices.symmetric_sum(m), matrices.cholesky_factor(m), matrices.row_solver(m, m)
    apply, solve_one, means_of = matrices.vector_multiplier(n, m), matrices.vector_solver(m), row_means(n + m)
    of_predicted_and_slopes, of_slopes = row_covariances(n, m, slopes, m), row_covariances(slopes, m, slopes, m)
    of_states_and_slopes, none = row_covariances(0, n, slopes, m), zeros_of(m)
    silence = silencer(n, shape.measurement_angles)
    total = entrywise("total", "a, b", (m,), lambda i: f"a[{i}] + b[{i}]", a=(m,), b=(m,))
    source = Source("with_slopes", "means", result=(n + 2 * m,), means=(n + m,))
    known = source.local("known", n + 2 * m)
    for i in source.range(n + m):
        source.line(f"{known[i]} = means[{i}]")
    for i in source.range(n + m, n + 2 * m):
        source.line(f"{known[i]} = 0.0")
    with_slopes = source.function(source.whole(known))

    at_once, store_state = is_array(n, m), column_writer(n)

    @inlined
    def analyse(memory, z, numbers, size):
        expected, innovation, cross, s, r, root = compare(memory, z, numbers, size)
        _, table, _ = memory
        for i in range(m):
            for j in range(table.shape[1]):
                table[slopes + i, j] = table[n + i, j] - expected[i]
        c, present = constants(numbers), measured(z)
        w = solve_one(innovation, root)
        shift, g = apply(cross, w), gain(cross, s, r, root)
        for _ in range(1, int(numbers[iterations_place])):
            for j in range(table.shape[1]):
                store_predicted(table, j, observe(moved(table, j, shift, g, none()), c))
            silence(table, z, size)
            means = with_slopes(means_of(table, size))
            e = of_predicted_and_slopes(table, size, means)
            d = solve(e, factor(add(r, geometric(r, s))))
            for j in range(table.shape[1]):
                store_slopes(table, j, undone(table, j, means, d))
            misfit = total(difference(present, means), predict(e, d, s, r, w))
            cross = of_states_and_slopes(table, size, means)
            s = add(of_slopes(table, size, means), r)
            root = factor(s)
            w = solve_one(misfit, root)
            shift, g = apply(cross, w), gain(cross, s, r, root)
        if at_once:
            move(table, shift, g, none())
        else:
            for j in range(table.shape[1]):
                store_state(table, j, moved(table, j, shift, g, none()))

    return analyse


@dataclass(frozen=True, kw_only=True, eq=False)
class IteratedEnsembleKalmanFilter(EnsembleFilter):
    """Iterated ensemble Kalman filter (IEnKF) over one update, for nonlinear measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q);  X (n, N) the members' distances from their mean
        update:  least over w (N,) of (N - 1) w'w + (z - h(mean + X w))' R^-1 (z - h(mean + X w)), by Gauss-Newton:
                 from w = 0 and T = I on, `iterations` times,
                 y_j = h(mean + X w + X T e_j),  Y = (y - mean(y)) T^-1,  S = Y Y'/(N - 1) + R,
                 w = Y' S^-1 (z - mean(y) + Y w)/(N - 1),  T = (I + Y' R^-1 Y/(N - 1))^-1/2;
                 then x_j = mean + X w + X T e_j,  e_j the j-th unit vector

    The slopes of h are thus those at the estimate, averaged over its uncertainty. One
    iteration is the `EnsembleTransformFilter`; where h is linear, further ones change nothing. T and its inverse
    are symmetric and N x N, and never formed. The innovation and its covariance are those of the first iteration.

    The motion f is not run again, unlike in methods that re-estimate the last state together with this one (Sakov,
    Oliver and Bertino do so, without process noise). Steps are not damped: where the measurement fits several
    states, iterations may jump between them. Where a measurement is far more accurate than the forecast, T^-1
    magnifies any nonlinearity of h along unobserved directions, and iterations gain little.

    Attributes:
        iterations: evaluations of h by all members in an update, at least 1. The others are those of
            `EnsembleFilter`.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Sakov, Oliver, Bertino (2012), "An iterative EnKF for strongly nonlinear systems"; over the update
    alone it is the filter of Zupanski (2005), "Maximum likelihood ensemble filter: theoretical aspects", solved as
    in Bocquet, Sakov (2012), "Combining inflation-free and iterative ensemble Kalman filters for strongly
    nonlinear systems".
    """

    name: ClassVar[str] = "ienkf"
    iterations: int = 3

    @property
    def analysis(self) -> Callable:
        """The update, as `ensemble_kernels` takes it."""
        return iterated_analysis

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))

    @property
    def own_numbers(self) -> tuple[float, ...]:
        """Inflation, relaxation, iterations."""
        return (*super().own_numbers, float(self.iterations))
