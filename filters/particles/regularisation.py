"""Regularisation of resampled particles: copies of one are spread by a Gaussian kernel."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from filters.engine.layout import memory_places, own_place
from filters.particles.motion import add_noise, drawer
from thruster_env.numerics import matrices
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.streams import FILTER_KERNEL
from thruster_env.numerics.tuples import matrix_writer
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
def kernel_spreader(shape: Shape) -> Callable:
    """Return `spread(memory, cov, numbers, size)`: x_j += c h e_j, e_j ~ N(0, cov), cov (n, n).

    c is the first of the filter's own numbers, h the `kernel_width`. The root of the kernel's covariance is put
    into n^2 numbers of the row, behind the ESS.

    Source: Musso, Oudjane, Le Gland (2001), "Improving regularised particle filters", in Sequential Monte Carlo
    Methods in Practice.
    """
    n, m = shape.n, shape.m
    factor_place, root_place = own_place(shape), memory_places(n, m).extras + 1
    factorise, store, draw = matrices.semidefinite_factor(n), matrix_writer(n, n, root_place), drawer(n, m)
    width = kernel_width(n)

    @inlined
    def spread(memory, cov, numbers, size):
        row, table, draws = memory
        store(row, factorise(cov))
        for i in range(n * n):
            row[root_place + i] *= numbers[factor_place] * width(size)
        draw(draws, n * table.shape[1], row, FILTER_KERNEL)
        add_noise(table, 0, n, draws, row, root_place)

    return spread
