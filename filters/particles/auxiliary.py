"""The auxiliary particle filter: particles are chosen by how well their prediction fits the measurement."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places
from filters.particles.motion import add_noise, clear_noise, ensemble_motion
from filters.particles.regularisation import kernel_spreader
from filters.particles.weighted import WeightedFilter, anything_measured, particle_parts
from filters.particles.weights import (
    normalise,
    read_weights,
    systematic_resampler,
    weighted_covariances,
    weighted_means,
    weighted_squares,
)
from thruster_env.numerics import matrices
from thruster_env.numerics.angles import kept
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.streams import FILTER_MEASUREMENT, uniform_block
from thruster_env.numerics.tuples import column_reader, column_writer, matrix_reader, scaled_sum
from thruster_env.plants.layout import constants_reader, number_places
from thruster_env.plants.shape import Functions, Shape


@lru_cache(maxsize=64)
def auxiliary_kernels(functions: Functions, shape: Shape, regularised: bool) -> Kernels:
    """Kernels of the auxiliary particle filter for a model's functions and shape.

    If it is regularised, the parents that it draws are spread, by the first of its own parameters.

    The table's rows: n of particles, one of log weights, n of the noise in the particles, weights, scratch.
    """
    n, m, observe = shape.n, shape.m, functions.observe
    places, source = memory_places(n, m), number_places(n, m)
    logarithms, noise, weights = n, n + 1, 2 * n + 1
    scratch, q_root_place = weights + 1, source.q_root
    step_place, key_0, key_1, likelihood_place = places.step, places.key_0, places.key_1, places.log_likelihood
    motion, parts = ensemble_motion(functions.transition, shape), particle_parts(observe, shape, weights)
    draw_prior, move = motion.start, motion.predict
    set_equal, expect, normal, distance, level, weigh, summarise = parts
    constants, state = constants_reader(shape), column_reader(n)
    predicted, store_effect, effects = (
        column_reader(m, scratch),
        column_writer(m, scratch),
        weighted_squares(scratch, m, weights),
    )
    far = scratch + 2 * m
    foreseen, store_foreseen = column_reader(m, scratch + m), column_writer(m, scratch + m)
    add_scaled, add = kept(scaled_sum(m), "x, a, y", shape.measurement_angles), matrices.symmetric_sum(m)
    read_r, choose = matrix_reader(m, m, source.r), systematic_resampler(n + 1, weights, scratch)
    means, covariances, spread = (
        weighted_means(0, n, weights),
        weighted_covariances(0, n, weights),
        kernel_spreader(shape, places.extras + 1),
    )

    @inlined
    def start(memory, numbers, size):
        draw_prior(memory, numbers, size)
        set_equal(memory, size)
        clear_noise(memory[1], noise, n)

    @inlined
    def predict(memory, u, numbers, size):
        _, table, draws = memory
        move(memory, u, numbers, size)
        clear_noise(table, noise, n)
        add_noise(table, noise, n, draws, numbers, q_root_place)  # of the very draws that moved the particles

    @inlined
    def update(memory, z, numbers, size):
        row, table, _ = memory
        expect(memory, z, numbers, size)
        row[likelihood_place] = 0.0
        if anything_measured(z):
            c = constants(numbers)
            # The particles without their noise, what would be measured of them, and what the noise adds to that.
            for i in range(n):
                for j in range(table.shape[1]):
                    table[i, j] -= table[noise + i, j]
            for j in range(table.shape[1]):
                y = observe(state(table, j), c)
                store_foreseen(table, j, y)
                store_effect(table, j, add_scaled(predicted(table, j), -1.0, y))
            read_weights(table, logarithms, weights, size)
            foresight = normal(z, add(effects(table, size), read_r(numbers)))
            for j in range(table.shape[1]):
                table[far, j] = distance(foreseen(table, j), foresight)
            for j in range(table.shape[1]):
                table[logarithms, j] -= table[far, j]
            first_stage, _ = normalise(table, logarithms, weights, size)
            lost = math.nan if first_stage != first_stage else 0.0  # nothing to choose by
            for j in range(table.shape[1]):
                table[logarithms, j] = table[far, j] + lost
            place, _, _, _ = uniform_block(0, row[step_place], FILTER_MEASUREMENT, row[key_0], row[key_1])
            if regularised:
                cov = covariances(table, size, means(table, size))
                choose(table, size, place)
                spread(memory, cov, numbers, size)
            else:
                choose(table, size, place)
            # The chosen ones with the noise of the place that they went to.
            for i in range(n):
                for j in range(table.shape[1]):
                    table[i, j] += table[noise + i, j]
            sensor = normal(z, read_r(numbers))
            for j in range(table.shape[1]):
                table[logarithms, j] -= distance(observe(state(table, j), c), sensor)
            row[likelihood_place] = first_stage + weigh(memory, size) - math.log(size) + level(sensor)
            clear_noise(table, noise, n)
        else:
            summarise(memory, size)

    rows = scratch + max(2 * m + 1, n + 3)
    root = n * n if regularised else 0
    return Kernels(n, m, rows, n, start, predict, update, summarise, extras=1, extra_kept_rows=1 + n, scratch=root)


@dataclass(frozen=True, kw_only=True, eq=False)
class AuxiliaryParticleFilter(WeightedFilter):
    """Auxiliary particle filter: parents are drawn by how well their noise-free prediction fits z.

        predict: mu_j = f(x_j, u),  x_j = mu_j + noise_j,  noise_j ~ N(0, Q); both are kept
        update:  V = sum of w_j (h(x_j) - h(mu_j))(h(x_j) - h(mu_j))'
                 lambda_j = w_j N(z; h(mu_j), R + V), parents i(j) drawn by lambda (systematic)
                 x_j = mu_i(j) + noise_j,  w_j = N(z; h(x_j), R)/N(z; h(mu_i(j)), R + V), normalised
                 regularised: x_j += c h e_j before it is weighed,  e_j ~ N(0, covariance of mu by lambda)
                 L = (sum of lambda_j) (mean of w_j before normalisation)
        belief:  mean = sum of w_j x_j,  cov = sum of w_j (x_j - mean)(x_j - mean)'/(1 - sum of w_j^2)

    The look-ahead needs the measurement, which is known in the update only. The prediction therefore keeps each
    particle's noise; the update removes it, draws parents by mu, and adds it again: the noise does not depend on
    the draw, as the method requires. Before an update a belief equals the bootstrap filter's. Directly after the
    prior or another update there is no noise, and parents are drawn by exact weights.

    V, the covariance that the noise causes in the measurement, keeps the weights w_j bounded where the noise is
    large: with V = 0, the textbook choice, a few particles that mu had ruled out would take all the weight.

    The log-likelihood is log L; innovation, S and restarts are the bootstrap filter's. `Belief.members` is
    (2 n + 1, N): particles, log weights, noise. `Belief.extras` holds the effective sample size.

    Attributes are those of `WeightedFilter`, c its regularisation and h as in `ParticleFilter`.

    Source: Pitt, Shephard (1999), "Filtering via simulation: auxiliary particle filters", section 3, where the
    first stage's density is free; the likelihood: Pitt (2002), "Smooth particle filters for likelihood evaluation
    and maximisation".
    """

    name: ClassVar[str] = "apf"

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        model = self.kernel_model
        return auxiliary_kernels(model.functions, model.shape, self.regularisation > 0.0)
