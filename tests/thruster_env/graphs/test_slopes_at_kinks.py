"""Slopes where a root is zero or an exponential infinite: limits where there are any, and finite as the values."""

import math

import numpy as np
import pytest

from thruster_env.graphs.branches import along
from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.loops import Loops
from thruster_env.graphs.programs import Place, callable_of, program_of, values_of
from thruster_env.graphs.tracing import traced

AT_ZERO = {
    "drag by a root": (lambda x, y: math.sqrt(x * x) * x, (0.0, 0.0)),
    "drag in a plane": (lambda x, y: np.hypot(x, y) * x, (0.0, 0.0)),
    "speed": (lambda x, y: math.sqrt(x * x + y * y), (0.0, 0.0)),
    "speed as a power": (lambda x, y: (x * x + y * y) ** 0.5, (0.0, 0.0)),
    "tank": (lambda x, y: math.sqrt(max(x, 0.0)) + y, (0.0, 1.0)),
    "a power": (lambda x, y: abs(x) ** 1.5 + y, (0.0, 1.0)),
    "an exponent that moves": (lambda x, y: abs(x) ** (y + 1.7), (0.0, 0.0)),
    "a small one": (lambda x, y: abs(x) ** (y + 0.5), (0.0, 0.0)),
    "exponent one": (lambda x, y: x ** (y + 1.0), (1.0, 0.0)),
    "bearing": (lambda x, y: math.atan2(y, x), (0.0, 0.0)),
    "saturation": (lambda x, y: x / (1.0 + math.sqrt(abs(x))) - y, (1.0, -1.0)),
    "signed root": (lambda x, y: np.sign(x) * math.sqrt(abs(x)), (0.0, 0.0)),
    "circle": (lambda x, y: math.sqrt(1.0 - (1.0 + x) ** 2) + y, (0.0, 1.0)),
    "logistic": (lambda x, y: 1.0 / (1.0 + math.exp(900.0 - x)) + 3.0 * y, (0.0, 3.0)),
    "nested exponentials": (lambda x, y: math.exp(-math.exp(900.0 + x)) + y, (0.0, 1.0)),
    "hyperbolic tangent": (lambda x, y: math.tanh(math.exp(900.0 + x)) + y, (0.0, 1.0)),
    "angle": (lambda x, y: math.atan(math.cosh(900.0 + x)) + y, (0.0, 1.0)),
    "elevation at the zenith": (lambda x, y: math.asin(1.0 - abs(x)) + math.acos(1.0 - abs(y)), (0.0, 0.0)),
    "power by logarithm": (lambda x, y: math.exp(1.5 * math.log(abs(x))) + y, (0.0, 1.0)),
}


def slopes_of(function):
    """A function of (x, y) as a number, and its slopes along both, at first and again: 1 + 2 + 4 numbers."""
    graph = Graph()
    x, y = graph.given(Place("numbers", 0)), graph.given(Place("numbers", 1))
    found, before = [graph.number(traced(function)(x, y))], 0
    for _ in range(2):
        level, before = found[before:], len(found)
        for one in level:
            for axis in (x, y):
                (slope,) = along([one], {axis.place: graph.constant(1.0)})
                found.append(graph.constant(0.0) if slope is None else slope)
    return found


@pytest.mark.parametrize("name", AT_ZERO)
def test_a_slope_at_a_kink_is_a_limit_and_finite(name):
    function, expected = AT_ZERO[name]
    numbers = slopes_of(function)
    with np.errstate(all="ignore"):
        found = values_of(numbers, np.zeros((2, 1)))[:, 0]
    assert np.isfinite(found).all()
    np.testing.assert_array_equal(found[1:3], expected)


def test_machine_code_has_them_too():
    graph = Graph()
    x, y = graph.given(Place("numbers", 0)), graph.given(Place("numbers", 1))
    values = [graph.number(traced(function)(x, y)) for function, _ in AT_ZERO.values()]
    slopes = [along(values, {axis.place: graph.constant(1.0)}) for axis in (x, y)]
    in_order = [0.0 if one is None else one for pair in zip(*slopes, strict=True) for one in pair]
    stores = [(Place("rows", k), graph.number(one)) for k, one in enumerate(in_order)]
    work, rows = callable_of(program_of(stores, {}), 1), np.full(2 * len(AT_ZERO), math.nan)

    def call(rows, numbers):
        work(rows, rows, numbers, numbers)

    Loops(call)(rows, np.zeros(2))
    np.testing.assert_array_equal(rows.reshape(-1, 2), [expected for _, expected in AT_ZERO.values()])


def test_a_root_that_is_never_zero_needs_no_choice():
    for function in (lambda x, y: math.sqrt(x * x + y * y + 0.1), lambda x, y: 1.0 / math.sqrt(1.0 + abs(x))):
        stores = [(Place("rows", k), one) for k, one in enumerate(slopes_of(function)[:3])]
        assert "==" not in "".join(program_of(stores, {}).text)


def test_powers_of_negative_numbers_have_a_slope_along_the_exponent():
    numbers = slopes_of(lambda x, y: x ** (y + 2.0))
    found = values_of(numbers, np.array([[-2.0], [0.0]]))[:3, 0]
    np.testing.assert_allclose(found, [4.0, -4.0, 4.0 * math.log(2.0)])


def test_arcs_are_those_of_python_with_their_slopes():
    numbers = slopes_of(lambda x, y: math.asin(x) + 3.0 * np.arccos(y))[:3]
    points = np.linspace(-0.999, 0.999, 41) * np.array([[1.0], [-0.9]])
    (value, by_x, by_y), (x, y) = values_of(numbers, points), points
    np.testing.assert_allclose(value, np.arcsin(x) + 3.0 * np.arccos(y), rtol=1e-15, atol=1e-15)
    np.testing.assert_allclose([by_x, by_y], [1.0 / np.sqrt(1.0 - x * x), -3.0 / np.sqrt(1.0 - y * y)], rtol=1e-12)
