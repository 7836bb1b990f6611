"""A robust extended Kalman filter: Student-t measurement noise, so that outliers have little weight."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from filters.adaptive.noise_moments import measurement_noise_moment, mixer, trace_of
from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place, row_access
from filters.filter import Filter
from filters.gaussian.extended import extended_kernels, gaussian_update, kernels_of
from numerics import matrices
from numerics.checks import at_least, positive
from numerics.compiled import inlined
from numerics.sources import Source
from numerics.tuples import matrix_reader, vector_reader
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape, observation_slopes

MOST_ITERATIONS = 1000


@lru_cache(maxsize=64)
def robust_kernels(functions: Functions, shape: Shape) -> Kernels:
    """Kernels for a model's functions and shape; extras: the last weight."""
    n, m, observe = shape.n, shape.m, functions.observe
    places, source, own = memory_places(n, m), number_places(n, m), own_place(shape)
    iterations_place, weight_place, likelihood_place = own + 1, places.extras, places.log_likelihood
    read_r, factor, solve = matrix_reader(m, m, source.r), matrices.cholesky_factor(m), matrices.row_solver(m, m)
    (read_mean, read_cov), (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    measured, read_scales = vector_reader(m), vector_reader(n, source.scales)
    constants, observation_matrix = constants_reader(shape), observation_slopes(functions, shape)
    plain = extended_kernels(functions, shape)
    begin, predict, nothing_to_summarise = plain.start, plain.predict, plain.summarise
    condition, expect, mix, mask = (
        gaussian_update(shape),
        measurement_noise_moment(shape),
        mixer(m),
        matrices.masked(m),
    )
    of_present, trace, counting = matrices.present_part(m), trace_of(m), Source("count", "z", z=(m,))
    ones = (f"(1.0 if z[{i}] == z[{i}] else 0.0)" for i in counting.range(m))
    count = counting.function(counting.sum(ones))

    @inlined
    def start(memory, numbers, size):
        begin(memory, numbers, size)
        memory[0][weight_place] = 1.0

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        mean, p, r, freedom = read_mean(row), read_cov(row), read_r(numbers), numbers[own]
        c, present = constants(numbers), measured(z)
        predicted, h = observe(mean, c), observation_matrix(mean, read_scales(numbers), c)
        _, _, innovation, s, row[likelihood_place] = condition(mean, p, present, predicted, h, r)
        store_innovation(row, innovation)
        store_s(row, s)
        channels, root, weight = count(present), factor(mask(r, present)), 1.0
        if channels > 0.0:
            for _ in range(int(numbers[iterations_place])):
                moment = expect(p, present, predicted, h, mix(1.0 / weight, r, 0.0, r))
                weight = (freedom + channels) / (freedom + trace(solve(of_present(moment, present), root)))
        row[weight_place] = weight
        mean, p, _, _, _ = condition(mean, p, present, predicted, h, mix(1.0 / weight, r, 0.0, r))
        store_mean(row, mean)
        store_cov(row, p)

    return Kernels(n, m, n, 0, start, predict, update, nothing_to_summarise, extras=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class RobustExtendedKalmanFilter(Filter):
    """Extended Kalman filter for Student-t measurement noise: outliers have little weight.

        predict: the extended filter's
        update:  from weight = 1 repeat  weight = (d + m)/(d + trace(R^-1 E[v v' | z])), each moment with R/weight
                 in place of R; then the extended filter's update, too, with R/weight in place of R

    The noise v has d degrees of freedom and scale matrix R: it is N(0, R/weight) for a weight that is gamma
    distributed about 1. The repetition is the fixed-point iteration of the variational approximation in which
    state and weight are independent; m counts the measured channels, which share one weight. Innovation, S and
    log-likelihood are those under R itself, so that outliers show in the NIS (normalised innovation squared).

    `Belief.extras` holds the last weight, near 0 for an outlier; 1 where nothing was measured.

    Attributes:
        degrees_of_freedom: d, positive; as it grows the filter becomes the extended one.
        iterations: of the fixed point, at least 1.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Agamennoni, Nieto, Nebot (2012), "Approximate inference in state-space models with heavy-tailed noise",
    IEEE Trans. Signal Processing 60(10), section III; Piche, Sarkka, Hartikainen (2012), "Recursive outlier-robust
    filtering and smoothing for nonlinear systems using the multivariate Student-t distribution".
    """

    name: ClassVar[str] = "ekf-robust"
    degrees_of_freedom: float = 4.0
    iterations: int = 5

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        object.__setattr__(self, "degrees_of_freedom", positive("degrees_of_freedom", self.degrees_of_freedom))
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))

    @property
    def own_numbers(self) -> tuple[float, ...]:
        """The degrees of freedom and the iterations."""
        return self.degrees_of_freedom, float(self.iterations)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return kernels_of(self.kernel_model, robust_kernels)
