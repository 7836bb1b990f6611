"""The Rao-Blackwellised particle filter: some states are sampled, a Kalman filter per particle has the others."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, ClassVar

import numpy as np

from filters.baselines.baselines import places_of
from filters.engine.belief import Belief, Kernels
from filters.engine.layout import memory_places, own_place, row_access
from filters.pages.kernels import nothing_to_summarise
from filters.particles.conditional import rows_of, works_of
from filters.particles.motion import drawer
from filters.particles.regularisation import kernel_width
from filters.particles.weighted import ResampledFilter, aligned_moments, anything_measured, particle_parts
from filters.particles.weights import (
    normalise,
    read_weights,
    systematic_resampler,
    weighted_covariances,
    weighted_means,
)
from thruster_env.numerics import matrices
from thruster_env.numerics.angles import row_aligner
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.streams import (
    FILTER_MEASUREMENT,
    FILTER_PRIOR,
    FILTER_PROCESS,
    FILTER_PROPOSAL,
    GROUP,
    fill_normals,
    uniform_block,
)
from thruster_env.numerics.tuples import matrix_reader, zeros_of
from thruster_env.plants.layout import number_places, padded
from thruster_env.plants.shape import Functions, Shape, innovation_of


def mixture_moments(first: int, covs: int, count: int, weights: int, angles: tuple[bool, ...]):
    """`means(table, size)` and `covariances(table, size, mean)` of a mixture of Gaussians, one a column.

    Means and covariances lie in the rows from `first` and `covs` on: sum of w P, and the spread of the means.
    """
    means, between = weighted_means(first, count, weights), weighted_covariances(first, count, weights)
    within, read = weighted_means(covs, count * count, weights), matrix_reader(count, count)
    add = matrices.symmetric_sum(count)

    @inlined
    def covariances(table, size, mean):
        return add(between(table, size, mean), read(within(table, size)))

    if not any(angles):
        return means, covariances
    return aligned_moments(means, covariances, row_aligner(first, angles, weights))


@lru_cache(maxsize=64)
def rao_blackwell_kernels(functions: Functions, shape: Shape, sampled: tuple[int, ...]) -> Kernels:
    """Kernels for a model's functions and shape, and the sampled states; the table's rows: `rows_of`."""
    n, m, count = shape.n, shape.m, len(sampled)
    places, logarithms, first_cov = memory_places(n, m), n, n + 1
    weights, seen, end = rows_of(shape)
    works, rows, scratch = works_of(functions, shape, sampled)
    begin, advance, settle, condition = (works[name] for name in ("start", "advance", "settle", "update"))
    substeps_place, factor_place = number_places(n, m).substeps, own_place(shape)
    threshold_place, size_place, cov_place = factor_place + 1, places.extras, places.cov
    step_place, key_0, key_1 = places.step, places.key_0, places.key_1
    likelihood_place, level = places.log_likelihood, end - 1
    draw, resample = drawer(n, m), systematic_resampler(weights, weights, seen)
    set_equal, width = particle_parts(functions.observe, shape, weights).set_equal, kernel_width(count)
    means, covariances = mixture_moments(0, first_cov, n, weights, shape.state_angles)
    means_of_seen, covariances_of_seen = mixture_moments(seen, seen + m, m, weights, shape.measurement_angles)
    _, (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    difference, nothing = innovation_of(shape), zeros_of(m)
    align = row_aligner(0, shape.state_angles) if any(shape.state_angles) else nothing_to_summarise

    @inlined
    def start(memory, numbers, size):
        row, table, draws = memory
        draw(draws, count * table.shape[1], row, FILTER_PRIOR)
        begin(row, numbers, numbers, table, draws, size)
        align(table, size)
        set_equal(memory, size)

    @inlined
    def spread(memory, numbers, size):
        """Give the sampled states of each particle the kernel's covariance, of which the next step draws."""
        row, table, _ = memory
        factor = (numbers[factor_place] * width(size)) ** 2
        for i in sampled:
            for k in sampled:
                for j in range(table.shape[1]):
                    table[first_cov + i * n + k, j] += factor * row[cov_place + i * n + k]

    @inlined
    def predict(memory, u, numbers, size):
        row, table, draws = memory
        if row[size_place] < numbers[threshold_place] * size:
            read_weights(table, logarithms, weights, size)
            place, _, _, _ = uniform_block(0, row[step_place], FILTER_MEASUREMENT, row[key_0], row[key_1])
            resample(table, size, place)
            spread(memory, numbers, size)
            set_equal(memory, size)
        for _ in range(int(numbers[substeps_place])):
            advance(row, u, numbers, table, draws, size)
        row[step_place] += 1.0
        draw(draws, count * table.shape[1], row, FILTER_PROCESS)
        settle(row, u, numbers, table, draws, size)
        align(table, size)

    @inlined
    def summarise(memory, size):
        row, table, _ = memory
        mean = means(table, size)
        store_mean(row, mean)
        store_cov(row, covariances(table, size, mean))

    @inlined
    def summarise_anew(memory, size):
        read_weights(memory[1], logarithms, weights, size)
        summarise(memory, size)

    @inlined
    def update(memory, z, numbers, size):
        row, table, draws = memory
        read_weights(table, logarithms, weights, size)
        condition(row, z, numbers, table, draws, size)
        v = means_of_seen(table, size)
        store_innovation(row, difference(v, nothing()))
        store_s(row, covariances_of_seen(table, size, v))
        row[likelihood_place] = 0.0
        if anything_measured(z):
            for j in range(table.shape[1]):
                table[logarithms, j] += table[level, j]
            row[likelihood_place], row[size_place] = normalise(table, logarithms, weights, size)
        summarise(memory, size)

    return Kernels(
        *(n, m, max(rows, seen + weights + 2), max(count, 1), start, predict, update, summarise_anew),
        extras=1,
        extra_kept_rows=weights - n,
        scratch=scratch,
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class RaoBlackwellisedParticleFilter(ResampledFilter):
    """Rao-Blackwellised particle filter: some states are sampled, a Kalman filter per particle has the others.

    A particle is a mean x_j of all states and a P_j that is zero in the rows and columns of the sampled ones:

        predict: if ESS < threshold N, resample the particles by weight (systematic), and all w_j = 1/N;
                 regularised: P_j += (c h)^2 cov of the sampled states, h as in `ParticleFilter` for their number
                 x_j = f(x_j, u),  P_j = F_j P_j F_j' + Q,  F_j = df/dx at x_j
                 with the sampled states s first and l the others,  P_j = [A 0; B C] [A 0; B C]':
                 x_s += A e_j,  x_l += B e_j,  e_j ~ N(0, I),  P_j of l = C C'
        update:  each particle by the extended filter, with h and H at x_j;
                 w_j = w_j N(v_j; 0, S_j)/L,  L = sum of w_j N(v_j; 0, S_j)
        belief:  mean = sum of w_j x_j,
                 cov = sum of w_j P_j + sum of w_j (x_j - mean)(x_j - mean)'/(1 - sum of w_j^2)

    The Kalman filters are exact where, with the sampled states given, f and h are affine in the others, whatever
    Q: the joint P_j holds what the step of the sampled states tells of the others. There particles have to cover
    few states, and it takes fewer of them than `pf` does. Elsewhere each particle linearises by itself. If all
    states are sampled, this is `pf`.

    The log-likelihood is log L; innovation and S are those of the mixture before the measurement. `Belief.members`
    is (n + 1 + n^2, N): x_j, log weight, and P_j by rows, of which those on and below the diagonal are used.
    `Belief.extras` holds the ESS.

    Attributes:
        sampled: indices of the sampled states, at least one; -1 is the last.

    The other attributes are those of `ResampledFilter`, c its regularisation.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Schon, Gustafsson, Nordlund (2005), "Marginalized particle filters for mixed linear/nonlinear
    state-space models"; Doucet, de Freitas, Murphy, Russell (2000), "Rao-Blackwellised particle filtering for
    dynamic Bayesian networks".
    """

    name: ClassVar[str] = "rbpf"
    ensemble_size: int = 100
    sampled: Any = (0,)

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        places = places_of("sampled", self.sampled, self.model.n)
        if not places:
            raise ValueError("sampled must be a list of indices, at least one, but got none")
        object.__setattr__(self, "sampled", places)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        model = self.kernel_model
        return rao_blackwell_kernels(model.functions, model.shape, self.sampled)

    def sample(self, belief: Belief) -> np.ndarray:
        """A state (n, N) drawn from each particle's N(x_j, P_j), and the row of log weights."""
        n, size = self.model.n, self.ensemble_size
        values, vectors = np.linalg.eigh(self.particle_covariances(belief))
        draws = np.zeros(padded(n * size, GROUP))
        fill_normals(draws, n * size, belief.step, FILTER_PROPOSAL, *belief.key)
        e = np.sqrt(np.maximum(values, 0.0)) * draws[: n * size].reshape(size, n)
        drawn = belief.members[:n] + np.einsum("jab,jb->aj", vectors, e)
        return np.concatenate([drawn, belief.members[n : n + 1]])

    def particle_covariances(self, belief: Belief) -> np.ndarray:
        """The covariances P_j (N, n, n) of the particles of a belief."""
        n, size = self.model.n, self.ensemble_size
        lower = np.tril(belief.members[n + 1 :].reshape(n, n, size).transpose(2, 0, 1))
        return lower + np.tril(lower, -1).transpose(0, 2, 1)
