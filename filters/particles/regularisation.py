"""Regularisation of resampled particles: copies of one are spread by a Gaussian kernel."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from filters.engine.layout import own_place
from filters.particles.motion import add_noise, drawer
from thruster_env.numerics import matrices
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.streams import FILTER_KERNEL
from thruster_env.numerics.tuples import matrix_reader, matrix_writer
from thruster_env.plants.shape import Shape


@cache
def kernel_width(count: int) -> Callable:
    """Return `width(size)`: h = (4/(d + 2))^(1/(d + 4)) N^(-1/(d + 4)) of N particles in d dimensions.

    It makes the mean integrated square error of the density least where that is Gaussian.

    Source: Silverman (1986), Density Estimation for Statistics and Data Analysis, section 4.3.2.
    """
    power = 1.0 / (count + 4.0)
    unit = (4.0 / (count + 2.0)) ** power

    @inlined
    def width(size):
        return unit * size**-power

    return width


@cache
def cov_spreader(shape: Shape, root_place: int) -> Callable:
    """Return `spread(memory, cov, factor)`: x_j += factor e_j, e_j ~ N(0, cov), cov (n, n).

    The root of factor^2 cov is put into n^2 numbers of the row, from a place on.
    """
    n, m = shape.n, shape.m
    factorise, store, draw = matrices.semidefinite_factor(n), matrix_writer(n, n, root_place), drawer(n, m)

    @inlined
    def spread(memory, cov, factor):
        row, table, draws = memory
        store(row, factorise(cov))
        for i in range(n * n):
            row[root_place + i] *= factor
        draw(draws, n * table.shape[1], row, FILTER_KERNEL)
        add_noise(table, 0, n, draws, row, root_place)

    return spread


@cache
def kernel_spreader(shape: Shape, root_place: int) -> Callable:
    """Return `spread(memory, cov, numbers, size)`: x_j += c h e_j, e_j ~ N(0, cov), cov (n, n).

    c is the first of the filter's own numbers, h the `kernel_width`. The row has n^2 numbers of scratch.

    Source: Musso, Oudjane, Le Gland (2001), "Improving regularised particle filters", in Sequential Monte
    Carlo Methods in Practice.
    """
    factor_place, width, spread_by = own_place(shape), kernel_width(shape.n), cov_spreader(shape, root_place)

    @inlined
    def spread(memory, cov, numbers, size):
        spread_by(memory, cov, numbers[factor_place] * width(size))

    return spread


@cache
def constants_spreader(shape: Shape, smoothed: tuple[int, ...], root_place: int) -> Callable:
    """Return `spread(memory, cov, numbers, size)`: x_j = m + a (x_j - m) + b e_j of the `smoothed` states alone.

    m is the mean of the particles, e_j ~ N(0, cov), b = c h as in `kernel_spreader`, h that of as many states, at
    most 1, and a = (1 - b^2)^(1/2), so that mean and covariance stay what they are.

    Source: Liu, West (2001), "Combined parameter and state estimation in simulation-based filtering", in
    Sequential Monte Carlo Methods in Practice, section 10.2.3; with their discount factor d
    b^2 = 1 - ((3 d - 1)/(2 d))^2.
    """
    n, factor_place = shape.n, own_place(shape)
    width, spread_by, flags = kernel_width(len(smoothed)), cov_spreader(shape, root_place), flags_of(smoothed, n)
    store, read = matrix_writer(n, n, root_place), matrix_reader(n, n, root_place)

    @inlined
    def spread(memory, cov, numbers, size):
        row, table, _ = memory
        store(row, cov)
        for i in range(n):
            for k in range(n):
                row[root_place + i * n + k] *= flags[i] * flags[k]
        b = min(numbers[factor_place] * width(size), 1.0)
        rest = 1.0 - (1.0 - b * b) ** 0.5
        for i in smoothed:
            mean = 0.0
            for j in range(size):
                mean += table[i, j] / size
            for j in range(table.shape[1]):
                table[i, j] -= rest * (table[i, j] - mean)
        spread_by(memory, read(row), b)

    return spread


def flags_of(places: tuple[int, ...], count: int) -> tuple[float, ...]:
    """1 at some of so many places, 0 elsewhere."""
    return tuple(float(i in places) for i in range(count))
