"""Functions that decide: traced on all sides, they are what Python computes, and so are their slopes."""

import math

import numpy as np
import pytest

from thruster_env.graphs.branches import MOST_OUTCOMES, along, on_every_side
from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.programs import Place, values_of
from thruster_env.graphs.tracing import traced


def drag(x, y):
    if x >= 0.0:
        return x * x, y
    return -x * x, 2.0 * y


def nested(x, y):
    if x > 1.0 and y > 0.0 or x < -1.0:
        found = x * y
    elif not y < 0.5:
        found = math.sqrt(y) if y > 0.0 else 0.0
    else:
        found = -x if x < y else y
    return found, (x if found > 0.3 else 1.0)


def in_loop(x, y):
    """Newton's method, which ends early."""
    root = 1.0
    for _ in range(8):
        step = (root * root - 2.0 - x * x) / (2.0 * root)
        if abs(step) < 1e-3:
            break
        root -= step
    return root, y


def of_truth(x, y):
    found = 1.0 if x - 0.5 else 3.0
    return found * y, sorted([x, y])[0]


def dead_zone(x, y):
    return np.clip(x, -0.5, 0.5), (0.0 if -0.2 < y < 0.2 else y)


def of_floats(x, y):
    out = np.array([x, y], dtype=float)
    out[:1] += np.asarray([y * y], np.float64)
    gain = np.linalg.inv(np.array([[2.0, 0.0], [0.0, 4.0]], dtype="float64"))
    return gain @ out + (out > 0.3).astype(float) * (float(x) if isinstance(1.0, float) else 0.0)


FUNCTIONS = [drag, nested, in_loop, of_truth, dead_zone, of_floats]


class Wind:
    """What a helper returns."""

    def __init__(self, speed, names):
        self.speed, self.names = speed, names


def wind_at(x):
    if x > 0.5:
        return {"wind": Wind([x, -x], "strong")}
    return {"wind": Wind([0.0, x * x], "strong")}


def saturated(x):
    return 1.0 if x > 1.0 else -1.0 if x < -1.0 else x


def extend(values, y):
    values.append(y if y > 0.0 else -2.0 * y)


def of_helpers(x, y):
    """Eight helpers that decide have more outcomes together than are traced, and 22 one by one."""
    total = sum(saturated(k * x - y) for k in range(8))
    first, second = wind_at(x)["wind"].speed
    return total + first, second + saturated(y)


def of_changes(x, y):
    """A helper that decides and changes its argument is traced with the function that calls it."""
    parts = [x]
    extend(parts, y)
    return sum(parts), parts[1]


FUNCTIONS += [of_helpers, of_changes]


def test_helpers_are_joined_one_by_one_unless_they_change_what_they_get():
    for function, by_function in ((of_helpers, True), (of_changes, False)):
        graph = Graph()
        x, y = graph.given("x"), graph.given("y")
        with pytest.raises(TypeError, match="outcomes" if by_function else "change its arguments"):
            on_every_side(lambda: np.array(traced(function, not by_function)(x, y), dtype=object), graph)  # noqa: B023


def test_decisions_within_decisions_end(monkeypatch):
    monkeypatch.setattr("thruster_env.graphs.branches.MOST_IN_ALL", 10)
    with pytest.raises(TypeError, match="at most 64 outcomes"):
        graph_of(of_helpers)


def graph_of(function):
    graph = Graph()
    x, y = graph.given(Place("numbers", 0)), graph.given(Place("numbers", 1))
    copy = traced(function, by_function=function is not of_changes)
    found = on_every_side(lambda: np.array(copy(x, y), dtype=object), graph)
    return [graph.number(one) for one in found], (x, y)


@pytest.mark.parametrize("function", FUNCTIONS)
def test_all_sides_are_those_of_python_and_so_are_their_slopes(function):
    numbers, axes = graph_of(function)
    slopes = [one for axis in axes for one in along(numbers, {axis.place: axis.graph.constant(1.0)})]
    slopes = [numbers[0].graph.constant(0.0) if one is None else one for one in slopes]
    points = np.random.default_rng(1).uniform(-2.0, 2.0, size=(60, 2))
    with np.errstate(invalid="ignore"):
        found = values_of([*numbers, *slopes], points.T).T
    for point, (*values, by_x, also_by_x, by_y, also_by_y) in zip(points, found, strict=True):
        np.testing.assert_allclose(values, function(*point.tolist()), rtol=1e-14)
        for axis, expected in ((0, (by_x, also_by_x)), (1, (by_y, also_by_y))):
            sides = [np.array(function(*(point + h * np.eye(2)[axis]))) for h in (1e-6, -1e-6)]
            np.testing.assert_allclose(expected, (sides[0] - sides[1]) / 2e-6, atol=1e-6)


def endless(x, y):
    while x > 1.0:
        x = x - 1.0
    return x, y


def many(x, y):
    total = 0.0
    for k in range(8):
        total += x if x + y > 0.1 * k * k else y * k
        total += y if x - y > 0.1 * k * k else x * k
    return total, x


def ragged(x, y):
    return (x, y) if x > 0.0 else (x,)


@pytest.mark.parametrize(("function", "message"), [(endless, "at most"), (many, "at most"), (ragged, "one shape")])
def test_what_decides_too_often_is_not_traced(function, message):
    with pytest.raises(TypeError, match=message):
        graph_of(function)


@pytest.mark.parametrize("decisions", [6, 7])
def test_there_is_one_call_for_each_outcome(decisions):
    graph, calls = Graph(), []
    x = graph.given("x")

    def counted():
        calls.append(None)
        return np.array([sum(1.0 if x > k else 0.0 for k in range(decisions))], dtype=object)

    if 2**decisions > MOST_OUTCOMES:
        with pytest.raises(TypeError, match="outcomes"):
            on_every_side(counted, graph)
    else:
        on_every_side(counted, graph)
    assert len(calls) == MOST_OUTCOMES and graph.decide is None
