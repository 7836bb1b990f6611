"""The variational Bayesian filter: an extended Kalman filter with an inverse Wishart belief of R."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from filters.adaptive.noise_moments import measurement_noise_moment, mixer
from filters.adaptive.sage_husa import part_that_is_kept
from filters.engine.belief import Belief, Kernels
from filters.engine.layout import memory_places, own_place, row_access
from filters.filter import Filter
from filters.gaussian.extended import extended_kernels, gaussian_update, kernels_of, nothing_to_summarise
from filters.particles.weighted import anything_measured
from numerics.checks import at_least, positive
from numerics.compiled import inlined
from numerics.tuples import matrix_reader, matrix_writer, vector_reader
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape, observation_slopes

MOST_ITERATIONS = 1000


@lru_cache(maxsize=64)
def variational_kernels(functions: Functions, shape: Shape) -> Kernels:
    """Kernels for a model's functions and shape; extras as the class says."""
    n, m, observe = shape.n, shape.m, functions.observe
    places, source, own = memory_places(n, m), number_places(n, m), own_place(shape)
    scale_place, weight_place, likelihood_place = places.extras, places.extras + m * m, places.log_likelihood
    kept_place, prior_place, iterations_place = own, own + 1, own + 2
    prior_r, read_scale, store_scale = (
        matrix_reader(m, m, source.r),
        matrix_reader(m, m, scale_place),
        matrix_writer(m, m, scale_place),
    )
    (read_mean, read_cov), (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    measured, read_scales = vector_reader(m), vector_reader(n, source.scales)
    constants, observation_matrix = constants_reader(shape), observation_slopes(functions, shape)
    plain = extended_kernels(functions, shape)
    begin, predict = plain.start, plain.predict
    condition, expect, mix = gaussian_update(shape), measurement_noise_moment(shape), mixer(m)

    @inlined
    def start(memory, numbers, size):
        row, _, _ = memory
        begin(memory, numbers, size)
        r = prior_r(numbers)
        store_scale(row, mix(numbers[prior_place], r, 0.0, r))
        row[weight_place] = numbers[prior_place]

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        mean, p, scale, weight = read_mean(row), read_cov(row), read_scale(row), row[weight_place]
        c, present = constants(numbers), measured(z)
        predicted, h = observe(mean, c), observation_matrix(mean, read_scales(numbers), c)
        r = mix(1.0 / weight, scale, 0.0, scale)
        _, _, innovation, s, row[likelihood_place] = condition(mean, p, present, predicted, h, r)
        store_innovation(row, innovation)
        store_s(row, s)
        if anything_measured(z):
            kept = numbers[kept_place]
            weight = kept * weight + 1.0
            for _ in range(int(numbers[iterations_place])):
                r = mix(kept / weight, scale, 1.0 / weight, expect(p, present, predicted, h, r))
            store_scale(row, mix(weight, r, 0.0, r))
            row[weight_place] = weight
            mean, p, _, _, _ = condition(mean, p, present, predicted, h, r)
            store_mean(row, mean)
            store_cov(row, p)

    return Kernels(n, m, n, 0, start, predict, update, nothing_to_summarise, extras=m * m + 1)


@dataclass(frozen=True, kw_only=True, eq=False)
class VariationalBayesFilter(Filter):
    """Extended Kalman filter with an inverse Wishart distribution of R beside mean and P.

        predict: the extended filter's
        update:  repeat R = (rho V + E[v v' | z])/(rho nu + 1), each moment under the R before, then
                 V = rho V + E[v v' | z],  nu = rho nu + 1, and mean and P as in the extended filter with this R

    V (m, m) and nu make the distribution of R; the estimate of R is 1/E[1/R] = V/nu. For one channel this is the
    inverse gamma distribution with alpha = nu/2, beta = V/2. The repetition is the fixed-point iteration of the
    variational approximation in which state and R are independent. Innovation, S and log-likelihood are those
    under the R that was estimated before the measurement. In a missing channel E[v v' | z] follows from the others
    by their correlation in R.

    `Belief.extras` holds V (m m numbers), then nu.

    Attributes:
        forgetting_factor: rho, above 0 and at most 1; R is that of the last 1/(1 - rho) measurements or so.
        prior_weight: initial nu: the model's R counts as much as this many measurements; with rho = 1,
            as it grows, the filter becomes the extended one.
        iterations: of the fixed point, at least 1.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Sarkka, Nummenmaa (2009), "Recursive noise adaptive Kalman filtering by variational Bayesian
    approximations", IEEE Trans. Automatic Control 54(3); with inverse Wishart Sarkka, Hartikainen (2013),
    "Non-linear noise adaptive Kalman filtering via variational Bayes".
    """

    name: ClassVar[str] = "vb"
    varying_noise: ClassVar[bool] = False
    forgetting_factor: float = 0.99
    prior_weight: float = 10.0
    iterations: int = 3

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        factor = part_that_is_kept("forgetting_factor", self.forgetting_factor)
        object.__setattr__(self, "forgetting_factor", factor)
        object.__setattr__(self, "prior_weight", positive("prior_weight", self.prior_weight))
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))

    @property
    def own_numbers(self) -> tuple[float, ...]:
        """rho, the prior weight and the iterations."""
        return self.forgetting_factor, self.prior_weight, float(self.iterations)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return kernels_of(self.kernel_model, variational_kernels)

    def estimated_noise(self, belief: Belief) -> np.ndarray:
        """The estimate V/nu of R (m, m) in a belief."""
        m = self.model.m
        return belief.extras[: m * m].reshape(m, m) / belief.extras[m * m]
