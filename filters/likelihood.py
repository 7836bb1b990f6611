"""The log-likelihood of innovations and its gradient with respect to Q and R, by sensitivities of the filter."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from filters.innovation_slopes import log_likelihood_slope
from filters.recursion import recursion_of
from filters.sensitivity_parts import slope_along
from numerics.angles import kept
from numerics.compiled import CompiledOrPython, function_fingerprint, is_interpreting
from numerics.formulas import formula
from numerics.matrices import innovation_likelihood
from numerics.threads import spread
from plants.layout import number_places
from plants.shape import Functions, Shape, observation_slopes, transition_slopes
from plants.state_space import StateSpaceModel


class Likelihood(NamedTuple):
    """Log-likelihood of the innovations of B trajectories, and its slopes along p parameters."""

    values: np.ndarray  # (B,)
    gradients: np.ndarray  # (B, p)


def likelihood(
    model: StateSpaceModel, inputs: np.ndarray, measurements: np.ndarray, q_slopes, r_slopes
) -> Likelihood:
    """Log-likelihood of the (extended) Kalman filter's innovations, with its gradient.

        log L = -1/2 sum_k (v' S^-1 v + log det 2 pi S),  v = z - h(m),  S = H P H' + R

    Beside mean m and covariance P the recursion carries dm and dP for each parameter: the derivative of every
    equation of the filter. F = df/dx and H = dh/dx depend on the parameters through m; their derivatives along dm
    are central differences of the model's Jacobians. For affine models they vanish and the gradient is exact.

    Args:
        model: holds Q and R, at which the gradient is taken.
        inputs: (B, K, p).
        measurements: (B, K + 1, m); NaN where missing.
        q_slopes: dQ/dparameter, (parameters, n, n), symmetric.
        r_slopes: dR/dparameter, (parameters, m, m), symmetric.

    Raises:
        ValueError: if shapes do not fit.

    Source: Gupta, Mehra (1974), "Computational aspects of maximum likelihood estimation and reduction in
    sensitivity function calculations", IEEE Trans. Automatic Control 19(6).
    """
    inputs, measurements, q_slopes, r_slopes = (
        np.ascontiguousarray(value, dtype=np.float64) for value in (inputs, measurements, q_slopes, r_slopes)
    )
    n, m, count, parameters = model.n, model.m, len(measurements), len(q_slopes)
    given = {"inputs": inputs, "measurements": measurements, "q_slopes": q_slopes, "r_slopes": r_slopes}
    check_shapes(given, model, (parameters, n, n), (parameters, m, m))
    out = np.zeros((count, 1 + parameters))
    accumulate = _build(model.functions, model.shape, is_interpreting())
    slopes = q_slopes.reshape(parameters, -1), r_slopes.reshape(parameters, -1)
    arguments = inputs, measurements, model.numbers, *slopes, out
    spread(lambda first, last: accumulate(*arguments, first, last), count)
    return Likelihood(out[:, 0], out[:, 1:])


def check_shapes(given: dict[str, np.ndarray], model: StateSpaceModel, *of_slopes: tuple[int, ...]) -> None:
    """Raise ValueError unless inputs, measurements and slopes have the shapes that fit the model."""
    shapes = tuple(array.shape for array in given.values())
    count, steps = len(given["measurements"]), given["inputs"].shape[1] if given["inputs"].ndim == 3 else 0
    wanted = (count, steps, model.inputs), (count, steps + 1, model.m), *of_slopes
    if shapes != wanted:
        *names, last = given
        raise ValueError(f"{', '.join(names)} and {last} must have the shapes {wanted}, but got {shapes}")


@cache
def _build(functions: Functions, shape: Shape, interpreting: bool):
    n, m, transition, observe = shape.n, shape.m, functions.transition, functions.observe
    transition_matrix = transition_slopes(functions, shape)
    observation_matrix = observation_slopes(functions, shape)
    transition = kept(transition, "x, u, c", shape.state_angles)
    substeps = number_places(n, m).substeps
    (
        constants,
        scales,
        control,
        reading,
        prior_mean,
        prior_cov,
        q,
        r,
        q_slope,
        r_slope,
        mean_slope,
        cov_slope,
        store_mean_slope,
        store_cov_slope,
        difference,
        root_of,
        divide,
        present_rows,
        present,
        moved,
        moved_slope,
        grown,
        seen,
        seen_slope,
        correlation,
        uneven_gain,
        corrected,
        corrected_slope,
        reduced,
        reduced_slope,
    ) = recursion_of(shape)
    motion_slope = slope_along(n, n, transition_matrix, "u, c")
    observation_slope = slope_along(m, n, observation_matrix, "c")
    log_likelihood, likelihood_slope = innovation_likelihood(m), log_likelihood_slope(m)
    moved_mean_slope = formula("F dx", F=(n, n), dx=(n,))
    seen_mean_slope = formula("H dx", H=(m, n), dx=(n,))  # less the slope of the innovation
    fingerprint = function_fingerprint(transition, transition_matrix, observe, observation_matrix, within=__name__)

    def accumulate(all_inputs, measurements, numbers, q_slopes, r_slopes, out, first, last):
        fingerprint  # noqa: B018 - part of the cache's key
        c, s = constants(numbers), scales(numbers)
        rows = np.zeros((q_slopes.shape[0], n + n * n))
        for b in range(first, last):
            x, p = prior_mean(numbers), prior_cov(numbers)
            rows[:] = 0.0
            for k in range(measurements.shape[1]):
                if k > 0:
                    u = control(all_inputs[b, k - 1])
                    for _ in range(int(numbers[substeps])):
                        f = transition_matrix(x, s, u, c)
                        for j in range(rows.shape[0]):
                            dx, dp = mean_slope(rows[j]), cov_slope(rows[j])
                            df = motion_slope(x, s, dx, u, c)
                            store_mean_slope(rows[j], moved_mean_slope(f, dx))
                            store_cov_slope(rows[j], moved_slope(f, df, p, dp))
                        x, p = transition(x, u, c), moved(f, p)
                    p = grown(p, q(numbers))
                    for j in range(rows.shape[0]):
                        store_cov_slope(rows[j], grown(cov_slope(rows[j]), q_slope(q_slopes[j])))
                z = reading(measurements[b, k])
                h = present_rows(observation_matrix(x, s, c), z)
                v, spread_of_v = difference(z, observe(x, c)), seen(h, p, present(r(numbers), z))
                root = root_of(spread_of_v)
                gain = divide(correlation(p, h), root)
                out[b, 0] += log_likelihood(v, root, z)
                for j in range(rows.shape[0]):
                    dx, dp = mean_slope(rows[j]), cov_slope(rows[j])
                    dh = present_rows(observation_slope(x, s, dx, c), z)
                    dy = seen_mean_slope(h, dx)
                    ds = seen_slope(h, dh, p, dp, present(r_slope(r_slopes[j]), z))
                    dgain = divide(uneven_gain(h, dh, p, dp, gain, ds), root)
                    out[b, 1 + j] += likelihood_slope(v, dy, root, ds, z)
                    store_mean_slope(rows[j], corrected_slope(dx, gain, dgain, v, dy))
                    store_cov_slope(rows[j], reduced_slope(dp, gain, dgain, spread_of_v, ds))
                x, p = corrected(x, gain, v), reduced(p, gain, spread_of_v)

    return CompiledOrPython(accumulate)
