"""The bootstrap particle filter: a weighted sample of states, whose distribution may have any shape."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place
from filters.particles.motion import ensemble_motion
from filters.particles.regularisation import kernel_spreader
from filters.particles.weighted import ResampledFilter, anything_measured, particle_parts
from filters.particles.weights import read_weights, systematic_resampler
from thruster_env.numerics.compiled import inlined
from thruster_env.numerics.streams import FILTER_MEASUREMENT, uniform_block
from thruster_env.numerics.tuples import column_reader, matrix_reader
from thruster_env.plants.layout import number_places
from thruster_env.plants.shape import Functions, Shape


@lru_cache(maxsize=64)
def particle_kernels(functions: Functions, shape: Shape, regularised: bool) -> Kernels:
    """Kernels of the bootstrap particle filter for a model's functions and shape.

    If it is regularised, resampled particles are spread, by the first of its own parameters.
    """
    n, m, observe = shape.n, shape.m, functions.observe
    places, weights = memory_places(n, m), n + 1
    scratch, logarithms = weights + 1, n
    size_place, step_place, key_0, key_1 = places.extras, places.step, places.key_0, places.key_1
    likelihood_place, threshold_place = places.log_likelihood, own_place(shape) + 1
    motion, parts = ensemble_motion(functions.transition, shape), particle_parts(observe, shape, weights)
    draw_prior, move = motion.start, motion.predict
    set_equal, expect, normal, distance, level, weigh, summarise = parts
    resample = systematic_resampler(n, weights, scratch)
    read_r, predicted = matrix_reader(m, m, number_places(n, m).r), column_reader(m, scratch)
    read_cov, spread = matrix_reader(n, n, places.cov), kernel_spreader(shape)

    @inlined
    def start(memory, numbers, size):
        draw_prior(memory, numbers, size)
        set_equal(memory, size)

    @inlined
    def predict(memory, u, numbers, size):
        row, table, _ = memory
        if row[size_place] < numbers[threshold_place] * size:
            read_weights(table, logarithms, weights, size)
            place, _, _, _ = uniform_block(0, row[step_place], FILTER_MEASUREMENT, row[key_0], row[key_1])
            resample(table, size, place)
            if regularised:
                spread(memory, read_cov(row), numbers, size)  # no particle moved since that was their covariance
            set_equal(memory, size)
        move(memory, u, numbers, size)

    @inlined
    def update(memory, z, numbers, size):
        row, table, _ = memory
        expect(memory, z, numbers, size)
        row[likelihood_place] = 0.0
        if anything_measured(z):
            sensor = normal(z, read_r(numbers))
            for j in range(table.shape[1]):
                table[logarithms, j] -= distance(predicted(table, j), sensor)
            row[likelihood_place] = weigh(memory, size) + level(sensor)
        else:
            summarise(memory, size)

    rows = scratch + max(m, n + 2)
    root = n * n if regularised else 0
    return Kernels(n, m, rows, n, start, predict, update, summarise, extras=1, extra_kept_rows=1, scratch=root)


@dataclass(frozen=True, kw_only=True, eq=False)
class ParticleFilter(ResampledFilter):
    """Bootstrap particle filter: importance sampling from the prediction, with systematic resampling.

        predict: if ESS < threshold N, resample the particles by weight (systematic), and all w_j = 1/N;
                 regularised: x_j += c h e_j,  e_j ~ N(0, cov),  h = (4/(n + 2))^(1/(n + 4)) N^(-1/(n + 4));
                 x_j = f(x_j, u) + noise_j,  noise_j ~ N(0, Q)
        update:  w_j = w_j p(z | x_j)/L,  L = sum of w_j p(z | x_j),  p(z | x) = N(z; h(x), R)
                 ESS = 1/(sum of w_j^2)
        belief:  mean = sum of w_j x_j,  cov = sum of w_j (x_j - mean)(x_j - mean)'/(1 - sum of w_j^2)

    The log-likelihood is log L. The innovation is z less the weighted mean of h(x_j), and its covariance S the
    weighted covariance of h(x_j) plus R. Resampling waits for the next prediction, so that a belief has the
    moments of the weighted particles, without the noise of a draw. Where two or three particles have all the
    weight, the covariance is nearly singular and the NEES (normalised estimation error squared) far too large: a
    sign of too few particles. If no particle has any weight, because the measurement is impossible under the
    model, the belief restarts from the prior, which `divergences` counts.

    `Belief.members` is (n + 1, N), its last row the log weights; `Belief.extras` holds the ESS.

    Attributes are those of `ResampledFilter`, c its regularisation.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Gordon, Salmond, Smith (1993), "Novel approach to nonlinear/non-Gaussian Bayesian state estimation";
    Kitagawa (1996) for the resampling; Kong, Liu, Wong (1994) for the ESS; Musso, Oudjane, Le Gland (2001),
    "Improving regularised particle filters", for the regularisation, without their rescaling.
    """

    name: ClassVar[str] = "pf"

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        model = self.kernel_model
        return particle_kernels(model.functions, model.shape, self.regularisation > 0.0)
