"""The log-likelihood of innovations and its gradient with respect to Q and R, by sensitivities of the filter."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from filters.likelihood_slopes import (
    contraction,
    curvature_by_components,
    half_product,
    information_sum,
    log_likelihood_slope,
    masked_inverse,
    no_curvature,
    no_information,
    no_terms,
    present_rows_of,
    slope_along,
    terms_writer,
    with_transposed,
)
from numerics.angles import kept
from numerics.compiled import CompiledOrPython, function_fingerprint, is_interpreting
from numerics.formulas import formula
from numerics.matrices import (
    cholesky_factor,
    factored_inverse,
    innovation_likelihood,
    masked,
    row_solver,
    vector_solver,
)
from numerics.sources import is_array
from numerics.threads import spread
from numerics.tuples import matrix_reader, matrix_writer, vector_reader, vector_writer
from plants.layout import constants_reader, number_places
from plants.shape import Functions, Shape, innovation_of, observation_slopes, transition_slopes
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
    equation of the filter, in which products that all parameters share are formed once a step. F = df/dx and H =
    dh/dx depend on the parameters through m; their derivatives along dm are central differences of the model's
    Jacobians, of large models along each component of x. For affine models they vanish and the gradient is exact.

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
    out, _ = _accumulated(model, (inputs, measurements, q_slopes, r_slopes), False)
    return Likelihood(out[:, 0], out[:, 1:])


def information(
    model: StateSpaceModel, inputs: np.ndarray, measurements: np.ndarray, q_slopes, r_slopes
) -> np.ndarray:
    """Fisher's information on p parameters in the innovations of each of B trajectories, (B, p, p).

        I_ij = sum_k dv_i' S^-1 dv_j + 1/2 tr(S^-1 dS_i S^-1 dS_j)

    with v and S of the filter along that trajectory: the expectation of minus the second derivatives of log L
    where the model is right. Arguments and errors are those of `likelihood`, and about what it costs.

    Source: Gupta, Mehra (1974), as above.
    """
    _, found = _accumulated(model, (inputs, measurements, q_slopes, r_slopes), True)
    return found


def _accumulated(model: StateSpaceModel, given: tuple, informative: bool) -> tuple[np.ndarray, np.ndarray]:
    """Log-likelihood with gradient, (B, 1 + p), and the information, (B, p, p), or nothing in its place."""
    inputs, measurements, q_slopes, r_slopes = (np.ascontiguousarray(value, dtype=np.float64) for value in given)
    n, m, count, parameters = model.n, model.m, len(measurements), len(q_slopes)
    arrays = {"inputs": inputs, "measurements": measurements, "q_slopes": q_slopes, "r_slopes": r_slopes}
    check_shapes(arrays, model, (parameters, n, n), (parameters, m, m))
    out = np.zeros((count, 1 + parameters))
    told = np.zeros((count, parameters, parameters) if informative else (count, 0, 0))
    accumulate = _build(model.functions, model.shape, informative, is_interpreting())
    slopes = q_slopes.reshape(parameters, -1), r_slopes.reshape(parameters, -1)
    arguments = inputs, measurements, model.numbers, *slopes, out, told
    spread(lambda first, last: accumulate(*arguments, first, last), count)
    return out, told


def check_shapes(given: dict[str, np.ndarray], model: StateSpaceModel, *of_slopes: tuple[int, ...]) -> None:
    """Raise ValueError unless inputs, measurements and slopes have the shapes that fit the model."""
    shapes = tuple(array.shape for array in given.values())
    count, steps = len(given["measurements"]), given["inputs"].shape[1] if given["inputs"].ndim == 3 else 0
    wanted = (count, steps, model.inputs), (count, steps + 1, model.m), *of_slopes
    if shapes != wanted:
        *names, last = given
        raise ValueError(f"{', '.join(names)} and {last} must have the shapes {wanted}, but got {shapes}")


@cache
def _build(functions: Functions, shape: Shape, informative: bool, interpreting: bool):
    n, m, transition, observe = shape.n, shape.m, functions.transition, functions.observe
    transition_matrix, observation_matrix = (
        transition_slopes(functions, shape),
        observation_slopes(functions, shape),
    )
    transition = kept(transition, "x, u, c", shape.state_angles)
    places = number_places(n, m)
    constants, scales, control = (
        constants_reader(shape),
        vector_reader(n, places.scales),
        vector_reader(shape.inputs),
    )
    prior_mean = kept(vector_reader(n, places.prior_mean), "numbers", shape.state_angles)
    prior_cov = matrix_reader(n, n, places.prior_cov)
    q, r = matrix_reader(n, n, places.q), matrix_reader(m, m, places.r)
    control, reading = vector_reader(shape.inputs), vector_reader(m)
    q_slope, r_slope = matrix_reader(n, n), matrix_reader(m, m)
    mean_slope, cov_slope = vector_reader(n), matrix_reader(n, n, n)  # a parameter's row: dx, then dP
    store_mean_slope, store_cov_slope = vector_writer(n), matrix_writer(n, n, n)
    difference, root_of, log_likelihood = (
        innovation_of(shape),
        cholesky_factor(m),
        innovation_likelihood(m),
    )
    large = is_array(n, n)
    curved = curvature_by_components(n, n, transition_matrix, "u, c") if large else no_curvature
    motion_slope = contraction(n, n) if large else slope_along(n, n, transition_matrix, "u, c")
    observation_slope = slope_along(m, n, observation_matrix, "c")
    present_rows, present = present_rows_of(m, n), masked(m)
    divide, divide_one, inverse = row_solver(n, m), vector_solver(m), factored_inverse(m)  # by S, and its inverse
    known, likelihood_slope = masked_inverse(m), log_likelihood_slope(m)

    nn, mn, mm, nm = (n, n), (m, n), (m, m), (n, m)
    moved = formula("F P F'", F=nn, P=nn)
    carried = formula("P F'", P=nn, F=nn)
    half_slope, moved_slope = formula("dF G", dF=nn, G=nn), with_transposed(n)  # dF P F' and its transpose
    grown = formula("P + Q", P=nn, Q=nn)
    seen = formula("H P H' + R", H=mn, P=nn, R=mm)
    correlation = formula("P H'", P=nn, H=mn)
    correlation_slope = formula("dP H' + P dH'", P=nn, dP=nn, H=mn, dH=mn)
    seen_slope = formula("H C + dH B + dR", H=mn, dH=mn, C=nm, B=nm, dR=mm)
    moved_mean_slope = formula("F dx", F=nn, dx=(n,))
    seen_mean_slope = formula("H dx", H=mn, dx=(n,))  # less the slope of the innovation
    corrected = kept(formula("x + K v", x=(n,), K=nm, v=(m,)), "x, K, v", shape.state_angles)
    of_noise, corrected_slope = (
        formula("K dS", K=nm, dS=mm),
        formula("dx + C w - T w - K dy", dx=(n,), C=nm, T=nm, w=(m,), K=nm, dy=(m,)),
    )
    reduced = formula("P - K S K'", P=nn, K=nm, S=mm)
    half_reduced, reduced_slope = half_product(n, m), with_transposed(n)
    note, add_information = (terms_writer(m), information_sum(m)) if informative else (no_terms, no_information)
    fingerprint = function_fingerprint(transition, transition_matrix, observe, observation_matrix, within=__name__)

    def accumulate(all_inputs, measurements, numbers, q_slopes, r_slopes, out, told, first, last):
        fingerprint  # noqa: B018 - part of the cache's key
        c, s = constants(numbers), scales(numbers)
        rows, terms = np.zeros((q_slopes.shape[0], n + n * n)), np.zeros((q_slopes.shape[0], m + m * m))
        for b in range(first, last):
            x, p = prior_mean(numbers), prior_cov(numbers)
            rows[:] = 0.0
            for k in range(measurements.shape[1]):
                if k > 0:
                    u = control(all_inputs[b, k - 1])
                    for _ in range(int(numbers[places.substeps])):
                        f, curvature = transition_matrix(x, s, u, c), curved(x, s, u, c)
                        g = carried(p, f)
                        for j in range(rows.shape[0]):
                            dx, dp = mean_slope(rows[j]), cov_slope(rows[j])
                            df = motion_slope(curvature, x, s, dx, u, c)
                            store_mean_slope(rows[j], moved_mean_slope(f, dx))
                            store_cov_slope(rows[j], moved_slope(moved(f, dp), half_slope(df, g)))
                        x, p = transition(x, u, c), moved(f, p)
                    p = grown(p, q(numbers))
                    for j in range(rows.shape[0]):
                        store_cov_slope(rows[j], grown(cov_slope(rows[j]), q_slope(q_slopes[j])))
                z = reading(measurements[b, k])
                h = present_rows(observation_matrix(x, s, c), z)
                v, spread_of_v = difference(z, observe(x, c)), seen(h, p, present(r(numbers), z))
                root = root_of(spread_of_v)
                shared = correlation(p, h)
                gain, w, s_inverse = divide(shared, root), divide_one(v, root), known(inverse(root), z)
                out[b, 0] += log_likelihood(v, root, z)
                for j in range(rows.shape[0]):
                    dx, dp = mean_slope(rows[j]), cov_slope(rows[j])
                    dh = present_rows(observation_slope(0.0, x, s, dx, c), z)
                    dy, both = seen_mean_slope(h, dx), correlation_slope(p, dp, h, dh)
                    ds = seen_slope(h, dh, both, shared, present(r_slope(r_slopes[j]), z))
                    note(terms[j], dy, ds)
                    turned = of_noise(gain, ds)
                    out[b, 1 + j] += likelihood_slope(w, s_inverse, dy, ds)
                    store_mean_slope(rows[j], corrected_slope(dx, both, turned, w, gain, dy))
                    store_cov_slope(rows[j], reduced_slope(dp, half_reduced(both, turned, gain)))
                add_information(told[b], terms, s_inverse)
                x, p = corrected(x, gain, v), reduced(p, gain, spread_of_v)

    return CompiledOrPython(accumulate)
