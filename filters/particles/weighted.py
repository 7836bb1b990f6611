"""What particle filters share: weights and moments of a sample, what it expects, and its size."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, NamedTuple

from filters.engine.belief import Belief
from filters.engine.layout import memory_places, row_access
from filters.ensembles.ensemble import LARGEST_ENSEMBLE
from filters.filter import Filter
from filters.particles.motion import silencer
from filters.particles.weights import normalise, read_weights, weighted_covariances, weighted_means
from thruster_env.numerics import matrices
from thruster_env.numerics.angles import row_aligner
from thruster_env.numerics.checks import at_least, finite, positive
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.tuples import column_reader, column_writer, matrix_reader, vector_reader
from thruster_env.plants.layout import constants_reader, number_places
from thruster_env.plants.shape import Shape, innovation_of


class ParticleParts(NamedTuple):
    """Functions common to all particle filters.

    Rows of the table: n of particles, one of log weights, those of a kind, one of weights, scratch.
    """

    set_equal: Callable  # set_equal(memory, size): the same weight for all
    expect: Callable  # expect(memory, z, numbers, size): sets innovation and S, and the first scratch rows h(x_j)
    normal: Callable  # normal(z, cov): the density N(z; y, cov), of the channels that are there, as a value ...
    distance: Callable  # ... distance(y, normal): whose logarithm at y is level(normal) - distance
    level: Callable
    weigh: Callable  # weigh(memory, size): normalises weights, sets mean, cov, ESS; the log of the weights' sum
    summarise: Callable  # summarise(memory, size): sets mean and cov


@lru_cache(maxsize=64)
def particle_parts(observe: Callable, shape: Shape, weights: int) -> ParticleParts:
    """The parts for a model's observation function and shape; `weights` is the row of weights."""
    n, m = shape.n, shape.m
    places, source = memory_places(n, m), number_places(n, m)
    logarithms, scratch, size_place = n, weights + 1, places.extras
    constants, state, store_predicted = constants_reader(shape), column_reader(n), column_writer(m, scratch)
    means, covariances = weighted_means(0, n, weights), weighted_covariances(0, n, weights)
    means_of_predicted = weighted_means(scratch, m, weights)
    covariances_of_predicted = weighted_covariances(scratch, m, weights)
    _, (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    read_r, mask, add, factor = (
        matrix_reader(m, m, source.r),
        matrices.masked(m),
        matrices.symmetric_sum(m),
        matrices.cholesky_factor(m),
    )
    difference, measured = innovation_of(shape), vector_reader(m)
    half_square, constant = matrices.log_density(m)
    silence = silencer(scratch, shape.measurement_angles, weights)
    of_states = means, covariances
    if any(shape.state_angles):
        of_states = aligned_moments(*of_states, row_aligner(0, shape.state_angles, weights))
    means, covariances = of_states

    @inlined
    def set_equal(memory, size):
        row, table, _ = memory
        for j in range(table.shape[1]):
            table[logarithms, j] = -math.log(size)
        row[size_place] = size

    @inlined
    def summarise(memory, size):
        row, table, _ = memory
        read_weights(table, logarithms, weights, size)
        mean = means(table, size)
        store_mean(row, mean)
        store_cov(row, covariances(table, size, mean))

    @inlined
    def expect(memory, z, numbers, size):
        row, table, _ = memory
        c, present = constants(numbers), measured(z)
        for j in range(table.shape[1]):
            store_predicted(table, j, observe(state(table, j), c))
        read_weights(table, logarithms, weights, size)
        silence(table, z, size)
        mean = means_of_predicted(table, size)
        store_innovation(row, difference(present, mean))
        s = add(covariances_of_predicted(table, size, mean), mask(read_r(numbers), present))
        store_s(row, s)

    @inlined
    def normal(z, cov):
        present = measured(z)
        return present, factor(mask(cov, present))

    @inlined
    def distance(y, normal):
        return half_square(difference(normal[0], y), normal[1], normal[0])

    @inlined
    def level(normal):
        return constant(normal[1], normal[0])

    @inlined
    def weigh(memory, size):
        row, table, _ = memory
        total, row[size_place] = normalise(table, logarithms, weights, size)
        mean = means(table, size)
        store_mean(row, mean)
        store_cov(row, covariances(table, size, mean))
        return total

    return ParticleParts(set_equal, expect, normal, distance, level, weigh, summarise)


def aligned_moments(means: Callable, covariances: Callable, align: Callable) -> tuple[Callable, Callable]:
    """The functions `means` and `covariances` of a table, after its angles were put on one branch."""

    @inlined
    def means_aligned(table, size):
        align(table, size)
        return means(table, size)

    return means_aligned, covariances


@inlined
def anything_measured(z):
    """Whether a channel of z is present."""
    for i in range(z.shape[0]):
        if z[i] == z[i]:
            return True
    return False


@dataclass(frozen=True, kw_only=True, eq=False)
class WeightedFilter(Filter):
    """Base of the particle filters.

    Attributes:
        ensemble_size: number N of particles, from 2 to a million.
        regularisation: factor on the width of the Gaussian kernel that spreads resampled particles; 0 for none, 1
            for the best width for a Gaussian belief. With little or no process noise, nothing else separates the
            copies of a particle.
    """

    gaussian_likelihood: ClassVar[bool] = False
    any_step: ClassVar[bool] = False
    ensemble_size: int = 1000
    regularisation: float = 0.0

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        size = at_least("ensemble_size", self.ensemble_size, 2)
        if size > LARGEST_ENSEMBLE:
            raise ValueError(f"ensemble_size must be at most {LARGEST_ENSEMBLE}, but got {size}")
        object.__setattr__(self, "ensemble_size", size)
        width = positive("regularisation", self.regularisation, zero_allowed=True)
        object.__setattr__(self, "regularisation", width)

    @property
    def own_parameters(self) -> tuple[float, ...]:
        """The factor on the kernel's width."""
        return (self.regularisation,)

    @property
    def size(self) -> int:
        """Number of particles."""
        return self.ensemble_size

    @staticmethod
    def effective_sample_size(belief: Belief) -> float:
        """The effective number of equally weighted particles, from 1 to N."""
        return float(belief.extras[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class ResampledFilter(WeightedFilter):
    """Base of the particle filters that resample when few particles have most of the weight.

    Attributes:
        resampling_threshold: fraction of N; an effective sample size (ESS) below it triggers resampling; from 0
            (never) to 1.
    """

    resampling_threshold: float = 0.5

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        threshold = finite("resampling_threshold", self.resampling_threshold)
        if not 0.0 <= threshold <= 1.0:
            raise ValueError(f"resampling_threshold must be from 0 to 1, but got {threshold}")
        object.__setattr__(self, "resampling_threshold", threshold)

    @property
    def own_parameters(self) -> tuple[float, ...]:
        """The factor on the kernel's width, and the threshold."""
        return *super().own_parameters, self.resampling_threshold
