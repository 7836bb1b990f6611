"""The stochastic ensemble Kalman filter: a Kalman update with moments taken from an ensemble."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import ClassVar

from filters import matrices
from filters.belief import Kernels
from filters.filter import Filter
from filters.rows import constants_form, constants_reader, memory_places, number_places
from thruster_env.checks import at_least
from thruster_env.compiled import inlined
from thruster_env.components import (
    column_reader,
    column_writer,
    matrix_of,
    matrix_reader,
    matrix_writer,
    tuple_of,
    vector_reader,
    vector_writer,
    written_out,
)
from thruster_env.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, fill_normals

LARGEST_ENSEMBLE = 1_000_000


@inlined
def add_noise(table, first, count, draws, numbers, root):
    """Rows first ... += L W, where the lower triangular L lies at numbers[root] and W, by rows, in draws."""
    width = table.shape[1]
    for i in range(count):
        for k in range(i + 1):
            factor = numbers[root + i * count + k]
            if factor != 0.0:
                for j in range(width):
                    table[first + i, j] += factor * draws[k * width + j]


@cache
def row_means(rows: int) -> Callable:
    """Return `means(table, size)`: means of the first `size` entries of rows 0 ... rows - 1, in one loop."""
    places = range(rows)
    return written_out(
        "means",
        "table, size",
        *(f"s{i} = 0.0" for i in places),
        "for j in range(size):",
        *(f"    s{i} += table[{i}, j]" for i in places),
        tuple_of(f"s{i} / size" for i in places),
    )


@cache
def row_covariances(first: int, rows: int, second: int, columns: int) -> Callable:
    """Return `covariances(table, size, means)`: sample covariances of two groups of rows, in one loop.

    Entry (i, j) belongs to rows first + i and second + j; means are those of `row_means`, the divisor is size - 1.
    """
    pairs = [(i, j) for i in range(rows) for j in range(columns) if first != second or j <= i]
    used = sorted({first + i for i, _ in pairs} | {second + j for _, j in pairs})

    def entry(i, j):
        return f"s{i}_{j}" if (i, j) in pairs else f"s{j}_{i}"

    return written_out(
        "covariances",
        "table, size, means",
        *(f"s{i}_{j} = 0.0" for i, j in pairs),
        "for j in range(size):",
        *(f"    d{k} = table[{k}, j] - means[{k}]" for k in used),
        *(f"    s{i}_{j} += d{first + i} * d{second + j}" for i, j in pairs),
        matrix_of(rows, columns, lambda i, j: f"{entry(i, j)} / (size - 1)"),
    )


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
    means_of_members, means_of_all = row_means(n), row_means(n + m)
    covariances_of_members = row_covariances(0, n, 0, n)
    covariances_of_predicted = row_covariances(n, m, n, m)
    cross_covariances = row_covariances(0, n, n, m)
    store_mean, store_cov = vector_writer(n, mean_place), matrix_writer(n, n, cov_place)
    store_innovation = vector_writer(m, innovation_place)
    difference = matrices.innovation(m, n)

    constants, control = constants_reader(n, m, form), vector_reader(inputs)
    state, store_state, store_predicted = column_reader(n), column_writer(n), column_writer(m, n)
    measured = vector_reader(m)
    read_r, mask = matrix_reader(m, m, source.r), matrices.masked(m)
    store_s, store_gain = matrix_writer(m, m, s_place), matrix_writer(n, m, gain_place)
    factor, solve = matrices.cholesky_factor(m), matrices.row_solver(n, m)
    likelihood, add = matrices.innovation_likelihood(m), matrices.symmetric_sum(m)

    @inlined
    def draw(draws, count, row, stream):
        fill_normals(draws, count, row[step_place], stream, row[key_place], row[key_place + 1])

    @inlined
    def summarise(memory, size):
        row, table, _ = memory
        means = means_of_members(table, size)
        store_mean(row, means)
        store_cov(row, covariances_of_members(table, size, means))

    @inlined
    def start(memory, numbers, size):
        row, table, draws = memory
        draw(draws, n * table.shape[1], row, FILTER_PRIOR)
        for i in range(n):
            for j in range(table.shape[1]):
                table[i, j] = numbers[prior_mean_place + i]
        add_noise(table, 0, n, draws, numbers, prior_root_place)

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
        means = means_of_all(table, size)
        present = measured(z)
        s = add(covariances_of_predicted(table, size, means), mask(read_r(numbers), present))
        root = factor(s)
        innovation = difference(present, means)
        store_innovation(row, innovation)
        store_s(row, s)
        store_gain(row, solve(cross_covariances(table, size, means), root))
        row[likelihood_place] = likelihood(innovation, root, present)

        draw(draws, m * table.shape[1], row, FILTER_MEASUREMENT)
        add_noise(table, predicted, m, draws, numbers, r_root_place)
        for i in range(m):
            if z[i] == z[i]:
                for a in range(n):
                    for j in range(table.shape[1]):
                        table[a, j] += row[gain_place + a * m + i] * (z[i] - table[predicted + i, j])
        summarise(memory, size)

    return Kernels(n, m, n + m, max(n, m), start, predict, update, summarise)


@dataclass(frozen=True, kw_only=True, eq=False)
class EnsembleKalmanFilter(Filter):
    """Stochastic ensemble Kalman filter, on the full nonlinear model, with perturbed measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q)
        update:  y_j = h(x_j),  innovation = z - mean(y),  S = cov(y, y) + R,  K = cov(x, y) S^-1,
                 x_j += K (z - v_j - y_j),  v_j ~ N(0, R);  sample covariances with divisor N - 1

    The belief's mean and covariance are those of the members. The perturbations of an update depend on the key and
    the step alone: of two updates within one step the second repeats the first one's.

    Attributes:
        ensemble_size: number N of members, at least 2.

    Source: Evensen (1994); Burgers, van Leeuwen, Evensen (1998), "Analysis scheme in the EnKF".
    """

    name: ClassVar[str] = "enkf"
    ensemble_size: int = 100

    def __post_init__(self):
        """Check the size; raise ValueError if it is not a whole number from 2 to a million."""
        size = at_least("ensemble_size", self.ensemble_size, 2)
        if size > LARGEST_ENSEMBLE:
            raise ValueError(f"ensemble_size must be at most {LARGEST_ENSEMBLE}, but got {size}")
        object.__setattr__(self, "ensemble_size", size)

    @property
    def size(self) -> int:
        """Number of ensemble members."""
        return self.ensemble_size

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        model = self.kernel_model
        functions = inlined(model.transition), inlined(model.observe)
        return ensemble_kernels(*functions, model.n, model.m, model.inputs, constants_form(model.constants))
