"""The log-likelihood of innovations and its gradient with respect to Q and R, by sensitivities of the filter."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from numerics.angles import kept
from numerics.compiled import CompiledOrPython, function_fingerprint, inlined, is_interpreting
from numerics.derivatives import RELATIVE_STEP
from numerics.formulas import formula
from numerics.matrices import cholesky_factor, innovation_likelihood, masked, row_solver, vector_solver
from numerics.sources import Source, entrywise, matrix_of, tuple_of, written_out
from numerics.threads import spread
from numerics.tuples import matrix_reader, matrix_writer, scaled_sum, vector_reader, vector_writer
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
    shapes = inputs.shape, measurements.shape, q_slopes.shape, r_slopes.shape
    steps = inputs.shape[1] if inputs.ndim == 3 else 0
    wanted = (count, steps, model.inputs), (count, steps + 1, m), (parameters, n, n), (parameters, m, m)
    if shapes != wanted:
        raise ValueError(
            f"inputs, measurements, q_slopes and r_slopes must have the shapes {wanted}, but got {shapes}"
        )
    out = np.zeros((count, 1 + parameters))
    accumulate = _build(model.functions, model.shape, is_interpreting())
    slopes = q_slopes.reshape(parameters, -1), r_slopes.reshape(parameters, -1)
    arguments = inputs, measurements, model.numbers, *slopes, out
    spread(lambda first, last: accumulate(*arguments, first, last), count)
    return Likelihood(out[:, 0], out[:, 1:])


@cache
def _build(functions: Functions, shape: Shape, interpreting: bool):
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
    motion_slope = _slope_along(n, n, transition_matrix, "u, c")
    observation_slope = _slope_along(m, n, observation_matrix, "c")
    present_rows, present = _present_rows(m, n), masked(m)
    likelihood_slope = _log_likelihood_slope(m)
    divide = row_solver(n, m)  # by S

    nn, mn, mm, nm = (n, n), (m, n), (m, m), (n, m)
    moved = formula("F P F'", F=nn, P=nn)
    moved_slope = formula("dF P F' + F dP F' + F P dF'", F=nn, dF=nn, P=nn, dP=nn)
    grown = formula("P + Q", P=nn, Q=nn)
    seen = formula("H P H' + R", H=mn, P=nn, R=mm)
    seen_slope = formula("dH P H' + H dP H' + H P dH' + dR", H=mn, dH=mn, P=nn, dP=nn, dR=mm)
    correlation = formula("P H'", P=nn, H=mn)
    uneven_gain = formula("dP H' + P dH' - K dS", H=mn, dH=mn, P=nn, dP=nn, K=nm, dS=mm)
    moved_mean_slope = formula("F dx", F=nn, dx=(n,))
    seen_mean_slope = formula("H dx", H=mn, dx=(n,))  # less the slope of the innovation
    corrected = kept(formula("x + K v", x=(n,), K=nm, v=(m,)), "x, K, v", shape.state_angles)
    corrected_slope = formula("dx + dK v - K dy", dx=(n,), K=nm, dK=nm, v=(m,), dy=(m,))
    reduced = formula("P - K S K'", P=nn, K=nm, S=mm)
    reduced_slope = formula("dP - dK S K' - K dS K' - K S dK'", dP=nn, K=nm, dK=nm, S=mm, dS=mm)
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
                    for _ in range(int(numbers[places.substeps])):
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


@cache
def _slope_along(rows: int, columns: int, matrix, arguments: str):
    """`slope(x, scales, d, <arguments>)`: the derivative of a Jacobian along d, by central differences."""
    arrays = {"result": (rows, columns), "x": (columns,), "scales": (columns,), "d": (columns,)}
    source = Source("slope", f"x, scales, d, {arguments}", **arrays)
    if source.loops:
        source.line("h = 1e-300")
        for i in source.range(columns):
            source.line(f"h = max(h, abs(d[{i}]) / (abs(x[{i}]) + scales[{i}]))")
        source.line(f"h = {RELATIVE_STEP} / h")
        source.line(f"above = matrix(move(x, h, d), scales, {arguments})")
        source.line(f"below = matrix(move(x, -h, d), scales, {arguments})")
        entry = source.matrix(rows, columns, lambda i, j: f"(above[{i}, {j}] - below[{i}, {j}]) / (2.0 * h)")
        return source.function(entry, matrix=matrix, move=scaled_sum(columns))
    sizes = ", ".join(f"abs(d[{i}]) / (abs(x[{i}]) + scales[{i}])" for i in range(columns))
    lines = [f"h = {RELATIVE_STEP} / max(1e-300, {sizes})"]
    for name, sign in (("above", "+"), ("below", "-")):
        point = tuple_of(f"x[{i}] {sign} h * d[{i}]" for i in range(columns))
        lines.append(f"{name} = matrix({point}, scales, {arguments})")
    entry = matrix_of(rows, columns, lambda i, j: f"(above[{i}][{j}] - below[{i}][{j}]) / (2.0 * h)")
    return written_out("slope", f"x, scales, d, {arguments}", *lines, entry, matrix=matrix)


@cache
def _present_rows(rows: int, columns: int):
    """`keep(h, z)`: h with zeros in the rows of channels that are NaN in z."""
    shape = rows, columns
    return entrywise(
        "keep", "h, z", shape, lambda i, j: f"h[{i}][{j}] if z[{i}] == z[{i}] else 0.0", h=shape, z=(rows,)
    )


@cache
def _log_likelihood_slope(size: int):
    """`slope(v, dy, l, ds, z)`: of log N(v; 0, S) with S = l l', where v changes by -dy and S by ds.

    It is -1/2 tr(S^-1 dS) + w' dy + 1/2 w' dS w with w = S^-1 v, over the channels that are not NaN in z.
    """
    matrix, vector = (size, size), (size,)
    shapes = {"w": vector, "e": matrix, "dy": vector, "ds": matrix, "z": vector}
    source = Source("combine", "w, e, dy, ds, z", work=size * size, **shapes)
    products = (f"w[{i}] * ds[{i}][{j}] * w[{j}]" for i in source.range(size) for j in source.range(size))
    square = source.sum(products)
    trace = source.sum(f"(e[{i}][{i}] if z[{i}] == z[{i}] else 0.0)" for i in source.range(size))
    shift = source.sum(f"w[{i}] * dy[{i}]" for i in source.range(size))
    combine = source.function(f"0.5 * ({square} - ({trace})) + {shift}")
    divide_one, divide = vector_solver(size), row_solver(size, size)

    @inlined
    def slope(v, dy, root, ds, z):
        return combine(divide_one(v, root), divide(ds, root), dy, ds, z)

    return slope
