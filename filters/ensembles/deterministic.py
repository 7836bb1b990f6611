"""Ensemble analyses without perturbed measurements, and the one with half the gain: the deterministic EnKF."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import Any, ClassVar

from filters.engine.belief import Kernels
from filters.ensembles.ensemble import EnsembleFilter, measurement_moments
from filters.ensembles.rotation import with_rotation
from numerics import arrays, matrices
from numerics.checks import switch
from numerics.compiled import inlined
from numerics.sources import Source, entrywise, is_array
from numerics.tuples import column_writer
from plants.shape import Shape


@cache
def moved_member(n: int, m: int, first: int) -> Callable:
    """Return `moved(table, j, shift, g, means)`: x_j + shift - g (y_j - mean), y_j in rows first, first + 1, ...

    Shapes: shift (n,), g (n, m), means (m,).
    """
    shapes: dict[str, Any] = {"result": (n,), "shift": (n,), "g": (n, m), "means": (m,)}
    source = Source("moved", "table, j, shift, g, means", **shapes)
    d = source.local("d", m)
    for i in source.range(m):
        source.line(f"{d[i]} = table[{first + i}, j] - means[{i}]")

    def entry(a):
        return source.less(f"table[{a}, j] + shift[{a}]", (f"g[{a}][{i}] * {d[i]}" for i in source.range(m)))

    return source.function(source.vector(n, entry))


@cache
def member_mover(n: int, m: int, first: int) -> Callable:
    """Return `move(table, shift, g, means)`, which puts `moved_member` in the place of every member."""
    shapes: dict[str, Any] = {"shift": (n,), "g": (n, m), "means": (m,)}
    source = Source("move", "table, shift, g, means", **shapes)
    if source.loops:
        shift, g, means = (source.array_of(name) for name in shapes)
        source.line(f"d = deviations(table, {first}, {m}, {means}, table.shape[1])")
        source.line(f"add_product(table, -{g}, d)")
        for a in source.rows_of_members(n):
            source.line(f"table[{a}, j] += {shift}[{a}]")
        return source.function(deviations=arrays.deviations, add_product=arrays.add_product)
    moved, store = moved_member(n, m, first), column_writer(n)

    @inlined
    def move(table, shift, g, means):
        for j in range(table.shape[1]):
            store(table, j, moved(table, j, shift, g, means))

    return move


@lru_cache(maxsize=64)
def deterministic_analysis(gain: Callable, observe: Callable, shape: Shape) -> Callable:
    """Return `analyse(memory, z, numbers, size)`: x_j += K innovation - G (y_j - mean(y)), K = cov(x, y) S^-1.

    The mean moves as the Kalman filter's. `gain(cross, s, r, root)` returns G (n, m), which decides on the spread,
    from cov(x, y) (n, m), S = cov(y, y) + R, R (m, m) and the lower triangular root of S.
    """
    n, m = shape.n, shape.m
    compare, solve = measurement_moments(observe, shape), matrices.row_solver(n, m)
    apply, store, moved = matrices.vector_multiplier(n, m), column_writer(n), moved_member(n, m, n)
    at_once, move = is_array(n, m), member_mover(n, m, n)

    @inlined
    def analyse(memory, z, numbers, size):
        means, innovation, cross, s, r, root = compare(memory, z, numbers, size)
        _, table, _ = memory
        shift, g = apply(solve(cross, root), innovation), gain(cross, s, r, root)
        if at_once:
            move(table, shift, g, means)
        else:
            for j in range(table.shape[1]):
                store(table, j, moved(table, j, shift, g, means))

    return analyse


@dataclass(frozen=True, kw_only=True, eq=False)
class DeterministicUpdateFilter(EnsembleFilter):
    """Base of the ensemble filters whose update draws nothing.

    Attributes:
        rotations: 1 for a random rotation of the members about their mean after each update, 0 for none. It keeps
            them from growing outliers where little or no process noise mixes them.
    """

    rotations: int = 0

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        switch("rotations", self.rotations)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        plain = super().kernels()
        return with_rotation(plain) if self.rotations else plain


@cache
def half_gain(n: int, m: int) -> Callable:
    """Return `gain(cross, s, r, root)`: half of K = cross S^-1."""
    solve = matrices.row_solver(n, m)
    half = entrywise("half", "k", (n, m), lambda i, j: f"0.5 * k[{i}][{j}]", k=(n, m))

    @inlined
    def gain(cross, s, r, root):
        return half(solve(cross, root))

    return gain


@cache
def half_gain_analysis(observe: Callable, shape: Shape) -> Callable:
    """The analysis of the deterministic ensemble Kalman filter; see `ensemble_kernels`."""
    return deterministic_analysis(half_gain(shape.n, shape.m), observe, shape)


@dataclass(frozen=True, kw_only=True, eq=False)
class DeterministicEnsembleKalmanFilter(DeterministicUpdateFilter):
    """Deterministic ensemble Kalman filter: the mean moves by the gain, the members' distances by half of it.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  innovation = z - mean(y),  S = cov(y, y) + R,  K = cov(x, y) S^-1,
                 mean += K innovation,  x_j - mean(x) -= K (y_j - mean(y))/2;  sample covariances, divisor N - 1

    With a linear h the update leaves P - K H P + K H P H'K'/4, more than the Kalman filter's P - K H P, by little
    where measurements are poor. The update draws nothing: only the process noise of the members is random, and the
    error of its sample mean and covariance enters the estimate. Attributes are those of
    `DeterministicUpdateFilter`.

    Source: Sakov, Oke (2008), "A deterministic formulation of the ensemble Kalman filter".
    """

    name: ClassVar[str] = "denkf"

    @property
    def analysis(self) -> Callable:
        """The update, as `ensemble_kernels` takes it."""
        return half_gain_analysis
