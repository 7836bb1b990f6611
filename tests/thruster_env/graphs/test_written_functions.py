"""What numba refuses of a model's functions, and what nobody uses, becomes machine code from the graph."""

import logging
import math
import warnings
from collections import namedtuple

import numpy as np
import pytest

from filters import StateSpaceModel
from thruster_env.graphs.branches import on_every_side
from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.python_floats import is_refused, with_python_floats, written_function
from thruster_env.graphs.tracing import traced

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

ODD = of_texts, of_dictionaries, of_matrices, of_imports, of_messages, globals()["of_asserts"]
POINT = (0.7, -1.3), (0.4,), Constants(0.05, 0.2)


@pytest.mark.parametrize("function", ODD, ids=lambda one: one.__name__)
def test_a_graph_stands_in_machine_code_for_what_numba_refuses(function, capsys, caplog):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = written_function(function, "x, u, c", (2, 1, 2), Constants, (2,))
    assert not capsys.readouterr().out and all("<number" not in one.getMessage() for one in caplog.records)
    np.testing.assert_allclose(found(*POINT), plain(*POINT), rtol=1e-14)
    with np.errstate(all="ignore"):
        far = found((2e6, 1.0), (0.0,), POINT[2]), found((0.0, 1.0), (2e6,), POINT[2])
    assert np.isnan(far).all() == (function.__name__ == "of_asserts")


@pytest.mark.filterwarnings("error:the model runs as Python")
def test_a_model_of_such_functions_has_its_graph_in_the_key_of_machine_code():
    noise = {
        "process_noise_cov": [1e-4] * 2,
        "measurement_noise_cov": [0.1],
        "prior_mean": [0, 0],
        "prior_cov": [1, 1],
    }
    model = StateSpaceModel(transition=of_dictionaries, observe=lambda x, c: (x[0],), constants=POINT[2], **noise)
    names = model.functions.transition.__code__.co_freevars
    assert "written" in names and with_python_floats(of_dictionaries) is not model.functions.transition
    np.testing.assert_allclose(model.functions.transition(*POINT), plain(*POINT), rtol=1e-15)


def test_what_numba_takes_stays_as_it_is_and_what_has_no_graph_too():
    assert not is_refused(globals()["of_sizes"])
    assert not is_refused(plain) and written_function(plain, "x, u, c", (2, 1, 2), Constants, (2,)) is None
    assert not is_refused(lambda x, c: [x[0], math.exp(x[1]) if x[1] > 0.0 else "".count("a")])

    def of_digits(x, c):
        return (float(f"{x[0]:.1f}"),)

    def catching(x, c):
        try:
            return (x[0] / GAINS["pull"],)
        except ZeroDivisionError:
            return (0.0,)

    for function in (of_digits, catching):
        assert is_refused(function) and written_function(function, "x, c", (1, 0), 0, (1,)) is None


def test_jacobians_are_written_out_by_rows():
    def slopes(x, c):
        names = {"a": 1.0}
        return ((names["a"], x[1]), (c[0], math.cos(x[0])), (0.0, 2.0))

    found = written_function(slopes, "x, c", (2, 1), 1, (3, 2))
    assert found((0.5, 3.0), (7.0,)) == ((1.0, 3.0), (7.0, math.cos(0.5)), (0.0, 2.0))


def test_what_fails_otherwise_than_by_a_raise_of_its_own_has_no_outcome():
    def calling(x):
        if x[0] > 0.0:
            return (float(int("one")),)
        return (x[0],)

    graph = Graph()
    x = (graph.given("x"),)
    with pytest.raises(ValueError, match="invalid literal"):
        on_every_side(lambda: np.array([*traced(calling)(x)], dtype=object), graph)
