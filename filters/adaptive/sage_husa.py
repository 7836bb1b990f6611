"""Sage and Husa's adaptive filter: an extended Kalman filter that learns R, and Q if asked, as it goes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

import numpy as np

from filters.adaptive.noise_moments import mixer, outer, trace_of
from filters.engine.belief import Belief, Kernels
from filters.engine.layout import memory_places, own_place, row_access
from filters.filter import Filter
from filters.gaussian.extended import (
    extended_prediction,
    gaussian_start,
    gaussian_update,
    kernels_of,
    nothing_to_summarise,
)
from numerics import matrices
from numerics.checks import finite
from numerics.compiled import inlined
from numerics.sources import entrywise
from numerics.tuples import matrix_reader, matrix_writer, scaled_sum, vector_reader
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape, observation_slopes


@lru_cache(maxsize=64)
def bounded_step(size: int) -> Callable:
    """Return `step(a, more, less, d)`: A + d (more - less), d shortened to 1/(2 trace(A^-1 less)) if that is less.

    With A positive definite, and `more` and `less` positive semidefinite, `less` is at most trace(A^-1 less) A, so
    the result is at least A/2. A matrix A that is not positive definite stays as it is.
    """
    factor, solve = matrices.cholesky_factor(size), matrices.row_solver(size, size)
    trace, shape = trace_of(size), (size, size)
    add = entrywise(
        "add",
        "a, more, less, d",
        shape,
        lambda i, j: f"a[{i}][{j}] + d * (more[{i}][{j}] - less[{i}][{j}])",
        a=shape,
        more=shape,
        less=shape,
    )

    @inlined
    def step(a, more, less, d):
        ratio = trace(solve(less, factor(a)))
        if not ratio == ratio:
            return a
        return add(a, more, less, d if d * ratio < 0.5 else 0.5 / ratio)

    return step


@lru_cache(maxsize=64)
def sage_husa_kernels(functions: Functions, shape: Shape) -> Kernels:
    """Kernels for a model's functions and shape; extras as the class says."""
    n, m, observe = shape.n, shape.m, functions.observe
    places, source, own = memory_places(n, m), number_places(n, m), own_place(shape)
    r_place, q_place, predicted_place = places.extras, places.extras + m * m, places.extras + m * m + n * n
    likelihood_place = places.log_likelihood
    prior_r, prior_q = matrix_reader(m, m, source.r), matrix_reader(n, n, source.q)
    read_r, store_r = matrix_reader(m, m, r_place), matrix_writer(m, m, r_place)
    read_q, store_q = matrix_reader(n, n, q_place), matrix_writer(n, n, q_place)
    (read_mean, read_cov), (store_mean, store_cov), (store_innovation, store_s) = row_access(shape)
    measured, read_scales = vector_reader(m), vector_reader(n, source.scales)
    constants, observation_matrix = constants_reader(shape), observation_slopes(functions, shape)
    begin, condition = gaussian_start(shape), gaussian_update(shape)
    move = extended_prediction(functions, shape)
    step_r, step_q, square_m, square_n = bounded_step(m), bounded_step(n), outer(m), outer(n)
    mix, change = mixer(n), scaled_sum(n)
    of_present = matrices.present_part(m)

    @inlined
    def start(memory, numbers, size):
        row, _, _ = memory
        begin(memory, numbers, size)
        store_r(row, prior_r(numbers))
        store_q(row, prior_q(numbers))
        row[predicted_place] = 0.0

    @inlined
    def predict(memory, u, numbers, size):
        row, _, _ = memory
        move(row, u, numbers, read_q(row))
        row[predicted_place] = 1.0

    @inlined
    def update(memory, z, numbers, size):
        row, _, _ = memory
        mean, p, r, c, present = read_mean(row), read_cov(row), read_r(row), constants(numbers), measured(z)
        predicted, h = observe(mean, c), observation_matrix(mean, read_scales(numbers), c)
        new_mean, new_p, innovation, s, row[likelihood_place] = condition(mean, p, present, predicted, h, r)
        store_mean(row, new_mean)
        store_cov(row, new_p)
        store_innovation(row, innovation)
        store_s(row, s)
        for_r, for_q = 1.0 - numbers[own], 1.0 - numbers[own + 1]
        if for_r > 0.0:
            store_r(row, step_r(r, square_m(innovation), of_present(s, present), for_r))
        if for_q > 0.0 and row[predicted_place] > 0.0:
            # K innovation innovation' K' and K S K' by what the update changed.
            moved, lost = change(new_mean, -1.0, mean), mix(1.0, p, -1.0, new_p)
            store_q(row, step_q(read_q(row), square_n(moved), lost, for_q))
        row[predicted_place] = 0.0

    extras = m * m + n * n + 1
    return Kernels(n, m, n, 0, start, predict, update, nothing_to_summarise, extras=extras)


@dataclass(frozen=True, kw_only=True, eq=False)
class SageHusaFilter(Filter):
    """Extended Kalman filter that learns R, and Q if asked, from its innovations, with fading memory.

        predict, update: the extended filter's, with the estimates of Q and R in place of the model's
        after an update: R = a R + (1 - a)(i i' - H P H') = R + (1 - a)(i i' - S),  i the innovation
                         Q = Q + (1 - b) K (i i' - S) K' = b Q + (1 - b)(K i i' K' + P_new - F P_old F')

    with P before the update in the first line, P_new after it and P_old before the prediction in the second. On
    average nothing changes if S is the covariance of the innovation. Since i i' - H P H' may be indefinite, a step
    R + d (i i' - S) is limited to d = 1/(2 trace(R^-1 S)), and that of Q likewise, which leaves at least half of
    R: both stay positive definite by construction. A missing channel changes nothing in its row and column of R.
    One channel can rarely distinguish Q from R: with b = 1 Q stays the model's, and a singular Q always does.

    `Belief.extras` holds R (m m numbers), Q (n n), and 1 between a prediction and its update, else 0.

    Attributes:
        forgetting_factor: a, above 0 and at most 1; R is that of the last 1/(1 - a) measurements or so, and with
            a = 1 the model's.
        process_forgetting_factor: b, above 0 and at most 1.

    Raises:
        ValueError: if a factor is not above 0 and at most 1.

    Source: Sage, Husa (1969), "Adaptive filtering with unknown prior statistics"; Mehra (1972), "Approaches to
    adaptive filtering", IEEE Trans. Automatic Control 17(5), on matching covariances. The bound on d is ours.
    """

    name: ClassVar[str] = "sage-husa"
    varying_noise: ClassVar[bool] = False
    forgetting_factor: float = 0.995
    process_forgetting_factor: float = 1.0

    def __post_init__(self):
        """Check the factors; raise ValueError that states the rule and the value."""
        for name in ("forgetting_factor", "process_forgetting_factor"):
            object.__setattr__(self, name, part_that_is_kept(name, getattr(self, name)))

    @property
    def own_numbers(self) -> tuple[float, ...]:
        """Both factors."""
        return self.forgetting_factor, self.process_forgetting_factor

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return kernels_of(self.kernel_model, sage_husa_kernels)

    def estimated_noise(self, belief: Belief) -> np.ndarray:
        """The estimate of R (m, m) in a belief."""
        m = self.model.m
        return belief.extras[: m * m].reshape(m, m).copy()

    def estimated_process_noise(self, belief: Belief) -> np.ndarray:
        """The estimate of Q (n, n) in a belief."""
        n, first = self.model.n, self.model.m**2
        return belief.extras[first : first + n * n].reshape(n, n).copy()


def part_that_is_kept(name: str, value) -> float:
    """Return value as a float; raise ValueError unless it is above 0 and at most 1."""
    factor = finite(name, value)
    if not 0.0 < factor <= 1.0:
        raise ValueError(f"{name} must be above 0 and at most 1, but got {factor}")
    return factor
