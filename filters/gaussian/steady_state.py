"""The steady-state Kalman filter: one gain for all steps, from Riccati's equation."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import ClassVar

import numpy as np

from filters.bounds import riccati_covariances
from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, own_place, row_access
from filters.gaussian.extended import extended_kernels, gaussian_innovation, joseph_form, kernels_of
from filters.gaussian.kalman import AffineFilter
from filters.gaussian.sigma_points import silenced_columns
from numerics import matrices
from numerics.compiled import inlined
from numerics.tuples import matrix_reader, scaled_sum, vector_reader
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape

STABLE = 1.0 - 1e-7  # magnitude of an eigenvalue of A (I - K C): an error lasts for less than ten million steps


@lru_cache(maxsize=64)
def steady_kernels(functions: Functions, shape: Shape) -> Kernels:
    """Kernels for an affine model's functions and shape; the filter's own numbers are the gain (n, m)."""
    n, m, observe, observe_jacobian = shape.n, shape.m, functions.observe, functions.observe_jacobian
    assert observe_jacobian is not None  # of an affine model it is known
    places, source = memory_places(n, m), number_places(n, m)
    (read_mean, read_cov), (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    constants, measured, read_r = constants_reader(shape), vector_reader(m), matrix_reader(m, m, source.r)
    read_gain, likelihood_place = matrix_reader(n, m, own_place(shape)), places.log_likelihood
    gain_of_present = silenced_columns(n, m)
    compare, reduce, likelihood = gaussian_innovation(shape), joseph_form(n, m), matrices.innovation_likelihood(m)
    apply, moved = matrices.vector_multiplier(n, m), scaled_sum(n)

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        mean, p, c, z = read_mean(row), read_cov(row), constants(numbers), measured(z)
        innovation, s, s_root, _, h, r = compare(
            p, z, observe(mean, c), observe_jacobian(mean, c), read_r(numbers)
        )
        k = gain_of_present(read_gain(numbers), z)
        store_mean(row, moved(mean, 1.0, apply(k, innovation)))
        store_cov(row, reduce(p, k, h, r))
        store_innovation(row, innovation)
        store_s(row, s)
        row[likelihood_place] = likelihood(innovation, s_root, z)

    return extended_kernels(functions, shape)._replace(update=update)


@dataclass(frozen=True, kw_only=True, eq=False)
class SteadyStateKalmanFilter(AffineFilter):
    """Kalman filter with a constant gain: the limit of the Kalman gain.

        K = P C' (C P C' + R)^-1,  P = A P A' - K C P A' + Q  (Riccati's equation for the predicted covariance)
        predict: mean = A mean + B u + a
        update:  mean += K (z - C mean - d), in missing channels without their columns of K

    Like "kf" it runs on an affine model, or on the affine approximation of a model about its operating point. It
    equals "kf" where that starts from the solution P as its prior covariance.

    The covariance of a belief is that of the errors which this gain leaves: from the prior on A P A' + Q and
    (I - K C) P (I - K C)' + K R K' (Joseph's form), which holds for any gain. It tends to the solution of
    Riccati's equation, stays consistent where measurements are missing, and has no influence on the estimate. The
    gain belongs to one Q and R: a Q or R of a single step is refused.

    Attributes:
        gain: K, (n, m).

    Raises:
        ValueError: if a nonlinear model has no operating point, or Riccati's equation has no stabilising solution:
            unstable and marginally stable modes must be observable, and marginally stable ones driven by Q.

    Source: Anderson, Moore (1979), Optimal Filtering, section 4.4.
    """

    name: ClassVar[str] = "kf-steady"
    varying_noise: ClassVar[bool] = False

    def __post_init__(self):
        """Check the model, and solve for the gain."""
        super().__post_init__()
        a, _, _, c, _ = self.kernel_model.matrices()
        try:
            fastest = np.abs(np.linalg.eigvals(a - a @ self.gain @ c)).max()
        except (np.linalg.LinAlgError, ValueError):  # no solution, or one that is not finite
            fastest = np.inf
        if not fastest < STABLE:
            raise ValueError(
                "a steady-state filter must have a model for which Riccati's equation has a stabilising solution, "
                f"but got A = {a.tolist()}"
            )

    @cached_property
    def gain(self) -> np.ndarray:
        """The gain K (n, m)."""
        model = self.kernel_model
        predicted, _ = riccati_covariances(model)
        c = model.matrices()[3]
        return np.linalg.solve(c @ predicted @ c.T + model.measurement_noise_cov, c @ predicted).T

    @property
    def own_numbers(self) -> tuple[float, ...]:
        """The gain, by rows."""
        return tuple(self.gain.ravel())

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return kernels_of(self.kernel_model, steady_kernels)
