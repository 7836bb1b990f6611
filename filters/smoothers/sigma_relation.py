"""Relation of the states of two successive steps, by sigma points: for smoothers of such filters."""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache

from filters.engine.layout import own_place
from filters.gaussian.sigma_points import (
    PointSet,
    at_points,
    cross_scatter,
    deviations,
    points_around,
    residuals,
    scatter,
)
from filters.smoothers.rts import careful_factor
from numerics import matrices
from numerics.compiled import inlined
from numerics.tuples import matrix_reader, vector_reader
from plants.layout import constants_reader, number_places
from plants.shape import Shape


@lru_cache(maxsize=64)
def sigma_relation(transition: Callable, shape: Shape, centre: bool) -> Callable:
    """Return `relate(mean, p, u, numbers)` of an unscented filter, or of a cubature filter (no centre).

        points x_i = mean +- g L_i,  L L' = P;  f_i = f(x_i, u);  predicted mean and P as the filter predicts,
        G = cov(x, f) (predicted P)^-1,  d_i = x_i - mean - G (f_i - f_0),
        bracket = w sum d_i d_i' + b (G s)(G s)' + G Q G'

    with f_0, s, w, b those of `UnscentedKalmanFilter` (the mean of the f_i and s = 0 in a cubature filter). The
    bracket equals P - G (predicted P) G' and is a sum of squares.

    Source: Sarkka (2008), "Unscented Rauch-Tung-Striebel smoother", algorithm 1, with additive noise; for cubature
    points Arasaratnam, Haykin (2011), "Cubature Kalman smoothers".
    """
    n, m = shape.n, shape.m
    source, own, count = number_places(n, m), own_place(shape), 2 * n + centre
    substeps_place, constants, control = source.substeps, constants_reader(shape), vector_reader(shape.inputs)
    read_q, read_set = matrix_reader(n, n, source.q), vector_reader(len(PointSet._fields), own)
    moved = at_points(transition, "x, u, c", n, n, count)
    root_of, around, deviate = (
        matrices.semidefinite_factor(n),
        points_around(n, centre),
        deviations(n, 2 * n, centre, shape.state_angles),
    )
    sum_of, cross, rest = scatter(n, 2 * n), cross_scatter(n, n), residuals(n, n)
    factor, solve, apply = careful_factor(n), matrices.row_solver(n, n), matrices.vector_multiplier(n, n)
    times, times_transposed, add = (
        matrices.multiplier(n, n, n),
        matrices.transposed_multiplier(n, n, n),
        matrices.symmetric_sum(n),
    )

    @inlined
    def relate(mean, p, u, numbers):
        v, c, q, root = control(u), constants(numbers), read_q(numbers), root_of(p)
        spread, weight, shift_weight = read_set(numbers)
        points = around(mean, root, spread)
        for _ in range(int(numbers[substeps_place])):
            points = moved(points, v, c)
        predicted_mean, shift, d = deviate(points, weight)
        predicted = add(sum_of(d, shift, weight, shift_weight), q)
        gain = solve(cross(root, d, weight * spread), factor(predicted))
        left = sum_of(rest(root, spread, gain, d), apply(gain, shift), weight, shift_weight)
        return predicted_mean, gain, add(left, times_transposed(times(gain, q), gain))

    return relate
