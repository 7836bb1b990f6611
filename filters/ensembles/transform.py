"""The ensemble transform Kalman filter: members moved by the symmetric square root."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

from filters.ensembles.deterministic import DeterministicUpdateFilter, deterministic_analysis
from numerics import matrices
from numerics.compiled import inlined
from numerics.sources import Source, entrywise, is_array
from plants.shape import Shape

ROUNDS = 14  # enough for condition numbers of 1e16: at the end each round doubles the figures
CLOSE = 1e-10  # of the sum's determinant to what it is where both are equal: one round more, and they are


@cache
def geometric_mean(size: int) -> Callable:
    """Return `mean(a, b)`: A (A^-1 B)^(1/2) of two covariances, itself a covariance.

    Arithmetic and harmonic mean of the two, taken again and again, meet there. With both scaled to determinant 1
    one round is enough for two channels, and one channel needs none.

    Source: Bhatia (2007), Positive Definite Matrices, chapter 4; scaling by determinants: Higham (2008), Functions
    of Matrices, section 6.5.
    """
    if size == 1:
        return entrywise("mean", "a, b", (1, 1), lambda i, j: "(a[0][0] * b[0][0]) ** 0.5", a=(1, 1), b=(1, 1))
    rounds = 1 if size == 2 else ROUNDS
    close = 1.0 + CLOSE if is_array(size, size) else 0.0  # small ones take no time
    factor, solve = matrices.cholesky_factor(size), matrices.row_solver(size, size)
    times, add = matrices.multiplier(size, size, size), matrices.symmetric_sum(size)
    source = Source("unit", "l", l=(size, size))  # l l' over this has determinant 1
    unit = source.function(source.product(f"l[{i}][{i}] ** {2.0 / size!r}" for i in source.range(size)))
    scaled = entrywise("scaled", "a, f", (size, size), lambda i, j: f"f * a[{i}][{j}]", a=(size, size))

    @inlined
    def mean(a, b):
        unit_a, unit_b = unit(factor(a)), unit(factor(b))
        a, b = scaled(a, 1.0 / unit_a), scaled(b, 1.0 / unit_b)
        rounds_left = rounds
        while rounds_left > 0:
            rounds_left -= 1
            both = add(a, b)
            root = factor(both)
            parallel = times(solve(a, root), b)  # (a^-1 + b^-1)^-1
            unit_both = unit(root)
            if 0.5 * unit_both < close:  # it is 1 for equal ones, else larger
                rounds_left = min(rounds_left, 1)
            a, b = scaled(both, 1.0 / unit_both), scaled(add(parallel, parallel), 0.5 * unit_both)
        return scaled(a, (unit_a * unit_b) ** 0.5)

    return mean


@cache
def transform_gain(n: int, m: int) -> Callable:
    """Return `gain(cross, s, r, root)`: G = cross (S + R # S)^-1, # the geometric mean.

    Shapes: cross (n, m), s, r and root (m, m).
    """
    mean, add, factor = geometric_mean(m), matrices.symmetric_sum(m), matrices.cholesky_factor(m)
    solve = matrices.row_solver(n, m)

    @inlined
    def gain(cross, s, r, root):
        return solve(cross, factor(add(s, mean(r, s))))

    return gain


@cache
def transform_analysis(observe: Callable, shape: Shape) -> Callable:
    """The analysis of the ensemble transform Kalman filter; see `ensemble_kernels`."""
    return deterministic_analysis(transform_gain(shape.n, shape.m), observe, shape)


@dataclass(frozen=True, kw_only=True, eq=False)
class EnsembleTransformFilter(DeterministicUpdateFilter):
    """Ensemble transform Kalman filter (ETKF) with the symmetric square root, without perturbed measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  innovation = z - mean(y),  X (n, N) and Y (m, N) the distances from the means,
                 mean(x) += X T^2 Y' R^-1 innovation/(N - 1),  X = X T,  T = (I + Y' R^-1 Y/(N - 1))^-1/2

    T is symmetric: the mean stays exactly, and the members move as little as they can. It is N x N and never
    formed. With S = Y Y'/(N - 1) + R and the geometric mean R # S = R (R^-1 S)^1/2 of the two, which is the root
    of R S for one channel, T = I - Y' (S + R # S)^-1 Y/(N - 1) and X T = X - cov(x, y) (S + R # S)^-1 Y.

    The covariance after an update is exactly P - K S K', where the stochastic filter's is so on average only; the
    mean moves as the Kalman filter's. The update draws nothing: only the process noise of the members is random,
    and the error of its sample mean and covariance enters the estimate. Attributes are those of
    `DeterministicUpdateFilter`.

    Source: Bishop, Etherton, Majumdar (2001), "Adaptive sampling with the ensemble transform Kalman filter", part
    I; the symmetric root: Hunt, Kostelich, Szunyogh (2007), "Efficient data assimilation for spatiotemporal chaos:
    a local ensemble transform Kalman filter", section 2.3, here without localisation.
    """

    name: ClassVar[str] = "etkf"

    @property
    def analysis(self) -> Callable:
        """The update, as `ensemble_kernels` takes it."""
        return transform_analysis
