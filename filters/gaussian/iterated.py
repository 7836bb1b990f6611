"""The iterated extended Kalman filter: the measurement is linearised again where the update ends."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache, partial
from typing import ClassVar

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, row_access
from filters.filter import Filter
from filters.gaussian.extended import extended_kernels, gaussian_update, kernels_of
from numerics.checks import at_least
from numerics.compiled import inlined
from numerics.sources import Source, is_array, written_out
from numerics.tuples import matrix_reader, vector_reader
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape, observation_slopes

MOST_ITERATIONS = 20


@lru_cache(maxsize=64)
def iterated_kernels(iterations, functions: Functions, shape: Shape) -> Kernels:
    """Kernels of the iterated extended Kalman filter for a model's functions and shape."""
    n, m, observe = shape.n, shape.m, functions.observe
    places, source = memory_places(n, m), number_places(n, m)
    (read_mean, read_cov), (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    constants, measured, read_r = constants_reader(shape), vector_reader(m), matrix_reader(m, m, source.r)
    read_scales, likelihood_place = vector_reader(n, source.scales), places.log_likelihood
    observation_matrix, condition = observation_slopes(functions, shape), gaussian_update(shape)
    tangent = Source("on_tangent", "y, h, x, mean", result=(m,), y=(m,), h=(m, n), x=(n,), mean=(n,))

    def on_tangent_at(i):
        rise = (f"h[{i}][{j}] * (mean[{j}] - x[{j}])" for j in tangent.range(n))
        return tangent.less(f"y[{i}]", rise, "+")

    on_tangent = tangent.function(tangent.vector(m, on_tangent_at))
    once_more = (
        "h = observation_matrix(x, scales, c)",
        "x, reduced, _, _, _ = condition(mean, p, z, on_tangent(observe(x, c), h, x, mean), h, r)",
    )
    if is_array(n, n):
        again = f"for _ in range({iterations - 1}):", *(f"    {line}" for line in once_more)
    else:
        again = once_more * (iterations - 1)  # a loop would keep batches from being vector code
    refine = written_out(
        "refine",
        "x, reduced, mean, p, z, r, scales, c",
        *again,
        "(x, reduced)",
        observation_matrix=observation_matrix,
        condition=condition,
        on_tangent=on_tangent,
        observe=observe,
    )

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        mean, p, z, r = read_mean(row), read_cov(row), measured(z), read_r(numbers)
        c, scales = constants(numbers), read_scales(numbers)
        h = observation_matrix(mean, scales, c)
        x, reduced, innovation, s, log_likelihood = condition(mean, p, z, observe(mean, c), h, r)
        x, reduced = refine(x, reduced, mean, p, z, r, scales, c)
        store_mean(row, x)
        store_cov(row, reduced)
        store_innovation(row, innovation)
        store_s(row, s)
        row[likelihood_place] = log_likelihood

    return extended_kernels(functions, shape)._replace(update=update)


@dataclass(frozen=True, kw_only=True, eq=False)
class IteratedExtendedKalmanFilter(Filter):
    """Iterated extended Kalman filter: its update is Gauss and Newton's method for the most probable state.

        predict: that of the extended filter
        update:  x_0 = mean,  then for i = 0, 1, ... with H = dh/dx at x_i and K = P H' (H P H' + R)^-1
                 x_{i+1} = mean + K (z - h(x_i) - H (mean - x_i)),
                 at last mean = x_i,  P = (I - K H) P (I - K H)' + K R K'  (Joseph) with the last H and K

    The first iteration is the extended filter's update. Innovation, its covariance and the likelihood are those of
    the first, so that they assess the prediction. The number of iterations is fixed, without a line search: full
    steps may overshoot where h is strongly nonlinear within the spread of the belief.

    Attributes:
        iterations: how often the measurement is linearised, 1 to 20; 1 is the extended filter.

    Raises:
        ValueError: if iterations is not a whole number from 1 to 20.

    Source: Bell, Cathey (1993), "The iterated Kalman filter update as a Gauss-Newton method", IEEE Trans.
    Automatic Control 38(2).
    """

    name: ClassVar[str] = "iekf"
    iterations: int = 5

    def __post_init__(self):
        """Check the number of iterations."""
        iterations = at_least("iterations", self.iterations, 1, MOST_ITERATIONS)
        object.__setattr__(self, "iterations", iterations)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return kernels_of(self.kernel_model, partial(iterated_kernels, self.iterations))
