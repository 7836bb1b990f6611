"""The serial ensemble square root filter: measurements taken in one channel after the other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import ClassVar

from filters.ensembles.deterministic import DeterministicUpdateFilter, deterministic_analysis
from numerics import matrices
from numerics.compiled import inlined
from numerics.sources import entrywise
from plants.shape import Shape


@cache
def serial_gain(n: int, m: int) -> Callable:
    """Return `gain(cross, s, r, root)`: G = K L (L + M)^-1 with L and M the lower triangular roots of S and R.

    Shapes: cross (n, m), s, r and root (m, m).
    """
    solve, times, divide = matrices.row_solver(n, m), matrices.multiplier(n, m, m), matrices.triangle_divider(n, m)
    factor = matrices.cholesky_factor(m)
    add = entrywise("add", "a, b", (m, m), lambda i, j: f"a[{i}][{j}] + b[{i}][{j}]", a=(m, m), b=(m, m))

    @inlined
    def gain(cross, s, r, root):
        return divide(times(solve(cross, root), root), add(root, factor(r)))

    return gain


@cache
def serial_analysis(observe: Callable, shape: Shape) -> Callable:
    """The analysis of the serial ensemble square root filter; see `ensemble_kernels`."""
    return deterministic_analysis(serial_gain(shape.n, shape.m), observe, shape)


@dataclass(frozen=True, kw_only=True, eq=False)
class SerialSquareRootFilter(DeterministicUpdateFilter):
    """Serial ensemble square root filter (EnSRF), without perturbed measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = M^-1 h(x_j) and z = M^-1 z, M the lower triangular root of R: channels with independent
                 noise of variance 1; then for one channel i after the other, in x and in the channels to come,
                 s = var(y_i) + 1,  k = cov(x, y_i)/s,  mean += k (z_i - mean(y_i)),
                 x_j - mean(x) -= k (y_ij - mean(y_i))/(1 + s^-1/2);  sample covariances with divisor N - 1

    For all channels together that is x_j += K innovation - K L (L + M)^-1 (h(x_j) - mean(h)), with L the lower
    triangular root of S = cov(h, h) + R: Andrews' square root, for taking the channels in turn is the elimination
    that makes L. So it is computed. The covariance after an update is exactly P - K S K', where the stochastic
    filter's is so on average only; the mean moves as the Kalman filter's. The update draws nothing: only the
    process noise of the members is random, and the error of its sample mean and covariance enters the estimate.

    With one channel it is the `EnsembleTransformFilter`. Close relatives go by the name of EnKF-SR in the
    literature on ships. Attributes are those of `DeterministicUpdateFilter`.

    Source: Whitaker, Hamill (2002), "Ensemble data assimilation without perturbed observations", equations (10) to
    (13); Andrews (1968), "A square root formulation of the Kalman covariance equations".
    """

    name: ClassVar[str] = "ensrf"

    @property
    def analysis(self) -> Callable:
        """The update, as `ensemble_kernels` takes it."""
        return serial_analysis
