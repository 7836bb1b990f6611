"""Algebra of matrices, points and weights: arrays, graphs, derivatives, calls made for sizes, and textbooks."""

import math

import numpy as np
import pytest
from scipy.linalg import solve_triangular
from scipy.stats import multivariate_normal, multivariate_t

from filters.algebra import operations, points
from filters.algebra.calls import calls_of
from filters.algebra.matrices import Matrix, evaluate, in_order, input_matrix
from filters.algebra.operations import (
    at_least,
    choose,
    divide,
    exceeds,
    eye,
    joseph,
    mask_missing,
    present,
    slopes_of,
    sym,
    uncorrelated,
    wrap,
)
from filters.algebra.points import (
    effective_size,
    first,
    heavier,
    log_density,
    normalised,
    on_circle,
    ones,
    outer,
    outlier_weight,
    root,
    root_slope,
    square,
    tail_of,
    units,
    weighted_covariance,
    weighted_mean,
    weighted_square,
    weights,
    without_first,
)
from filters.pages.kernels import Stage, as_calls, of_members, works_of
from filters.particles.kernels import systematic_resampler
from thruster_env.core.angles import on_one_branch
from thruster_env.core.streams import exponential
from thruster_env.graphs.graphs import ROWS
from thruster_env.graphs.loops import Loops
from thruster_env.graphs.programs import OF_MEMBERS, Place

RNG = np.random.default_rng(0)
N, M = 3, 2


def covariance_of(size):
    root = RNG.normal(size=(size, size))
    return root @ root.T + np.eye(size)


def values_of_sizes(n, m):
    """Of the matrices that the formulas below are made of."""
    return {
        "P": covariance_of(n),
        "R": covariance_of(m),
        "H": RNG.normal(size=(m, n)),
        "F": RNG.normal(size=(n, n)),
        "x": RNG.normal(size=n),
        "v": RNG.normal(size=m),
        "z": np.where(np.arange(m) == 1, np.nan, 0.5) if m > 1 else np.zeros(m),
    }


def innovation_covariance(g):
    seen = present(g["z"])
    return sym(mask_missing(seen, g["H"]) @ g["P"] @ mask_missing(seen, g["H"]).T + uncorrelated(seen, g["R"]))


def posterior(g):
    h, r = mask_missing(present(g["z"]), g["H"]), uncorrelated(present(g["z"]), g["R"])
    return joseph(g["P"], divide(g["P"] @ h.T, sym(h @ g["P"] @ h.T + r)), h, r)


FORMULAS = {
    "predicted": lambda g: sym(g["F"] @ g["P"] @ g["F"].T),
    "sums": lambda g: g["F"] @ g["x"] - g["x"] * 2.0 + (-g["F"].T) @ g["x"],
    "seen": innovation_covariance,
    "gain": lambda g: divide(g["P"] @ g["H"].T, sym(g["H"] @ g["P"] @ g["H"].T + g["R"])),
    "corrected": lambda g: (
        g["x"] + divide(g["P"] @ g["H"].T, innovation_covariance(g)) @ mask_missing(present(g["z"]), g["v"])
    ),
    "posterior": posterior,
    "any gain": lambda g: joseph(g["P"], g["H"].T, g["H"], g["R"]),
    "rest": lambda g: (eye(g["x"]) - g["F"]) @ wrap(g["x"] + g["x"], (True, False) + (False,) * (len(g["x"]) - 2)),
    "root": lambda g: root(g["P"]),
    "points": lambda g: g["H"] @ (outer(g["x"], ones(units(g["x"]))) + (root(g["P"]) * 0.7) @ units(g["x"])),
    "scatter": lambda g: (
        square(without_first(g["F"])) + outer(first(g["F"]), first(g["F"])) + outer(g["x"], g["F"] @ g["x"])
    ),
    "circle": lambda g: on_circle(g["F"], (True, False) + (True,) * (len(g["x"]) - 2)),
    "entries": lambda g: abs(g["x"]) * g["x"] ** 3.0 / (1.0 + g["x"] ** 2.0) - 0.3 + at_least(g["x"], 0.0) ** 4.0,
    "chosen": lambda g: choose(exceeds(g["F"], 0.0), 2.0 - g["F"] ** 4.0, 2.0 + g["F"] * g["F"] ** 3.0),
    "density": lambda g: log_density(
        mask_missing(present(g["z"]), g["v"]), innovation_covariance(g), present(g["z"])
    ),
}
ENTRIES = ("P", "R", "H", "F", "x", "v", "z")


def as_matrices(values):
    first = input_matrix("P", values["P"].shape, symmetric=True)
    others = {k: input_matrix(k, a.shape, symmetric=k == "R", like=first) for k, a in values.items() if k != "P"}
    return {"P": first, **others}


@pytest.mark.parametrize("name", FORMULAS)
def test_a_formula_of_matrices_is_that_of_arrays(name):
    values = values_of_sizes(N, M)
    matrices = as_matrices(values)
    wanted = FORMULAS[name](matrices)
    found = evaluate([wanted], {matrices[k]: values[k] for k in ENTRIES})[0]
    np.testing.assert_allclose(found, FORMULAS[name](values), rtol=1e-12, atol=1e-13)
    assert np.shape(found) == wanted.shape


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("moving", [("P", "R", "H", "F", "x", "v"), ("P",), ("R", "v"), ("H", "F", "x")])
def test_slopes_are_those_of_central_differences(name, moving):
    values = values_of_sizes(N, M)
    directions = {k: RNG.normal(size=values[k].shape) for k in moving}
    directions = {k: a + a.T if k in "PR" else a for k, a in directions.items()}
    matrices = as_matrices(values)
    moves = {
        matrices[k]: input_matrix(f"d{k}", a.shape, symmetric=k in "PR", like=matrices["P"])
        for k, a in directions.items()
    }
    slope = slopes_of([FORMULAS[name](matrices)], moves)[0]

    def at(h):
        return FORMULAS[name]({k: a + h * directions[k] if k in moving else a for k, a in values.items()})

    expected = (8 * (at(1e-3) - at(-1e-3)) - (at(2e-3) - at(-2e-3))) / 12e-3
    if slope is None:
        assert not np.any(expected)
        return
    known = {matrices[k]: values[k] for k in ENTRIES} | {moves[matrices[k]]: directions[k] for k in moving}
    np.testing.assert_allclose(evaluate([slope], known)[0], expected, rtol=1e-7, atol=1e-7 * abs(expected).max())


def test_of_the_best_gain_no_derivative_is_formed():
    matrices = as_matrices(values_of_sizes(N, M))
    moves = {matrices["P"]: input_matrix("dP", (N, N), symmetric=True, like=matrices["P"])}
    divided = lambda wanted: [one for one in in_order(wanted) if one.operation is operations.quotient]  # noqa: E731
    slopes = slopes_of([posterior(matrices), FORMULAS["corrected"](matrices)], moves)
    assert {one.shape for one in divided(slopes)} == {(N, M), (M,)}
    assert len([one for one in divided(slopes) if one.shape == (N, M)]) == 2  # the gains of two filters themselves


@pytest.mark.parametrize("name", FORMULAS)
@pytest.mark.parametrize("sizes", [(2, 1), (3, 2), (8, 7), (40, 3)])
def test_calls_of_functions_are_the_formula(name, sizes):
    values = values_of_sizes(*sizes)
    first, place = None, 0
    matrices, numbers = {}, []
    for key, value in values.items():
        matrices[key] = input_matrix(Place("numbers", place), value.shape, symmetric=key in "PR", like=first)
        first, place = matrices[key] if first is None else first, place + value.size
        numbers.append(value.ravel())
    wanted = FORMULAS[name](matrices)
    expected = np.array(FORMULAS[name](values))
    known = {one: one.operation for one in matrices.values()}
    rows = np.zeros(expected.size)
    work = calls_of([(Place("rows", 0), wanted)], known, {})
    work(rows, np.zeros(1), np.concatenate(numbers), np.zeros(1))
    np.testing.assert_allclose(rows.reshape(expected.shape), expected, rtol=1e-10, atol=1e-11)


def test_what_stands_in_a_formula_twice_is_there_once():
    g = as_matrices(values_of_sizes(N, M))
    assert g["H"] @ g["P"] is g["H"] @ g["P"] and g["P"].T is g["P"] and g["H"].T.T is g["H"]
    assert sym(g["H"] @ g["P"] @ g["H"].T).arguments[2] is g["P"] @ g["H"].T
    assert isinstance(posterior(g), Matrix) and posterior(g).operation is operations.of_best_gain
    assert FORMULAS["any gain"](g).operation is not operations.of_best_gain


def test_densities_are_those_of_scipy():
    s, v = covariance_of(3), RNG.normal(size=3)
    there, z = [0, 2], np.array([0.0, np.nan, 1.0])
    seen = present(z)
    masked, innovation = uncorrelated(seen, s), mask_missing(seen, v)
    part = s[np.ix_(there, there)]
    normal = log_density(innovation, masked, seen)
    assert normal == pytest.approx(multivariate_normal(cov=part).logpdf(v[there]), rel=1e-12)
    q = v[there] @ np.linalg.solve(part, v[there])
    for degrees in (3.0, 30.0):
        found = normal + heavier(q, seen, np.array(tail_of(degrees, 3)))
        student = multivariate_t(shape=part * (degrees - 2) / degrees, df=degrees).logpdf(v[there])
        assert found == pytest.approx(student, rel=1e-10)
        weight = outlier_weight(q, seen, np.array(tail_of(degrees, 3)))
        assert weight == pytest.approx((degrees + 2) / (degrees - 2 + q), rel=1e-12)
    assert heavier(q, seen, np.array(tail_of(np.inf, 3))) == 0.0
    assert outlier_weight(q, seen, np.array(tail_of(np.inf, 3))) == 1.0


def test_a_covariance_that_is_none_has_no_density():
    seen = np.array([True, True])
    assert np.isnan(log_density(np.ones(2), np.array([[1.0, 2.0], [2.0, 1.0]]), seen))
    with pytest.raises(TypeError, match="no derivative"):
        slopes_of([points.dot(x := input_matrix("x", (2,)), x)], {x: input_matrix("dx", (2,), like=x)})


@pytest.mark.parametrize(("n", "m"), [(7, 6), (9, 8)])
def test_functions_that_code_has_once_for_many_rows_compute_what_numpy_does(n, m):
    values = {"P": covariance_of(n), "H": RNG.normal(size=(m, n)), "R": covariance_of(m)}
    inputs, offset = [], 0
    for name, value in values.items():
        place, like = Place("rows", offset), inputs[0] if inputs else None
        inputs.append(input_matrix(place, value.shape, symmetric=name != "H", like=like))
        offset += value.size
    p, h, r = inputs
    gain = divide(p @ h.T, sym(h @ p @ h.T) + r)
    stage = Stage({offset: gain, offset + n * m: joseph(p, gain, h, r), offset + n * (m + n): (p @ p) @ h.T}, {})
    (work,) = works_of(stage)
    repeats = work.program[0].works[0].graph.repeats
    assert len(repeats) >= 5 and any(len(repeat.rows) % ROWS for repeat in repeats)
    rows = np.concatenate([*map(np.ravel, values.values()), np.zeros(n * (2 * m + n))])

    def call(rows):
        work(rows, rows, rows)

    Loops(call)(rows)
    P, H, R = values.values()
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    A = np.eye(n) - K @ H
    results = np.split(rows[offset:], [n * m, n * (m + n)])
    for found, expected in zip(results, (K, A @ P @ A.T + K @ R @ K.T, P @ P @ H.T), strict=True):
        np.testing.assert_allclose(found.reshape(expected.shape), expected, rtol=1e-10, atol=1e-12)


def symmetric(size):
    a = RNG.normal(size=(size, size))
    return a + a.T


def called_slope(lower, slope):
    """The slope of a root by functions that are made for its size."""
    size = len(lower)
    of = input_matrix(Place("numbers", 0), lower.shape)
    moves = input_matrix(Place("move", 0), lower.shape, symmetric=True, like=of)
    rows, numbers, move = np.zeros(size**2), lower.ravel(), slope.ravel()
    known = {of: of.operation, moves: moves.operation}
    calls_of([(Place("rows", 0), root_slope(of, moves))], known, {})(rows, np.zeros(1), numbers, move)
    return rows.reshape(size, size)


@pytest.mark.parametrize("size", [1, 3, 8])
def test_the_slope_of_a_root_is_that_of_murray_and_of_central_differences(size):
    p, dp = symmetric(size), symmetric(size)
    p = p @ p + np.eye(size)
    lower = root(p)
    np.testing.assert_allclose(lower, np.linalg.cholesky(p), rtol=1e-13, atol=1e-13)
    inner = solve_triangular(lower, solve_triangular(lower, dp, lower=True).T, lower=True)
    expected = lower @ (np.tril(inner) - 0.5 * np.diag(np.diag(inner)))
    for found in (root_slope(lower, dp), called_slope(lower, dp)):
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    difference = (np.linalg.cholesky(p + 1e-6 * dp) - np.linalg.cholesky(p - 1e-6 * dp)) / 2e-6
    np.testing.assert_allclose(expected, difference, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("slope_of", [root_slope, called_slope])
def test_the_root_of_a_singular_matrix_has_a_slope_within_its_range_only(slope_of):
    b = RNG.normal(size=(4, 4))
    b[2], b[3] = b[0] - 0.3 * b[1], 0.0
    p = b @ b.T
    lower = root(p)
    np.testing.assert_allclose(lower @ lower.T, p, atol=1e-13)
    assert not lower[:, 2:].any()
    np.testing.assert_allclose(slope_of(lower, 3.0 * p), 1.5 * lower, atol=1e-12)
    leaving = slope_of(lower, np.diag([0.0, 0.0, 0.0, 1.0]))
    assert np.isnan(leaving[3, 3]) and np.isfinite(np.delete(leaving, 3, axis=0)).all()


def test_a_matrix_that_is_no_covariance_has_no_root():
    assert np.isnan(root(np.array([[np.nan, 0.0], [0.0, 1.0]]))[0, 0])
    assert root(np.array([[1.0, 2.0], [2.0, 1.0]]))[1, 1] == 0.0  # a pivot below zero counts as rounding


def test_angles_come_to_the_side_of_their_circular_mean():
    y = np.array([[3.0, -3.1, 3.1, 2.9, -2.5], [9.0, 1.0, 2.0, 3.0, 4.0]])
    found = on_circle(y, (True, False))
    np.testing.assert_allclose(found[1], y[1])
    assert np.ptp(found[0]) < 1.0
    np.testing.assert_allclose(np.exp(1j * found[0]), np.exp(1j * y[0]), rtol=1e-13)
    np.testing.assert_allclose(
        found[0] - found[0].mean(), (r := on_one_branch(y.T, (True, False))[:, 0]) - r.mean()
    )
    assert on_circle(y, (False, False)) is y


SIZE = 11


def test_resampling_draws_each_particle_as_often_as_its_weight_says():
    size, rng = 9, np.random.default_rng(4)
    weights = rng.exponential(size=size) ** 3
    weights[[0, 4, 8]] = 0.0
    resample, counts, repeats = systematic_resampler(1, 1, 2), np.zeros(size), 2000
    for u in (np.arange(repeats) + 0.5) / repeats:
        table = np.zeros((5, 16))
        table[0, :size], table[1, :size] = np.arange(size), weights
        resample(table, size, u)
        drawn = table[0, :size].astype(int)
        expected = np.searchsorted(np.cumsum(weights) / weights.sum(), (u + np.arange(size)) / size)
        np.testing.assert_array_equal(drawn, expected)
        assert (table[0, size:] == drawn[0]).all()  # padding follows a real particle
        count = np.bincount(drawn, minlength=size)
        assert (np.abs(count - size * weights / weights.sum()) < 1.0).all()
        counts += count
    # Over all u a particle is drawn N w times; a grid of 2000 of them leaves an error of 1/2000 for each edge.
    np.testing.assert_allclose(counts / repeats, size * weights / weights.sum(), atol=2.0 / repeats)


def test_resampling_of_no_weight_at_all_changes_nothing():
    table = np.zeros((5, 8))
    table[0] = np.arange(8.0)
    for weight in (0.0, np.nan):
        table[1] = weight
        systematic_resampler(1, 1, 2)(table, 6, 0.5)
        np.testing.assert_array_equal(table[0], np.arange(8.0))


def test_the_exponential_is_one():
    x = np.random.default_rng(0).uniform(-45.0, 5.0, size=2000)
    np.testing.assert_allclose([exponential(v) for v in x], np.exp(x), rtol=1e-13)
    assert exponential(0.0) == 1.0
    assert exponential(-math.inf) == exponential(math.nan) == pytest.approx(math.exp(-46.0))


def on_arrays(page, x, log_w):
    """A page's results on NumPy's arrays."""
    return [np.squeeze(one) for one in page(x, log_w)]


def in_memory(page, x, log_w, make):
    """The same in memory whose columns are whole vectors; behind the last particle lies what must not count."""
    n, size = x.shape
    table = np.full((n + 2, 16), 9.0)
    table[n], table[:n, :size], table[n, :size] = log_w[0], x, log_w
    states = input_matrix(Place("table", 0), (n,), member=True)
    results = page(states, input_matrix(Place("table", n), (), member=True, like=states))
    places = [Place("table", n + 1) if one.member else Place("rows", 20 * k) for k, one in enumerate(results)]
    rows, nothing = np.zeros(20 * len(results)), np.zeros(1)
    make(Stage(dict(zip(places, results, strict=True)), {}))(rows, nothing, nothing, table, nothing, size)
    return [
        table[n + 1, :size] if one.member else rows[at : at + math.prod(one.shape)].reshape(one.shape)
        for (_, at), one in zip(places, results, strict=True)
    ]


def as_program(page, x, log_w):
    """The same as a program of all particles."""
    return in_memory(page, x, log_w, lambda stage: of_members(stage, len(x) + 2).work)


def as_functions(page, x, log_w):
    """The same as calls of functions."""
    return in_memory(page, x, log_w, lambda stage: as_calls(stage, 0, {}, {}, OF_MEMBERS).values)


each_way = pytest.mark.parametrize("work", [on_arrays, as_program, as_functions])


@pytest.mark.usefixtures("as_python")
@each_way
def test_weights_are_normalised_and_tell_their_effective_size(work):
    def page(x, log_w):
        w, level = normalised(log_w)
        return w, level, effective_size(w)

    for logarithms in ([-1000.0, -1001.0, -1002.5, -1900.0], [-3.0, -math.inf, math.nan, -2.0]):
        found, total, size = work(page, np.zeros((1, 4)), np.array(logarithms))
        w = np.exp(np.nan_to_num(np.array(logarithms), nan=-math.inf) - max(logarithms[0], logarithms[-1]))
        assert total == pytest.approx(max(logarithms[0], logarithms[-1]) + math.log(w.sum()), rel=1e-14)
        np.testing.assert_allclose(found, w / w.sum(), rtol=1e-12, atol=2e-20)
        assert size == pytest.approx(w.sum() ** 2 / (w**2).sum())
    _, total, _ = work(page, np.zeros((1, 4)), np.full(4, -math.inf))
    assert math.isnan(total)


@pytest.mark.usefixtures("as_python")
@each_way
def test_weighted_moments_are_those_of_their_sums(work):
    def page(x, log_w):
        w = weights(log_w)
        return weighted_mean(x, w), weighted_covariance(x, w), weighted_square(x, w)

    rng = np.random.default_rng(2)
    x, w = rng.normal(size=(2, SIZE)), rng.dirichlet(np.ones(SIZE))
    mean, cov, square = work(page, x, np.log(w))
    d = x - x @ w[:, None]
    np.testing.assert_allclose(mean, x @ w, rtol=1e-12)
    np.testing.assert_allclose(cov, d @ np.diag(w) @ d.T / (1.0 - (w**2).sum()), rtol=1e-12)
    np.testing.assert_allclose(square, x @ np.diag(w) @ x.T, rtol=1e-12)


@pytest.mark.usefixtures("as_python")
@each_way
def test_the_covariance_of_equal_weights_is_the_sample_covariance(work):
    x = np.random.default_rng(2).normal(size=(2, SIZE))
    (found,) = work(lambda x, log_w: (weighted_covariance(x, weights(log_w)),), x, np.full(SIZE, -math.log(SIZE)))
    np.testing.assert_allclose(found, np.cov(x), rtol=1e-12)


@pytest.mark.usefixtures("as_python")
@each_way
def test_the_covariance_of_one_weight_that_is_nearly_all_is_what_the_others_say(work):
    x, small = np.random.default_rng(3).normal(size=(2, SIZE)), 1e-17
    log_w = np.full(SIZE, math.log(small))
    log_w[4] = 0.0
    (found,) = work(lambda x, log_w: (weighted_covariance(x, weights(log_w)),), x, log_w)
    d = np.delete(x - x[:, 4:5], 4, axis=1)
    np.testing.assert_allclose(found, d @ d.T / (2 * (SIZE - 1)), rtol=1e-12)
