"""Machine code of a model's functions: from their graphs, by numba, or none, with the reason."""

import logging
import math
import re
import warnings
from collections import namedtuple

import numpy as np
import pytest

import filters
from tests.models import state_space
from thruster_env.graphs.branches import on_every_side
from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.loops import Loops
from thruster_env.graphs.tracing import traced
from thruster_env.model.simulate import seconds_as_python
from thruster_env.model.traced import TABLES, _machine_code, called_function

GAINS = {"pull": 0.3, "names": ("a", "b")}
LOGGER = logging.getLogger(__name__)
Constants = namedtuple("Constants", ["dt", "drag"])


def plain(x, u, c):
    """A docstring, a tuple, a list of numbers: all of that numba takes."""
    names, steps = ("a", "b"), [c.dt, 2.0 * c.dt]  # noqa: F841 - of no use
    return [x[0] + steps[0] * x[1], x[1] - steps[0] * (0.3 * math.sin(x[0]) + c.drag * x[1] * abs(x[1])) + u[0]]


def of_texts(x, u, c):
    names = ["a", "b"]
    label = f"{names[0]} of {x[0]:.3f}"  # noqa: F841 - of no use
    return plain(x, u, c)


def of_dictionaries(x, u, c):
    values = dict(zip(["a", "b"], x, strict=True)) | {"none": [1, "two", 3.0]}
    return (
        values["a"] + c.dt * values["b"],
        x[1] - c.dt * (GAINS["pull"] * math.sin(x[0]) + c.drag * x[1] * abs(x[1])) + u[0],
    )


def of_matrices(x, u, c):
    matrix = [[1, c.dt], [0, 1]]
    pull = np.array([[0.0], [0.3]])
    return (
        matrix[0][0] * x[0] + matrix[0][1] * x[1],
        matrix[1][1] * x[1] - c.dt * (pull[1, 0] * math.sin(x[0]) + c.drag * x[1] * abs(x[1])) + u[0],
    )


def of_imports(x, u, c):
    import math as m

    from numpy import abs as size

    return (x[0] + c.dt * x[1], x[1] - c.dt * (0.3 * m.sin(x[0]) + c.drag * x[1] * size(x[1])) + u[0])


def of_messages(x, u, c):
    LOGGER.warning("at %s", x)
    if x[0] > 1e6:
        print(f"far away: {x[0]:.1f}")
        warnings.warn("far away", stacklevel=1)
    return plain(x, u, c)


WITH_ASSERTS = """
def of_asserts(x, u, c):
    assert x[0] < 1e6, f"x must be below 1e6, but got {x[0]:.1f}"
    if u[0] > 1e6:
        raise ValueError(f"u must be at most 1e6, but got {u[0]}")
    return plain(x, u, c)

def of_sizes(x, u, c):
    assert len(x) == 2, "x must have two states"
    return plain(x, u, c)
"""  # as text, because pytest writes its own code in place of asserts
exec(WITH_ASSERTS)

ODD = plain, of_texts, of_dictionaries, of_matrices, of_imports, of_messages, globals()["of_asserts"]
POINT = (0.7, -1.3), (0.4,), Constants(0.05, 0.2)


def machine_code(function, arguments="x, u, c", sizes=(2, 1, 2), form=Constants, shape=(2,)):
    """What compiled functions have in place of a function."""
    return _machine_code(function, arguments, sizes, form, shape)


@pytest.mark.parametrize("function", ODD, ids=lambda one: one.__name__)
def test_a_graph_stands_in_machine_code_for_a_function(function, capsys, caplog):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = machine_code(function)
    assert not capsys.readouterr().out and all("<number" not in one.getMessage() for one in caplog.records)
    assert found.function.__globals__["evaluate"] and not found.reason
    np.testing.assert_allclose(found.function(*POINT), plain(*POINT), rtol=1e-14)
    with np.errstate(all="ignore"):
        far = found.function((2e6, 1.0), (0.0,), POINT[2]), found.function((0.0, 1.0), (2e6,), POINT[2])
    assert np.isnan(far).all() == (function.__name__ == "of_asserts")


@pytest.mark.parametrize("sizes", [(2, 2), (2, 40)])
def test_machine_code_takes_and_returns_tuples_and_arrays(sizes):
    n, count = sizes

    def vector(x, c):
        return [c[1] * x[0] + math.sin(i * x[1]) for i in range(count)]

    def matrix(x, c):
        return [[x[0] * i + c[0] * j * x[1] for j in range(n)] for i in range(count)]

    of_vector = called_function(vector, "x, c", (n, 2), 2, (count,))
    of_matrix = called_function(matrix, "x, c", (n, 2), 2, (count, n))

    def both(out, rows, x, y):
        for i in range(count):
            out[i] = of_vector((x, y), (1, 2.0))[i]
            for j in range(n):
                rows[i, j] = of_matrix((x, y), (1, 2.0))[i][j]

    out, rows = np.empty(count), np.empty((count, n))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        Loops(both)(out, rows, 0.5, 0.25)
    np.testing.assert_allclose(out, vector((0.5, 0.25), (1.0, 2.0)), rtol=1e-14)
    np.testing.assert_allclose(rows, matrix((0.5, 0.25), (1.0, 2.0)), rtol=1e-14)
    np.testing.assert_allclose(of_matrix((0.5, 0.25), (1.0, 2.0)), rows, rtol=1e-14)


def newton(x, c):
    """A root by a loop that depends on it: what numba takes and nobody traces."""
    y = 1.0 + x[0] * x[0]
    while abs(y * y - x[0] * x[0] - 1.0) > 1e-9:
        y = 0.5 * (y + (x[0] * x[0] + 1.0) / y)
    return (y,)


def of_digits(x, c):
    return (float(f"{x[0]:.1f}"),)


def catching(x, c):
    try:
        return (x[0] / GAINS["pull"],)
    except ZeroDivisionError:
        return (0.0,)


@pytest.mark.parametrize(
    ("function", "words", "runs"),
    [
        (
            newton,
            r"newton \(test_called.py, line \d+\) cannot be traced, .*decide.*: loop a fixed number of",
            True,
        ),
        (
            of_digits,
            r"of_digits \(test_called.py, line \d+\) cannot be traced, .*digits.*: use .*; numba refuses it",
            False,
        ),
        (catching, r"catching \(test_called.py, line \d+\) cannot be traced, .*: ask before, by an if", False),
    ],
)
def test_what_is_not_traced_is_said_with_its_line_and_what_would_be(function, words, runs):
    found = machine_code(function, "x, c", (1, 0), 0, (1,))
    assert re.search(words, found.reason)
    assert (found.function is not None) == runs


def test_the_line_is_that_of_the_helper_which_fails():
    def helper(x):
        y = 2.0 * x
        return GAINS[y]

    reason = machine_code(lambda x, c: (helper(x[0]),), "x, c", (1, 0), 0, (1,)).reason
    assert reason.startswith(
        f"helper (test_called.py, line {helper.__code__.co_firstlineno + 2}) cannot be traced"
    )
    assert TABLES in reason


def model_of(transition):
    return state_space(transition, lambda x, c: (x[0],), q=[0.1], r=[0.1], mean=[1.0], cov=[0.1], inputs=1)


def test_the_time_of_python_is_that_of_models_which_are_no_machine_code():
    assert seconds_as_python(model_of(lambda x, u, c: (math.sin(x[0]),))) == 0.0
    assert seconds_as_python(model_of(lambda x, u, c: newton(x, c))) == 0.0
    with pytest.warns(UserWarning, match=r"runs as Python, .* catching catches exceptions"):
        assert 0.0 < seconds_as_python(model_of(lambda x, u, c: catching(x, c))) < 0.1


def test_what_fails_otherwise_than_by_a_raise_of_its_own_has_no_outcome():
    def calling(x):
        if x[0] > 0.0:
            return (float(int("one")),)
        return (x[0],)

    graph = Graph()
    x = (graph.given("x"),)
    with pytest.raises(ValueError, match="invalid literal"):
        on_every_side(lambda: np.array([*traced(calling)(x)], dtype=object), graph)


SQUARES = np.arange(16.0) ** 2


def of_a_table(x, u, c):
    """What numba compiles: an array of the file, at an index."""
    return (0.9 * x[0] + 0.01 * SQUARES[int(abs(x[0]))],)


def test_a_table_ends_where_python_says_so():
    """Beyond its end numba would read other memory, or end the process; the filter restarts, and says why."""
    filter_ = filters.ExtendedKalmanFilter(model=model_of(of_a_table))
    z, u = np.ones((1, 5, 1)), np.zeros((1, 4, 1))
    for outlier in (40.0, 1e12):
        z[0, 1] = outlier
        with pytest.warns(filters.RestartWarning, match=r"first at step 2 \(x_1\): f\(x, u\) is NaN"):
            estimates = filters.run(filter_, inputs=u, measurements=z)
        assert estimates.divergences == 1 and np.isfinite(estimates.means).all()


def never_so_low(x, u, c):
    if x[0] < -5.0:
        raise LookupError("so low")
    return (x[0] * c[0],)


def test_a_function_is_traced_though_it_raises_at_a_point_of_the_check():
    assert not machine_code(never_so_low, "x, u, c", (1, 1, 1), 1, (1,)).reason


def counted(x, u, c):
    n = 0
    while n < abs(x[0]):
        n += 1
    return (n // 2,)


def test_a_function_of_whole_numbers_is_machine_code():
    filter_ = filters.ExtendedKalmanFilter(model=model_of(counted))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        belief = filter_.predict(filter_.init()._replace(mean=np.array([6.5])), [0.0])
    assert belief.mean == 3.0
