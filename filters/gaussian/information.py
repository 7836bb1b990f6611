"""The information form of the Kalman filter: the update works on the inverse of the covariance."""

from __future__ import annotations

from functools import lru_cache

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, row_access
from filters.gaussian.extended import extended_kernels, gaussian_innovation
from numerics import matrices
from numerics.compiled import inlined
from numerics.tuples import matrix_reader, scaled_sum, vector_reader
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape, observation_slopes


@lru_cache(maxsize=64)
def information_kernels(functions: Functions, shape: Shape) -> Kernels:
    """Kernels for a model's functions and shape; they predict as the extended filter does.

        update: Y = P^-1 + H' R^-1 H,  P = Y^-1,  mean += P H' R^-1 innovation

    Every channel adds its own information H' R^-1 H, so many channels and few states are cheap; no gain and no
    inverse of S are needed, which is here for the likelihood only. P must be positive definite throughout.
    Inverses are products W' W of inverse Cholesky factors W, symmetric and positive by construction.

    Source: Anderson, Moore (1979), Optimal Filtering, section 6.3.
    """
    n, m, observe = shape.n, shape.m, functions.observe
    places, source = memory_places(n, m), number_places(n, m)
    (read_mean, read_cov), (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    constants, measured, read_r = constants_reader(shape), vector_reader(m), matrix_reader(m, m, source.r)
    read_scales, likelihood_place = vector_reader(n, source.scales), places.log_likelihood
    observation_matrix, compare = observation_slopes(functions, shape), gaussian_innovation(shape)
    factor_n, factor_m = matrices.cholesky_factor(n), matrices.cholesky_factor(m)
    invert, likelihood = matrices.factored_inverse(n), matrices.innovation_likelihood(m)
    transposed = matrices.transposer(m, n)
    weigh, times, add = matrices.row_solver(n, m), matrices.multiplier(n, m, n), matrices.symmetric_sum(n)
    apply_n, apply_m, moved = matrices.vector_multiplier(n, n), matrices.vector_multiplier(n, m), scaled_sum(n)

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        mean, p, c, z = read_mean(row), read_cov(row), constants(numbers), measured(z)
        h = observation_matrix(mean, read_scales(numbers), c)
        innovation, s, s_root, _, h, r = compare(p, z, observe(mean, c), h, read_r(numbers))
        weight = weigh(transposed(h), factor_m(r))  # H' R^-1
        p = invert(factor_n(add(invert(factor_n(p)), times(weight, h))))
        store_mean(row, moved(mean, 1.0, apply_n(p, apply_m(weight, innovation))))
        store_cov(row, p)
        store_innovation(row, innovation)
        store_s(row, s)
        row[likelihood_place] = likelihood(innovation, s_root, z)

    return extended_kernels(functions, shape)._replace(update=update)
