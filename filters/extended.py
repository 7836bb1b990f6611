"""The extended Kalman filter: the Kalman filter of the model linearised along its own estimate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from filters import matrices
from filters.belief import Kernels
from filters.derivatives import jacobian
from filters.filter import Filter
from filters.model import StateSpaceModel
from filters.rows import constants_form, constants_reader, memory_places, number_places
from thruster_env.compiled import inlined
from thruster_env.components import (
    matrix_reader,
    matrix_writer,
    tuple_of,
    vector_reader,
    vector_writer,
    written_out,
)


@lru_cache(maxsize=64)
def gaussian_start(n: int, m: int) -> Callable:
    """Return `start(memory, numbers, size)`: belief = prior, for filters of mean and covariance."""
    places, source = memory_places(n, m), number_places(n, m)
    read_mean, read_cov = vector_reader(n, source.prior_mean), matrix_reader(n, n, source.prior_cov)
    store_mean, store_cov = vector_writer(n, places.mean), matrix_writer(n, n, places.cov)

    @inlined
    def start(memory, numbers, size):
        row, _, _ = memory
        store_mean(row, read_mean(numbers))
        store_cov(row, read_cov(numbers))

    return start


@inlined
def nothing_to_summarise(memory, size):
    """Mean and covariance are the belief itself."""


@lru_cache(maxsize=64)
def gaussian_correction(n: int, m: int) -> Callable:
    """Return `correct(row, z, predicted, h, numbers)`: the Kalman update of the belief in a row.

    innovation = z - predicted, S = H P H' + R, K = P H' S^-1, mean += K innovation,
    P = (I - K H) P (I - K H)' + K R K' (Joseph's form). Channels that are NaN in z have no effect.
    """
    places, source = memory_places(n, m), number_places(n, m)
    read_mean, read_cov = vector_reader(n, places.mean), matrix_reader(n, n, places.cov)
    store_mean, store_cov = vector_writer(n, places.mean), matrix_writer(n, n, places.cov)
    read_r = matrix_reader(m, m, source.r)
    store_innovation = vector_writer(m, places.innovation)
    store_innovation_cov = matrix_writer(m, m, places.innovation_cov)
    log_likelihood_place = places.log_likelihood
    mask, factor, likelihood = (
        matrices.masked(m),
        matrices.cholesky_factor(m),
        matrices.innovation_likelihood(m),
    )
    p_ht, s_part, solve = (
        matrices.transposed_multiplier(n, n, m),
        matrices.multiplier(m, n, m),
        matrices.row_solver(n, m),
    )
    add_m, add_n, less = matrices.symmetric_sum(m), matrices.symmetric_sum(n), matrices.identity_less(n)
    k_h, times, times_transposed = (
        matrices.multiplier(n, m, n),
        matrices.multiplier(n, n, n),
        matrices.transposed_multiplier(n, n, n),
    )
    k_r, k_r_kt, apply = (
        matrices.multiplier(n, m, m),
        matrices.transposed_multiplier(n, m, n),
        matrices.vector_multiplier(n, m),
    )
    present = matrices.innovation(m)
    silent = written_out(
        "silent",
        "h, z",
        tuple_of(tuple_of(f"h[{i}][{j}] if z[{i}] == z[{i}] else 0.0" for j in range(n)) for i in range(m)),
    )
    moved = written_out("moved", "x, d", tuple_of(f"x[{i}] + d[{i}]" for i in range(n)))

    @inlined
    def correct(row, z, predicted, observation_matrix, numbers):
        p = read_cov(row)
        h = silent(observation_matrix, z)
        r = mask(read_r(numbers), z)
        innovation = present(z, predicted)
        cross = p_ht(p, h)
        s = add_m(s_part(h, cross), r)
        root = factor(s)
        k = solve(cross, root)
        store_mean(row, moved(read_mean(row), apply(k, innovation)))
        rest = less(k_h(k, h))
        store_cov(row, add_n(times_transposed(times(rest, p), rest), k_r_kt(k_r(k, r), k)))
        store_innovation(row, innovation)
        store_innovation_cov(row, s)
        row[log_likelihood_place] = likelihood(innovation, root, z)

    return correct


@lru_cache(maxsize=64)
def extended_kernels(transition, transition_jacobian, observe, observe_jacobian, n, m, inputs, form) -> Kernels:
    """Kernels of the extended Kalman filter for model functions and sizes."""
    places, source = memory_places(n, m), number_places(n, m)
    substeps_place, step_place = source.substeps, places.step
    read_mean, read_cov = vector_reader(n, places.mean), matrix_reader(n, n, places.cov)
    store_mean, store_cov = vector_writer(n, places.mean), matrix_writer(n, n, places.cov)
    read_q, constants = matrix_reader(n, n, source.q), constants_reader(n, m, form)
    control, measured, read_scales = vector_reader(inputs), vector_reader(m), vector_reader(n, source.scales)
    transition_matrix = jacobian(transition, transition_jacobian, n, n, "u, c")
    observation_matrix = jacobian(observe, observe_jacobian, m, n, "c")
    times, times_transposed = matrices.multiplier(n, n, n), matrices.transposed_multiplier(n, n, n)
    add, correct = matrices.symmetric_sum(n), gaussian_correction(n, m)

    @inlined
    def predict(memory, u, numbers, size):
        row, _, _ = memory
        mean, p = read_mean(row), read_cov(row)
        v, c, scales = control(u), constants(numbers), read_scales(numbers)
        for _ in range(int(numbers[substeps_place])):
            f = transition_matrix(mean, scales, v, c)
            mean = transition(mean, v, c)
            p = times_transposed(times(f, p), f)
        store_mean(row, mean)
        store_cov(row, add(p, read_q(numbers)))
        row[step_place] += 1.0

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        mean, c = read_mean(row), constants(numbers)
        correct(row, measured(z), observe(mean, c), observation_matrix(mean, read_scales(numbers), c), numbers)

    return Kernels(n, m, n, 0, gaussian_start(n, m), predict, update, nothing_to_summarise)


def kernels_of(model: StateSpaceModel) -> Kernels:
    """Extended Kalman kernels for a model."""
    return extended_kernels(
        inlined(model.transition),
        model.transition_jacobian,
        inlined(model.observe),
        model.observe_jacobian,
        model.n,
        model.m,
        model.inputs,
        constants_form(model.constants),
    )


@dataclass(frozen=True, kw_only=True, eq=False)
class ExtendedKalmanFilter(Filter):
    """Extended Kalman filter.

        predict: mean = f(mean, u),  P = F P F' + Q,  F = df/dx at the last mean
        update:  innovation = z - h(mean),  S = H P H' + R,  K = P H' S^-1,  H = dh/dx at the mean,
                 mean += K innovation,  P = (I - K H) P (I - K H)' + K R K'  (Joseph)

    Source: Jazwinski (1970), Stochastic Processes and Filtering Theory, section 8.3.
    """

    name: ClassVar[str] = "ekf"

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return kernels_of(self.kernel_model)
