"""Arithmetic of traced functions against Python: quotients, rests, conditions, NaN, and slopes at kinks."""

import math

import numpy as np
import pytest

from tests.fuzz.arithmetic import in_machine_code
from thruster_env.core.compiled import fastmath_of
from thruster_env.graphs.branches import along
from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.programs import Place, program_of, values_of
from thruster_env.graphs.tracing import traced

EXPRESSIONS = {
    "rest": lambda x, y: x % 49,
    "rest of a negative divisor": lambda x, y: x % -49.0,
    "rest of tenths": lambda x, y: x % 0.1,
    "rest of both": lambda x, y: x % y,
    "rest of a constant": lambda x, y: 100.0 % y,
    "quotient": lambda x, y: x / 49,
    "floor of a quotient": lambda x, y: math.floor(x / 49) + math.ceil(y / 49.0),
    "floor quotient": lambda x, y: x // 49,
    "floor quotient of tenths": lambda x, y: x // 0.1 + y // -0.1,
    "floor quotient of both": lambda x, y: x // y,
    "divmod": lambda x, y: sum(divmod(x, 7.0)),
    "jump after a sum": lambda x, y: (0.1 * x + 0.7 * y) % 1.0,
    "fmod": lambda x, y: math.fmod(x, 49.0) + np.fmod(x, y),
    "nearest rest": lambda x, y: math.remainder(x, 2.0) + math.remainder(x, y),
    "sum of conditions": lambda x, y: (x > 0.5) + (y > 0.5),
    "gate": lambda x, y: (x > 0) * y - (y >= x) * 2.0,
    "difference of conditions": lambda x, y: -(x > y) + 3 * (x != y),
    "size of a condition": lambda x, y: abs((x > 0.5) * y) + abs(x > 0.5) + float(x > y),
    "condition in max": lambda x, y: max((x > 0.5), y, (x > 1.0) + 1),
    "list of conditions": lambda x, y: sum([x > 0.0, x > 1.0, y > 1.0]) / 3,
    "joined conditions": lambda x, y: ((x > 0.0) & (y > 0.0)) * 2.0 + ((x > 0.0) | (y > 1.0)),
    "condition of a condition": lambda x, y: ((x > 0.0) > 0.5) + ((x > 0.0) == (y > 0.0)) * 2.0,
    "condition alone": lambda x, y: x > y,
    "power of a condition": lambda x, y: (x > 0.0) ** 2 + 2.0 ** (y > 0.0) + math.exp(x > y),
    "chosen conditions": lambda x, y: np.where(x > 0.0, y > 0.0, y) + np.where((x > 0) * y, 1.0, 2.0),
    "logical functions": lambda x, y: np.logical_not(x) * 1.0 + np.logical_and(x > 0, y) * 2.0 + bool(x),
    "sign": lambda x, y: np.sign(x) + 10.0 * np.sign(y),
    "larger": lambda x, y: np.maximum(x, y) + np.minimum(x, 1.0) + np.clip(y, -1.0, 2.0),
    "rounded": lambda x, y: round(x) + np.round(0.5 * y) + np.trunc(x / 3.0) + np.round(x / 7.0, 1),
    "sign taken over": lambda x, y: math.copysign(3.0, x) + np.copysign(y, x),
    "length": lambda x, y: math.hypot(x, y) + math.hypot(x, y, 2.0) + np.hypot(3.0, y),
    "tests": lambda x, y: np.isfinite(x / 3.0) * 1.0 + np.isnan(y) + np.isinf(x),
}
POINTS = [
    *[(49.0 * k, 7.0 * k) for k in (1, 2, 3, 4, 6, 45, 90, 127)],
    *[(0.1 * k, 0.1) for k in (1, 3, 6, 7, 10)],
    *[(-1e-20, 3.0), (1e-20, -3.0), (1.0, 0.1), (-49.0, 49.0), (-3.0, 2.0), (3.0, -2.0), (2.5, 0.5), (0.5, 2.0)],
    *[(7.0, 0.3), (4.0, 0.6), (1e17, 3.0), (5.0, -0.1), (1.0, 1.0), (-2.5, 49.0), (1e200, 1.0), (3e-200, 4e-200)],
]


@pytest.fixture(scope="module")
def numbers():
    graph = Graph()
    given = [graph.given(Place("numbers", k)) for k in range(2)]
    graph.whole |= {one.place for one in given}
    return {name: graph.number(traced(function)(*given)) for name, function in EXPRESSIONS.items()}


def expected(name):
    return np.array([float(EXPRESSIONS[name](*point)) for point in POINTS])


@pytest.mark.parametrize("name", EXPRESSIONS)
def test_a_graph_has_what_python_has(numbers, name):
    found = values_of([numbers[name]], np.array(POINTS).T)[0]
    exact = name not in ("length", "power of a condition", "sum of conditions and lengths")
    np.testing.assert_allclose(found, expected(name), rtol=0.0 if exact else 1e-15)


def test_machine_code_has_what_python_has(numbers):
    found = in_machine_code(list(numbers.values()), np.array(POINTS).T)
    for name, values in zip(numbers, found, strict=True):
        np.testing.assert_allclose(values, expected(name), rtol=1e-15, err_msg=name)


UNDEFINED = {
    "sign": (lambda x, y: np.sign(x), np.nan),
    "larger": (lambda x, y: np.maximum(1.0, x), np.nan),
    "smaller": (lambda x, y: np.minimum(y, x), np.nan),
    "larger number": (lambda x, y: np.fmax(x, 1.0) + np.fmin(1.0, x), 2.0),
    "zero over zero": (lambda x, y: 0.0 / y, np.nan),
    "zero times none": (lambda x, y: 0.0 * math.sqrt(-1.0 - y) + 1.0, np.nan),
    "gate of none": (lambda x, y: (y > 1.0) * np.log(y - 1.0), np.nan),
    "rest": (lambda x, y: 1.0 % y, np.nan),
    "floor quotient": (lambda x, y: np.floor_divide(1.0, y), np.inf),
    "clipped": (lambda x, y: np.clip(x, 0.0, 1.0), np.nan),
}


@pytest.mark.parametrize("name", UNDEFINED)
def test_what_has_no_value_is_what_numpy_has(name):
    function, value = UNDEFINED[name]
    graph = Graph()
    given = [graph.given(Place("numbers", k)) for k in range(2)]
    with np.errstate(all="ignore"):
        found = values_of([graph.number(traced(function)(*given))], np.array([[np.nan], [0.0]]))
    np.testing.assert_array_equal(found, [[value]])


@pytest.mark.parametrize("point", [(7.3, 2.1), (-7.3, 2.1), (7.3, -2.1), (-7.3, -2.1)])
def test_slopes_of_rests_are_those_of_their_branches(point):
    functions = [
        *(lambda x, y: x % y, math.fmod, lambda x, y: x // y, math.remainder),
        *(math.copysign, math.hypot, lambda x, y: (x > y) * x + abs(x > 0.0)),
    ]
    for function in functions:
        found = values_of(slopes_of(function, 1)[1:], np.array(point)[:, None])
        for k, slope in enumerate(found[:, 0]):
            step = 1e-6 * np.eye(2)[k]
            ends = [function(*(np.array(point) + sign * step)) for sign in (1.0, -1.0)]
            assert slope == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-8)


def test_a_users_division_is_none_by_a_reciprocal_and_who_rounds_computes_as_written():
    assert "arcp" in fastmath_of(along) and "arcp" not in fastmath_of(EXPRESSIONS["quotient"])
    assert fastmath_of(EXPRESSIONS["rest"]) == fastmath_of(EXPRESSIONS["floor of a quotient"]) == {"nsz"}


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


def slopes_of(function, times=2):
    """A function of (x, y) as a number, and its slopes along both, at first and again: 1 + 2 + 4 numbers."""
    graph = Graph()
    x, y = graph.given(Place("numbers", 0)), graph.given(Place("numbers", 1))
    found, before = [graph.number(traced(function)(x, y))], 0
    for _ in range(times):
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
    in_order = [graph.number(0.0 if one is None else one) for pair in zip(*slopes, strict=True) for one in pair]
    found = in_machine_code(in_order, np.zeros((2, 1))).reshape(-1, 2)
    np.testing.assert_array_equal(found, [expected for _, expected in AT_ZERO.values()])


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
