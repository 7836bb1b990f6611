"""The second moment of the measurement noise, from which adaptive and robust filters estimate R."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, lru_cache

from filters.gaussian.extended import silenced
from numerics import matrices
from numerics.compiled import inlined
from numerics.sources import Source, entrywise
from plants.shape import Shape, innovation_of


@lru_cache(maxsize=64)
def measurement_noise_moment(shape: Shape) -> Callable:
    """Return `expect(p, z, predicted, h, r)`: E[v v' | z] of v ~ N(0, R) in z = h(x) + v, for x of covariance P.

    With S = H P H' + R and G = R S^-1: E[v | z] = G innovation, and in Joseph's form cov(v | z) is
    (I - G) R (I - G)' + G H P H' G'; the moment is positive definite whatever is measured. With the residual
    e = innovation - H K innovation and the covariance P after the update it is e e' + H P H'. Channels that are
    NaN in z carry no information; their part of the moment follows from the others through R.
    """
    n, m = shape.n, shape.m
    mask, factor, solve = matrices.masked(m), matrices.cholesky_factor(m), matrices.row_solver(m, m)
    silent, difference = silenced(m, n), innovation_of(shape)
    p_ht, h_p_ht = matrices.transposed_multiplier(n, n, m), matrices.multiplier(m, n, m)
    mm = m, m
    present = entrywise(
        "present", "r, z", mm, lambda i, j: f"(r[{i}][{j}] if z[{j}] == z[{j}] else 0.0)", r=mm, z=(m,)
    )
    times, times_transposed = matrices.multiplier(m, m, m), matrices.transposed_multiplier(m, m, m)
    square, less, add, apply = (
        outer(m),
        matrices.identity_less(m),
        matrices.symmetric_sum(m),
        matrices.vector_multiplier(m, m),
    )

    @inlined
    def expect(p, z, predicted, observation_matrix, r):
        h = silent(observation_matrix, z)
        spread = h_p_ht(h, p_ht(p, h))
        g = solve(present(r, z), factor(add(spread, mask(r, z))))
        rest = less(g)
        cov = add(times_transposed(times(rest, r), rest), times_transposed(times(g, spread), g))
        return add(square(apply(g, difference(z, predicted))), cov)

    return expect


@cache
def outer(size: int) -> Callable:
    """Return `square(x)`: the matrix x x' of a tuple."""
    return entrywise("square", "x", (size, size), lambda i, j: f"x[{i}] * x[{j}]", x=(size,))


@cache
def mixer(size: int) -> Callable:
    """Return `mix(a, x, b, y)`: the matrix a x + b y for scalars a, b and square matrices x, y."""
    shape = size, size
    return entrywise(
        "mix", "a, x, b, y", shape, lambda i, j: f"a * x[{i}][{j}] + b * y[{i}][{j}]", x=shape, y=shape
    )


@cache
def trace_of(size: int) -> Callable:
    """Return `trace(a)`, the sum of the diagonal."""
    source = Source("trace", "a", a=(size, size))
    return source.function(source.sum(f"a[{i}][{i}]" for i in source.range(size)))
