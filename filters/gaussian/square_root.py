"""The square-root form of the Kalman filter: the root of the covariance is carried, by orthogonal steps."""

from __future__ import annotations

from functools import lru_cache

from filters.engine.belief import Kernels
from filters.engine.layout import mean_writer, memory_places, row_access
from filters.gaussian.extended import gaussian_start, in_stages, nothing_at_first, nothing_to_summarise, silenced
from numerics import matrices
from numerics.compiled import inlined
from numerics.tuples import (
    assembled,
    matrix_reader,
    matrix_writer,
    part_of,
    scaled_sum,
    vector_reader,
)
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape, innovation_of, observation_slopes, transition_slopes


@lru_cache(maxsize=64)
def square_root_kernels(functions: Functions, shape: Shape) -> Kernels:
    """Kernels for a model's functions and shape; the extras are L (n, n), lower triangular, with P = L L'.

    An orthogonal Theta from the right makes a matrix lower triangular (`matrices.triangular_root`):

        predict: [F L, Q^(1/2)] Theta = [L, 0]
        update:  [[R^(1/2), H L], [0, L]] Theta = [[S^(1/2), 0], [K S^(1/2), L]],
                 mean += (K S^(1/2)) S^(-1/2) innovation

    No covariance is ever formed from another: P = L L' is for the reader only. L keeps twice the digits that P
    would, of states known a million times better than others.

    Source: Kaminski, Bryson, Schmidt (1971), "Discrete square root filtering: a survey of current techniques",
    IEEE Trans. Automatic Control 16(6).
    """
    n, m, transition, observe = shape.n, shape.m, functions.transition, functions.observe
    places, source = memory_places(n, m), number_places(n, m)
    step_place, likelihood_place = places.step, places.log_likelihood
    read_mean, store_mean = vector_reader(n, places.mean), mean_writer(shape)
    read_root, write_root = matrix_reader(n, n, places.extras), matrix_writer(n, n, places.extras)
    write_cov, prior_root = matrix_writer(n, n, places.cov), matrix_reader(n, n, source.prior_root)
    _, _, (store_innovation, store_s) = row_access(shape)
    read_q_root, read_r = matrix_reader(n, n, source.q_root), matrix_reader(m, m, source.r)
    constants, control, measured = constants_reader(shape), vector_reader(shape.inputs), vector_reader(m)
    read_scales, begin = vector_reader(n, source.scales), gaussian_start(shape)
    transition_matrix = transition_slopes(functions, shape)
    observation_matrix = observation_slopes(functions, shape)
    times_n, times_m = matrices.multiplier(n, n, n), matrices.multiplier(m, n, n)
    square_n, square_m = matrices.square(n, n), matrices.square(m, m)
    triangle_n, triangle = matrices.triangular_root(n, 2 * n), matrices.triangular_root(m + n, m + n)
    mask, factor, silent = matrices.masked(m), matrices.cholesky_factor(m), silenced(m, n)
    present, likelihood = innovation_of(shape), matrices.innovation_likelihood(m)
    solve, apply, moved = matrices.forward_solver(m), matrices.vector_multiplier(n, m), scaled_sum(n)
    nn, mm, mn, both = (n, n), (m, m), (m, n), (m + n, m + n)
    beside = assembled("beside", "a, b", (n, 2 * n), {"a": (nn, 0, 0), "b": (nn, 0, n)})
    stacked = assembled("stacked", "r, hl, l", both, {"r": (mm, 0, 0), "hl": (mn, 0, m), "l": (nn, m, m)})
    top_left, bottom_left, bottom_right = part_of(m, m, both), part_of(n, m, both, m), part_of(n, n, both, m, m)

    @inlined
    def store_root(row, root):
        write_root(row, root)
        write_cov(row, square_n(root))

    @inlined
    def start(memory, numbers, size):
        begin(memory, numbers, size)
        write_root(memory[0], prior_root(numbers))

    @inlined
    def advance(memory, u, numbers, size):
        row, _, _ = memory
        mean, v, c = read_mean(row), control(u), constants(numbers)
        f = transition_matrix(mean, read_scales(numbers), v, c)
        store_mean(row, transition(mean, v, c))
        write_root(row, times_n(f, read_root(row)))

    @inlined
    def finish(memory, u, numbers, size):
        row, _, _ = memory
        store_root(row, triangle_n(beside(read_root(row), read_q_root(numbers))))
        row[step_place] += 1.0

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        mean, root, c, z = read_mean(row), read_root(row), constants(numbers), measured(z)
        h = silent(observation_matrix(mean, read_scales(numbers), c), z)
        innovation = present(z, observe(mean, c))
        both = triangle(stacked(factor(mask(read_r(numbers), z)), times_m(h, root), root))
        s_root = top_left(both)
        store_mean(row, moved(mean, 1.0, apply(bottom_left(both), solve(s_root, innovation))))
        store_root(row, bottom_right(both))
        store_innovation(row, innovation)
        store_s(row, square_m(s_root))
        row[likelihood_place] = likelihood(innovation, s_root, z)

    stages = nothing_at_first, advance, finish
    predict = in_stages(n, m, *stages)
    return Kernels(n, m, n, 0, start, predict, update, nothing_to_summarise, extras=n * n, stages=stages)
