"""Graphs of numbers: what is folded, what is traced, their derivatives, and the programs that they become."""

import math
import os
import subprocess
import sys

import numpy as np
import pytest

from thruster_env.graphs.branches import along
from thruster_env.graphs.graphs import Graph, TooLarge, where
from thruster_env.graphs.loops import Loops
from thruster_env.graphs.programs import Place, callable_of, program_of, values_of
from thruster_env.graphs.tracing import traced

FUNCTIONS = {
    "operators": lambda x, y: (x + 2.0) * y - x / y + 3.0 / x - (-x) * (1 - y),
    "powers": lambda x, y: x**2 + y**-3 + x**0.5 + y**-0.5 + x**2.5 + 2.0**y + (x * y) ** y + x**0,
    "math": lambda x, y: math.sin(x) * math.cos(y) + math.exp(-x) * math.log(y) + math.atan(x) + math.tanh(y),
    "numpy": lambda x, y: np.sin(x) + np.sqrt(y) * np.tan(x) + np.sinh(y) + np.cosh(x) + np.hypot(x, y),
    "decisions": lambda x, y: max(x, y, 1.0) + min([x, 0.7]) + abs(x - y) + np.where(x > y, x, y * y),
    "angles": lambda x, y: math.atan2(x - 1.0, y - 2.0) + np.arctan2(0.3, y) * math.atan2(1.0, -2.0),
    "remainders": lambda x, y: x % 0.7 + (10.0 * y) % 1.0 + x // 0.3,
}
POINTS = [(0.35, 1.73), (1.13, 0.44), (2.63, 2.25)]


def pair():
    graph = Graph()
    return graph.given(Place("numbers", 0)), graph.given(Place("numbers", 1))


@pytest.mark.parametrize("name", FUNCTIONS)
def test_a_traced_function_is_the_function_and_its_slope_the_derivative(name):
    function, (x, y) = FUNCTIONS[name], pair()
    z = traced(function)(x, y)
    slopes = along([z], {x.place: x.graph.constant(1.0)}) + along([z], {y.place: x.graph.constant(1.0)})
    for point in POINTS:
        found = values_of([z, *slopes], np.array(point)[:, None])[:, 0]
        assert found[0] == pytest.approx(function(*point), rel=1e-14)
        for k, slope in enumerate(found[1:]):
            at = [np.array(point) + step * np.eye(2)[k] for step in (1e-3, -1e-3, 2e-3, -2e-3)]
            a, b, c, d = (function(*one) for one in at)
            assert slope == pytest.approx((8 * (a - b) - (c - d)) / 12e-3, rel=1e-8)


@pytest.mark.parametrize("name", FUNCTIONS)
@pytest.mark.parametrize("width", [1, 4])
def test_instructions_are_what_the_program_says(name, width):
    x, y = pair()
    stores = [(Place("rows", 1), traced(FUNCTIONS[name])(x, y)), (Place("change", 0), x * y)]
    work = callable_of(program_of(stores, {x.place: Place("rows", 0)}), width)
    rows, numbers = np.linspace(0.4, 2.5, 2 * width), np.array([math.nan, 0.9])
    found = [[rows.copy(), np.zeros(width)] for _ in range(2)]
    work(*found[0], numbers, numbers)

    def call(rows, change, numbers):
        work(rows, change, numbers, numbers)

    Loops(call)(*found[1], numbers)
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-14)
    np.testing.assert_allclose(found[0][1], rows[:width] * 0.9)


def test_what_is_equal_is_there_once_and_structure_vanishes():
    x, y = pair()
    assert x * y is y * x and x + y is y + x and (x - y) is -(y - x)
    assert 0.0 * x + 1.0 * y is y and (-x) * (-y) is x * y and x + -y is x - y
    assert (x / y).operation == "*" and (x / y).arguments[1] is 1.0 / y
    assert (x * 2.0 * 0.0).value == 0.0 and (abs(x * 0.0 - 2.0) ** 0.5).value == 2.0**0.5
    assert where(x < y, x, x) is x and along([x * x], {y.place: x}) == [None]


def test_what_moves_of_itself_moves_with_nothing_that_it_is_made_of():
    x, y = pair()
    z = x * y
    assert along([z * x], {z.place: y, x.place: None}) == [y * x]
    assert along([z], {x.place: y, z.place: None}) == [None]


UNTRACEABLE = {
    "if": lambda x, y: x if x > y else y,
    "while": lambda x, y: next(k for k in range(3) if k > x),
    "table": lambda x, y: [1.0, 2.0][x],
    "dictionary": lambda x, y: {}.get(x, y),
    "int": lambda x, y: int(x) * y,
    "array of integers": lambda x, y: np.array([x, y], dtype=int).sum(),
    "equality": lambda x, y: 1.0 if (x, y) == (1.0, 2.0) else 2.0,
    "library": lambda x, y: math.gamma(x),
    "linear algebra": lambda x, y: np.linalg.eigvals([[x, y], [y, x]])[0],
    "a table out of order, of which NumPy promises nothing": lambda x, y: np.interp(
        x, [0.0, 2.0, 1.0], [x, y, 2.0]
    ),
    "a large determinant": lambda x, y: np.linalg.det(np.eye(5) * x),
    "a norm of sums": lambda x, y: np.linalg.norm([x, y], 1),
    "bits of a number": lambda x, y: ~x,
    "a bit and a number": lambda x, y: (x > 0.0) ^ y,
    "and of a number": lambda x, y: x & (x > 0.0),
    "or of a number": lambda x, y: (x > 0.0) | 1.0,
    "decimals": lambda x, y: round(x, 2),
}


@pytest.mark.parametrize("name", UNTRACEABLE)
def test_a_function_that_decides_cannot_be_traced(name):
    with pytest.raises(TypeError):
        traced(UNTRACEABLE[name])(*pair())


def helper(x, *, factor=2.0):
    return factor * math.sqrt(x)


def test_functions_that_are_called_are_traced_too_and_arrays_may_be_filled():
    offset = 0.5

    def nested(x, power=3):
        return x**power + offset

    def function(x, y):
        out = np.zeros((2, 2))
        for i in range(2):
            out[i, i] = helper(x, factor=1.0 + i)
        return (out @ np.array([x, y])).sum() + sum(nested(one) for one in (x, y))

    x, y = pair()
    assert values_of([traced(function)(x, y)], np.array([[1.3], [0.6]]))[0, 0] == pytest.approx(function(1.3, 0.6))
    assert helper(4.0) == 4.0  # the function itself is as before


def test_a_graph_that_grows_too_large_is_given_up():
    x = Graph(most=20).given("x")
    with pytest.raises(TooLarge, match="at most 20 operations"):
        sum(math.prod([x + k] * k) for k in range(10))


def test_a_number_has_neither_truth_nor_hash():
    x, _ = pair()
    for ask in (bool, hash, float):
        with pytest.raises(TypeError):
            ask(x)


RUN = """
import numpy as np
import filters
from thruster_env.thruster.model import thruster_model
ekf = filters.make_filter("ekf", thruster_model())
filters.run(ekf, inputs=np.zeros((8, 3, 1)), measurements=np.zeros((8, 4, 1)))
"""


def test_programs_have_the_same_digests_in_each_process(tmp_path):
    digests = []
    for seed in ("1", "2"):
        folder = tmp_path / seed
        for_another_hash = {**os.environ, "PYTHONHASHSEED": seed, "NUMBA_CACHE_DIR": str(folder)}
        subprocess.run([sys.executable, "-c", RUN], env=for_another_hash, check=True)
        digests.append(sorted(path.name for path in folder.rglob("*.o")))
    assert digests[0] == digests[1] != []
