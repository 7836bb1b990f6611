"""The extended Kalman filter: the Kalman filter of the model linearised along its own estimate."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, lru_cache
from typing import ClassVar

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places, row_access
from filters.filter import Filter
from numerics import matrices
from numerics.compiled import inlined
from numerics.sources import entrywise
from numerics.tuples import matrix_reader, matrix_writer, scaled_sum, vector_reader
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape, innovation_of, observation_slopes, transition_slopes
from plants.state_space import StateSpaceModel


@lru_cache(maxsize=64)
def gaussian_start(shape: Shape) -> Callable:
    """Return `start(memory, numbers, size)`: belief = prior, for filters of mean and covariance."""
    n, m = shape.n, shape.m
    source = number_places(n, m)
    read_mean, read_cov = vector_reader(n, source.prior_mean), matrix_reader(n, n, source.prior_cov)
    _, (store_mean, store_cov), _ = row_access(shape)

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
def gaussian_innovation(shape: Shape) -> Callable:
    """Return `compare(p, z, predicted, h, r)`: the innovation, its covariance and likelihood.

    It returns innovation = z - predicted, S = H P H' + R, the lower triangular root of S, P H', and H and R as
    they are without the channels that are NaN in z: zeros in the innovation and in H, no correlations in R.
    """
    n, m = shape.n, shape.m
    mask, factor, present, silent = (
        matrices.masked(m),
        matrices.cholesky_factor(m),
        innovation_of(shape),
        silenced(m, n),
    )
    p_ht, s_part, add = (
        matrices.transposed_multiplier(n, n, m),
        matrices.multiplier(m, n, m),
        matrices.symmetric_sum(m),
    )

    @inlined
    def compare(p, z, predicted, observation_matrix, noise):
        h = silent(observation_matrix, z)
        r = mask(noise, z)
        cross = p_ht(p, h)
        s = add(s_part(h, cross), r)
        return present(z, predicted), s, factor(s), cross, h, r

    return compare


@lru_cache(maxsize=64)
def joseph_form(n: int, m: int) -> Callable:
    """Return `reduce(p, k, h, r)`: (I - K H) P (I - K H)' + K R K', which is positive for any gain K."""
    less, k_h, times = matrices.identity_less(n), matrices.multiplier(n, m, n), matrices.multiplier(n, n, n)
    times_transposed, add = matrices.transposed_multiplier(n, n, n), matrices.symmetric_sum(n)
    k_r, k_r_kt = matrices.multiplier(n, m, m), matrices.transposed_multiplier(n, m, n)

    @inlined
    def reduce(p, k, h, r):
        rest = less(k_h(k, h))
        return add(times_transposed(times(rest, p), rest), k_r_kt(k_r(k, r), k))

    return reduce


@lru_cache(maxsize=64)
def gaussian_update(shape: Shape) -> Callable:
    """Return `condition(mean, p, z, predicted, h, r)`: the Kalman update, as a function of tuples.

    innovation = z - predicted, S = H P H' + R, K = P H' S^-1, mean + K innovation,
    (I - K H) P (I - K H)' + K R K' (Joseph's form). Channels that are NaN in z have no effect. It returns the new
    mean and covariance, the innovation, S and the log-likelihood.
    """
    n, m = shape.n, shape.m
    compare, reduce, likelihood = gaussian_innovation(shape), joseph_form(n, m), matrices.innovation_likelihood(m)
    solve, apply, add = matrices.row_solver(n, m), matrices.vector_multiplier(n, m), scaled_sum(n)

    @inlined
    def condition(mean, p, z, predicted, observation_matrix, noise):
        innovation, s, root, cross, h, r = compare(p, z, predicted, observation_matrix, noise)
        k = solve(cross, root)
        mean = add(mean, 1.0, apply(k, innovation))
        return mean, reduce(p, k, h, r), innovation, s, likelihood(innovation, root, z)

    return condition


@cache
def silenced(m: int, columns: int) -> Callable:
    """Return `silent(h, z)`: the matrix h (m, columns) with zero rows for channels that are NaN in z."""
    shape = m, columns
    return entrywise(
        "silent", "h, z", shape, lambda i, j: f"(h[{i}][{j}] if z[{i}] == z[{i}] else 0.0)", h=shape, z=(m,)
    )


@lru_cache(maxsize=64)
def gaussian_correction(shape: Shape) -> Callable:
    """Return `correct(row, z, predicted, h, r)`: `gaussian_update` of the belief in a row."""
    n, m = shape.n, shape.m
    (read_mean, read_cov), (store_mean, store_cov), (store_innovation, store_innovation_cov) = row_access(shape)
    log_likelihood_place, condition = memory_places(n, m).log_likelihood, gaussian_update(shape)

    @inlined
    def correct(row, z, predicted, observation_matrix, r):
        mean, p, innovation, s, log_likelihood = condition(
            read_mean(row), read_cov(row), z, predicted, observation_matrix, r
        )
        store_mean(row, mean)
        store_cov(row, p)
        store_innovation(row, innovation)
        store_innovation_cov(row, s)
        row[log_likelihood_place] = log_likelihood

    return correct


@inlined
def nothing_at_first(memory, u, numbers, size):
    """A prediction that starts with its first substep."""


@lru_cache(maxsize=64)
def in_stages(n: int, m: int, begin: Callable, advance: Callable, finish: Callable) -> Callable:
    """Return `predict(memory, u, numbers, size)`: begin, advance in each of the model's substeps, finish."""
    substeps_place = number_places(n, m).substeps

    @inlined
    def predict(memory, u, numbers, size):
        begin(memory, u, numbers, size)
        for _ in range(int(numbers[substeps_place])):
            advance(memory, u, numbers, size)
        finish(memory, u, numbers, size)

    return predict


@lru_cache(maxsize=64)
def extended_motion(functions: Functions, shape: Shape) -> Callable:
    """Return `advance(row, u, numbers)`: mean = f(mean, u), P = F P F' over one substep."""
    n, m, transition = shape.n, shape.m, functions.transition
    source = number_places(n, m)
    (read_mean, read_cov), (store_mean, store_cov), _ = row_access(shape)
    constants, control = constants_reader(shape), vector_reader(shape.inputs)
    read_scales, transition_matrix = (
        vector_reader(n, source.scales),
        transition_slopes(functions, shape),
    )
    times, times_transposed = matrices.multiplier(n, n, n), matrices.transposed_multiplier(n, n, n)

    @inlined
    def advance(row, u, numbers):
        mean, v, c = read_mean(row), control(u), constants(numbers)
        f = transition_matrix(mean, read_scales(numbers), v, c)
        store_mean(row, transition(mean, v, c))
        store_cov(row, times_transposed(times(f, read_cov(row)), f))

    return advance


@lru_cache(maxsize=64)
def noise_added(n: int, m: int) -> Callable:
    """Return `settle(row, q)`: P += Q, and one more step is counted."""
    places, add = memory_places(n, m), matrices.symmetric_sum(n)
    step_place = places.step
    read_cov, store_cov = matrix_reader(n, n, places.cov), matrix_writer(n, n, places.cov)

    @inlined
    def settle(row, q):
        store_cov(row, add(read_cov(row), q))
        row[step_place] += 1.0

    return settle


@lru_cache(maxsize=64)
def extended_prediction(functions: Functions, shape: Shape) -> Callable:
    """Return `move(row, u, numbers, q)`: the extended filter's prediction of the belief in a row."""
    n, m = shape.n, shape.m
    substeps_place, settle = number_places(n, m).substeps, noise_added(n, m)
    advance = extended_motion(functions, shape)

    @inlined
    def move(row, u, numbers, q):
        for _ in range(int(numbers[substeps_place])):
            advance(row, u, numbers)
        settle(row, q)

    return move


@lru_cache(maxsize=64)
def extended_kernels(functions: Functions, shape: Shape) -> Kernels:
    """Kernels of the extended Kalman filter for a model's functions and shape."""
    n, m, observe = shape.n, shape.m, functions.observe
    source, read_mean = number_places(n, m), vector_reader(n, memory_places(n, m).mean)
    read_q, read_r, constants = (
        matrix_reader(n, n, source.q),
        matrix_reader(m, m, source.r),
        constants_reader(shape),
    )
    measured, read_scales = vector_reader(m), vector_reader(n, source.scales)
    observation_matrix = observation_slopes(functions, shape)
    advance = extended_motion(functions, shape)
    settle, correct = noise_added(n, m), gaussian_correction(shape)

    @inlined
    def substep(memory, u, numbers, size):
        advance(memory[0], u, numbers)

    @inlined
    def finish(memory, u, numbers, size):
        settle(memory[0], read_q(numbers))

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        mean, c = read_mean(row), constants(numbers)
        h = observation_matrix(mean, read_scales(numbers), c)
        correct(row, measured(z), observe(mean, c), h, read_r(numbers))

    stages = nothing_at_first, substep, finish
    predict, start = in_stages(n, m, *stages), gaussian_start(shape)
    return Kernels(n, m, n, 0, start, predict, update, nothing_to_summarise, stages=stages)


def kernels_of(model: StateSpaceModel, build: Callable[..., Kernels] = extended_kernels) -> Kernels:
    """Kernels for a model, by default extended Kalman ones; build takes the arguments of `extended_kernels`."""
    return build(model.functions, model.shape)


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
