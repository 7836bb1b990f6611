"""The stochastic ensemble Kalman filter: a Kalman update with moments taken from an ensemble."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from filters import matrices
from filters.belief import Kernels
from filters.filter import Filter
from filters.rows import constants_form, constants_reader, memory_places, number_places
from thruster_env.checks import at_least
from thruster_env.compiled import compilable, inlined
from thruster_env.components import (
    column_reader,
    column_writer,
    matrix_reader,
    matrix_writer,
    vector_reader,
)
from thruster_env.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, fill_normals


@compilable
def add_noise(table, first, count, draws, numbers, root):
    """Rows first ... += L W, where the lower triangular L lies at numbers[root] and W, by rows, in draws."""
    width = table.shape[1]
    for i in range(count):
        for k in range(i + 1):
            factor = numbers[root + i * count + k]
            if factor != 0.0:
                for j in range(width):
                    table[first + i, j] += factor * draws[k * width + j]


@compilable
def mean_of_row(table, i, size):
    """Mean of the first `size` entries of row i."""
    total = 0.0
    for j in range(size):
        total += table[i, j]
    return total / size


@compilable
def covariance_of_rows(table, i, mean_i, k, mean_k, size):
    """Sample covariance, divisor size - 1, of the first `size` entries of rows i and k."""
    total = 0.0
    for j in range(size):
        total += (table[i, j] - mean_i) * (table[k, j] - mean_k)
    return total / (size - 1)


@compilable
def take_moments(row, mean, cov, table, first, count, size):
    """Write mean and covariance of rows first ... first + count - 1 to row[mean] and row[cov]."""
    for i in range(count):
        row[mean + i] = mean_of_row(table, first + i, size)
        for k in range(i + 1):
            value = covariance_of_rows(table, first + i, row[mean + i], first + k, row[mean + k], size)
            row[cov + i * count + k] = value
            row[cov + k * count + i] = value


@lru_cache(maxsize=64)
def ensemble_kernels(transition, observe, n, m, inputs, form) -> Kernels:
    """Kernels of the stochastic ensemble Kalman filter for model functions and sizes.

    The table's rows: n of members, m of predicted measurements.
    """
    places, source = memory_places(n, m), number_places(n, m)
    mean_place, cov_place, key_place, step_place = places.mean, places.cov, places.key_0, places.step
    innovation_place, s_place, gain_place = places.innovation, places.innovation_cov, places.gain
    likelihood_place, substeps_place = places.log_likelihood, source.substeps
    prior_mean_place, prior_root_place = source.prior_mean, source.prior_root
    q_root_place, r_root_place = source.q_root, source.r_root
    predicted = n

    constants, control = constants_reader(n, m, form), vector_reader(inputs)
    state, store_state, store_predicted = column_reader(n), column_writer(n), column_writer(m, n)
    measured, read_innovation = vector_reader(m), vector_reader(m, innovation_place)
    read_r, mask = matrix_reader(m, m, source.r), matrices.masked(m)
    read_s, store_s = matrix_reader(m, m, s_place), matrix_writer(m, m, s_place)
    read_gain, store_gain = matrix_reader(n, m, gain_place), matrix_writer(n, m, gain_place)
    factor, solve = matrices.cholesky_factor(m), matrices.row_solver(n, m)
    likelihood, add = matrices.innovation_likelihood(m), matrices.symmetric_sum(m)

    @compilable
    def draw(draws, count, row, stream):
        fill_normals(draws, count, row[step_place], stream, row[key_place], row[key_place + 1])

    @inlined
    def start(memory, numbers, size):
        row, table, draws = memory
        draw(draws, n * table.shape[1], row, FILTER_PRIOR)
        for i in range(n):
            for j in range(table.shape[1]):
                table[i, j] = numbers[prior_mean_place + i]
        add_noise(table, 0, n, draws, numbers, prior_root_place)
        take_moments(row, mean_place, cov_place, table, 0, n, size)

    @inlined
    def predict(memory, u, numbers, size):
        row, table, draws = memory
        v, c = control(u), constants(numbers)
        for _ in range(int(numbers[substeps_place])):
            for j in range(table.shape[1]):
                store_state(table, j, transition(state(table, j), v, c))
        row[step_place] += 1.0
        draw(draws, n * table.shape[1], row, FILTER_PROCESS)
        add_noise(table, 0, n, draws, numbers, q_root_place)
        take_moments(row, mean_place, cov_place, table, 0, n, size)

    @inlined
    def update(memory, z, numbers, size):
        row, table, draws = memory
        c = constants(numbers)
        for j in range(table.shape[1]):
            store_predicted(table, j, observe(state(table, j), c))
        for i in range(m):
            if z[i] != z[i]:  # a missing channel: constant predictions have no covariance with anything
                for j in range(table.shape[1]):
                    table[predicted + i, j] = 0.0
        take_moments(row, innovation_place, s_place, table, predicted, m, size)
        for i in range(m):
            centre = row[innovation_place + i]
            for a in range(n):
                row[gain_place + a * m + i] = covariance_of_rows(
                    table, a, row[mean_place + a], predicted + i, centre, size
                )
            row[innovation_place + i] = z[i] - centre if z[i] == z[i] else 0.0
        present = measured(z)
        s = add(read_s(row), mask(read_r(numbers), present))
        root = factor(s)
        store_s(row, s)
        store_gain(row, solve(read_gain(row), root))
        row[likelihood_place] = likelihood(read_innovation(row), root, present)

        draw(draws, m * table.shape[1], row, FILTER_MEASUREMENT)
        add_noise(table, predicted, m, draws, numbers, r_root_place)
        for i in range(m):
            if z[i] == z[i]:
                for a in range(n):
                    for j in range(table.shape[1]):
                        table[a, j] += row[gain_place + a * m + i] * (z[i] - table[predicted + i, j])
        take_moments(row, mean_place, cov_place, table, 0, n, size)

    return Kernels(n, m, n + m, max(n, m), start, predict, update)


@dataclass(frozen=True, kw_only=True, eq=False)
class EnsembleKalmanFilter(Filter):
    """Stochastic ensemble Kalman filter, on the full nonlinear model, with perturbed measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  innovation = z - mean(y),  S = cov(y, y) + R,  K = cov(x, y) S^-1,
                 x_j += K (z - v_j - y_j),  v_j ~ N(0, R);  sample covariances with divisor N - 1

    The belief's mean and covariance are those of the members.

    Attributes:
        ensemble_size: number N of members, at least 2.

    Source: Evensen (1994); Burgers, van Leeuwen, Evensen (1998), "Analysis scheme in the EnKF".
    """

    name: ClassVar[str] = "enkf"
    ensemble_size: int = 100

    def __post_init__(self):
        """Check the size; raise ValueError if it is not a whole number of at least 2."""
        object.__setattr__(self, "ensemble_size", at_least("ensemble_size", self.ensemble_size, 2))

    @property
    def size(self) -> int:
        """Number of ensemble members."""
        return self.ensemble_size

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        model = self.kernel_model
        functions = inlined(model.transition), inlined(model.observe)
        return ensemble_kernels(*functions, model.n, model.m, model.inputs, constants_form(model.constants))
