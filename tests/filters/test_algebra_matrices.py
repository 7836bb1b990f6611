"""Algebra of matrices: on arrays, as graphs, differentiated, and as calls of functions made for sizes."""

import numpy as np
import pytest
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
    first,
    heavier,
    log_density,
    on_circle,
    ones,
    outer,
    outlier_weight,
    root,
    square,
    tail_of,
    units,
    without_first,
)
from filters.pages.kernels import Stage, works_of
from thruster_env.graphs.graphs import ROWS
from thruster_env.graphs.loops import Loops
from thruster_env.graphs.programs import Place

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
