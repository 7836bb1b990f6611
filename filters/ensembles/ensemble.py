"""Ensemble filters: what all kinds share, and the stochastic ensemble Kalman filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import ClassVar

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, row_access
from filters.ensembles.inflation import with_spread_control
from filters.ensembles.members import add_noise, centre, drawer, ensemble_motion, row_covariances, row_means
from filters.filter import Filter
from numerics import arrays, matrices
from numerics.angles import at_angle, row_aligner
from numerics.checks import at_least, positive, shown, switch
from numerics.compiled import inlined
from numerics.sources import Source, entrywise
from numerics.streams import FILTER_MEASUREMENT
from numerics.tuples import (
    column_reader,
    column_writer,
    matrix_reader,
    part_of,
    vector_reader,
)
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape, innovation_of

LARGEST_ENSEMBLE = 1_000_000


@lru_cache(maxsize=64)
def measurement_moments(observe: Callable, shape: Shape) -> Callable:
    """Return `compare(memory, z, numbers, size)`: what the members expect to be measured, against z.

    It puts y_j = h(x_j) into rows n ... of the table, innovation, S and log-likelihood into the row, and returns
    mean(y) (m,), innovation = z - mean(y) (m,), cov(x, y) (n, m), S = cov(y, y) + R, R (m, m) and the lower
    triangular root of S. In a channel that is NaN in z, y_j is 0, and R has no correlations.
    """
    n, m = shape.n, shape.m
    places, source = memory_places(n, m), number_places(n, m)
    likelihood_place = places.log_likelihood
    constants, state, store = constants_reader(shape), column_reader(n), column_writer(m, n)
    means_of_all, covariances_with_predicted = row_means(n + m), row_covariances(0, n + m, n, m)
    expected_of = entrywise("expected_of", "c", (m,), lambda i: f"c[{n + i}]", c=(n + m,))
    of_states, of_predicted = part_of(n, m, (n + m, m)), part_of(m, m, (n + m, m), n)
    read_r, mask, add = matrix_reader(m, m, source.r), matrices.masked(m), matrices.symmetric_sum(m)
    _, _, (store_innovation, store_s) = row_access(shape)
    factor, likelihood = matrices.cholesky_factor(m), matrices.innovation_likelihood(m)
    difference, measured = innovation_of(shape), vector_reader(m)

    silence = silencer(n, shape.measurement_angles)

    @inlined
    def compare(memory, z, numbers, size):
        row, table, _ = memory
        c = constants(numbers)
        for j in range(table.shape[1]):
            store(table, j, observe(state(table, j), c))
        silence(table, z, size)
        means = means_of_all(table, size)
        covariances = covariances_with_predicted(table, size, means)
        present, expected = measured(z), expected_of(means)
        r = mask(read_r(numbers), present)
        s = add(of_predicted(covariances), r)
        root = factor(s)
        innovation = difference(present, expected)
        store_innovation(row, innovation)
        store_s(row, s)
        row[likelihood_place] = likelihood(innovation, root, present)
        return expected, innovation, of_states(covariances), s, r, root

    return compare


@cache
def silencer(first: int, angles: tuple[bool, ...], weights: int | None = None) -> Callable:
    """Return `silence(table, z, size)`, for rows first, first + 1, ... of what the members expect to be measured.

    They become 0 where z is NaN: a constant has no covariance with anything. Angles are put on one branch.
    """

    @inlined
    def silence(table, z, size):
        for i in range(z.shape[0]):
            if z[i] != z[i]:
                for j in range(table.shape[1]):
                    table[first + i, j] = 0.0

    if not any(angles):
        return silence
    align = row_aligner(first, angles, weights)

    @inlined
    def silence_and_align(table, z, size):
        silence(table, z, size)
        align(table, size)

    return silence_and_align


@lru_cache(maxsize=64)
def ensemble_kernels(analysis: Callable, functions: Functions, shape: Shape) -> Kernels:
    """Kernels of an ensemble filter for a model's functions and shape.

    Args:
        analysis: analysis(observe, shape) returns `analyse(memory, z, numbers, size)`, which moves the members
            and sets the innovation, its covariance and its likelihood.
        functions: of the model.
        shape: of the model.

    The table's rows: n of members, m of predicted measurements, m of scratch.
    """
    n, m, observe = shape.n, shape.m, functions.observe
    motion, analyse = ensemble_motion(functions.transition, shape), analysis(observe, shape)
    summarise = motion.summarise

    @inlined
    def update(memory, z, numbers, size):
        analyse(memory, z, numbers, size)
        summarise(memory, size)

    return Kernels(n, m, n + 2 * m, max(n, m), motion.start, motion.predict, update, summarise)


@dataclass(frozen=True, kw_only=True, eq=False)
class EnsembleFilter(Filter):
    """Base of the ensemble filters: subclasses define `analysis`, as `ensemble_kernels` takes it.

    The belief's mean and covariance are those of the members.

    Attributes:
        ensemble_size: number N of members, at least 2.
        inflation: factor on the spread of the members about their mean in every step of the model's dt, after the
            process noise; 1 is none. For steps of another length dt' it is inflation^(dt'/dt).
        relaxation: fraction, 0 to 1, of each state's loss of spread in an update that is given back.

    Sources: Anderson, Anderson (1999), "A Monte Carlo implementation of the nonlinear filtering problem to produce
    ensemble assimilations and forecasts", for inflation; Whitaker, Hamill (2012), "Evaluating methods to account
    for system errors in ensemble data assimilation", for relaxation to the prior spread.
    """

    ensemble_size: int = 100
    inflation: float = 1.0
    relaxation: float = 0.0

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        size = at_least("ensemble_size", self.ensemble_size, 2)
        if size > LARGEST_ENSEMBLE:
            raise ValueError(f"ensemble_size must be at most {LARGEST_ENSEMBLE}, but got {size}")
        relaxation = positive("relaxation", self.relaxation, zero_allowed=True)
        if relaxation > 1.0:
            raise ValueError(f"relaxation must be at most 1, but got {shown(self.relaxation)}")
        object.__setattr__(self, "ensemble_size", size)
        object.__setattr__(self, "inflation", positive("inflation", self.inflation))
        object.__setattr__(self, "relaxation", relaxation)

    @property
    def analysis(self) -> Callable:
        """The update, as `ensemble_kernels` takes it."""
        raise NotImplementedError

    @property
    def size(self) -> int:
        """Number of ensemble members."""
        return self.ensemble_size

    @property
    def own_numbers(self) -> tuple[float, ...]:
        """Inflation and relaxation."""
        return self.inflation, self.relaxation

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        model = self.kernel_model
        plain = ensemble_kernels(self.analysis, model.functions, model.shape)
        # Compiled in only where it does something: in the loop over steps even an idle branch takes a tenth.
        neutral = self.inflation == 1.0 and self.relaxation == 0.0
        return plain if neutral else with_spread_control(plain, model.shape)


@cache
def nudger(n: int, m: int) -> Callable:
    """Return `nudge(table, k, z)`: x_j += K (z - y_j), x in the first n rows of the table and y behind them."""
    source = Source("nudge", "table, k, z", k=(n, m), z=(m,))
    if source.loops:
        source.line(f"d = -deviations(table, {n}, {m}, {source.array_of('z')}, table.shape[1])")
        source.line(f"add_product(table, {source.array_of('k')}, d)")
        return source.function(deviations=arrays.deviations, add_product=arrays.add_product)
    for _ in source.inside("for j in range(table.shape[1]):"):
        for i in range(m):
            source.line(f"d{i} = z[{i}] - table[{n + i}, j]")
        for a in range(n):
            source.line(f"table[{a}, j] += {source.sum(f'k[{a}][{i}] * d{i}' for i in range(m))}")
    return source.function()


@cache
def filler(angles: tuple[bool, ...]) -> Callable:
    """Return `fill(z, y, v)`: z for the members to be drawn to, zero in channels that are NaN in z.

    Angles are z = y + v, on the branch of what the members expect, y with the innovation v.
    """
    vector = (len(angles),)

    def entry(i):
        return f"{at_angle(i, angles, f'y[{i}] + v[{i}]', f'z[{i}]')} if z[{i}] == z[{i}] else 0.0"

    return entrywise("fill", "z, y, v", vector, entry, z=vector, y=vector, v=vector)


@lru_cache(maxsize=64)
def perturbed_analysis(observe: Callable, shape: Shape, centred: bool = False) -> Callable:
    """Return `analyse(memory, z, numbers, size)` of the stochastic ensemble Kalman filter."""
    n, m = shape.n, shape.m
    r_root_place = number_places(n, m).r_root
    compare, draw, solve = measurement_moments(observe, shape), drawer(n, m), matrices.row_solver(n, m)
    filled, nudge = filler(shape.measurement_angles), nudger(n, m)

    @inlined
    def analyse(memory, z, numbers, size):
        row, table, draws = memory
        expected, innovation, cross, _, _, root = compare(memory, z, numbers, size)
        draw(draws, m * table.shape[1], row, FILTER_MEASUREMENT)
        if centred:
            centre(draws, m, table.shape[1], size)
        add_noise(table, n, m, draws, numbers, r_root_place)
        nudge(table, solve(cross, root), filled(z, expected, innovation))

    return analyse


@cache
def centred_analysis(observe: Callable, shape: Shape) -> Callable:
    """The same with perturbations whose sample mean is zero."""
    return perturbed_analysis(observe, shape, True)


@dataclass(frozen=True, kw_only=True, eq=False)
class EnsembleKalmanFilter(EnsembleFilter):
    """Stochastic ensemble Kalman filter, on the full nonlinear model, with perturbed measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  innovation = z - mean(y),  S = cov(y, y) + R,  K = cov(x, y) S^-1,
                 x_j += K (z - v_j - y_j),  v_j ~ N(0, R);  sample covariances with divisor N - 1

    The perturbations of an update depend on the key and the step only: two updates within one step use the same
    perturbations.

    Attributes:
        centred_perturbations: 1 for perturbations of the measurements whose sample mean is zero, 0 for independent
            ones. Centred, v_j is (N/(N - 1))^1/2 (v_j - mean(v)), whose covariance is R, and the mean moves as
            in the Kalman filter; the mean of independent ones, of covariance R/N, enters the estimate. Use it for
            small N.

    The other attributes are those of `EnsembleFilter`.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Evensen (1994); Burgers, van Leeuwen, Evensen (1998), "Analysis scheme in the EnKF"; centred: Evensen
    (2004), "Sampling strategies and square root analysis schemes for the EnKF".
    """

    name: ClassVar[str] = "enkf"
    centred_perturbations: int = 0

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        switch("centred_perturbations", self.centred_perturbations)

    @property
    def analysis(self) -> Callable:
        """The update, as `ensemble_kernels` takes it."""
        return centred_analysis if self.centred_perturbations else perturbed_analysis
