"""Functions of `math` and NumPy on graphs: the values of Python, and exact slopes, on all paths."""

import math
import shutil
import warnings

import numpy as np
import pytest

from tests.fuzz.arithmetic import in_c, in_machine_code
from tests.thruster_env.graphs.test_traced_arithmetic import slopes_of
from thruster_env.graphs.branches import along
from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.programs import Place, program_of, values_of
from thruster_env.graphs.tracing import traced

TABLE, VALUES = [-1.0, 0.0, 0.5, 2.0], [1.0, -2.0, 0.3, 4.0]
FUNCTIONS = {
    "cbrt": lambda x, y: np.cbrt(x) + math.cbrt(y),
    "logarithms": lambda x, y: math.log2(3.0 + x) + np.log10(3.0 + y) + math.log1p(0.3 * x) - np.log2(4.0 - y),
    "exponentials": lambda x, y: np.exp2(x) * math.expm1(y) + math.exp2(x * y),
    "inverse hyperbolic": lambda x, y: np.arcsinh(x) + math.acosh(3.0 + y) + math.atanh(0.1 * x * y),
    "error function": lambda x, y: math.erf(x) * math.erfc(y),
    "logaddexp": lambda x, y: np.logaddexp(x, 2.0 * y),
    "interp": lambda x, y: np.interp(x, TABLE, VALUES) + np.interp(y, TABLE, VALUES, left=9.0, right=-9.0),
    "interp of moving values": lambda x, y: np.interp(x, [-1.0, 2.0], [y, x * y]),
    "polyval": lambda x, y: np.polyval([0.5, y, -1.0], x),
    "spread": lambda x, y: np.std([x, y, 2.0]) + np.var([x, 3.0 * y], ddof=1),
    "spread of columns": lambda x, y: np.std(np.array([[x, y], [y, 1.0]]), axis=0).sum(),
    "select": lambda x, y: np.select([x > 1.0, x > y], [x * y, y], default=-x),
    "det": lambda x, y: np.linalg.det([[3.0 + x, y, 1.0], [0.0, 2.0 + y, x], [1.0, 0.5, 4.0]]),
    "solve": lambda x, y: np.linalg.solve(np.array([[4.0 + x, y], [0.3, 3.0 + y]]), [x, 1.0])[0],
    "inv": lambda x, y: np.linalg.inv([[5.0, x, 0.0], [y, 6.0, 1.0], [0.1, 0.2, 4.0]])[1, 0],
    "norm": lambda x, y: np.linalg.norm([x, y, 0.5]),
    "bits": lambda x, y: (
        ((x > 0.3) ^ (y > 0.3)) + 2.0 * ((x > y) ^ True) + 4.0 * ((x > 0.0) & (y > 0.0) | (x > 1.0))
    ),
    "contrary": lambda x, y: float(np.where(~(np.float64(x) > y), x, y)),
}
POINTS = np.array([[0.37, -1.3, 1.7, 2.2, -0.41], [0.61, 0.23, -0.9, 1.9, 3.1]])


def graph_of():
    """Numbers of all functions, and their slopes by x and y."""
    graph = Graph()
    given = [graph.given(Place("numbers", k)) for k in range(2)]
    graph.whole |= {one.place for one in given}
    values = [graph.number(traced(one)(*given)) for one in FUNCTIONS.values()]
    slopes = [along(values, {one.place: graph.constant(1.0)}) for one in given]
    return values, [[graph.number(0.0 if one is None else one) for one in part] for part in slopes]


def expected(points):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of ~ of a truth value
        return np.array([[float(one(*point)) for point in points.T.tolist()] for one in FUNCTIONS.values()])


def test_values_and_slopes_are_those_of_python():
    values, slopes = graph_of()
    np.testing.assert_allclose(values_of(values, POINTS), expected(POINTS), rtol=1e-13, atol=1e-13)
    for k in range(2):
        h = 1e-5 * np.eye(2)[:, k : k + 1]
        differences = (expected(POINTS + h) - expected(POINTS - h)) / 2e-5
        np.testing.assert_allclose(values_of(slopes[k], POINTS), differences, rtol=1e-7, atol=1e-8)


def test_tensors_have_the_same_values_and_slopes():
    torch = pytest.importorskip("torch")
    from filters.tensors.graphs import values_of as tensors_of
    from thruster_env.graphs.graphs import needed_by

    values, slopes = graph_of()
    given = {Place("numbers", k): torch.tensor(row, requires_grad=True) for k, row in enumerate(POINTS)}
    like = torch.tensor(0.0, dtype=torch.float64)
    found = [torch.as_tensor(one).expand(5).double() for one in tensors_of(values, needed_by(values), given, like)]
    np.testing.assert_allclose(torch.stack(found).detach(), values_of(values, POINTS), rtol=1e-13, atol=1e-13)
    for i, one in enumerate(found):
        if one.requires_grad:
            by = torch.autograd.grad(one.sum(), [*given.values()], retain_graph=True, allow_unused=True)
            for k, part in enumerate(by):
                part = torch.zeros(5) if part is None else part
                np.testing.assert_allclose(part, values_of([slopes[k][i]], POINTS)[0], rtol=1e-12, atol=1e-12)


def test_machine_code_and_c_have_the_same_values():
    values, slopes = graph_of()
    numbers = [*values, *slopes[0], *slopes[1]]
    program = program_of([(Place("rows", k), one) for k, one in enumerate(numbers)], {})
    known = values_of(numbers, POINTS)
    np.testing.assert_allclose(in_machine_code(numbers, POINTS), known, rtol=1e-12, atol=1e-12)
    if shutil.which("gcc"):
        np.testing.assert_allclose(in_c(program, POINTS, single=False), known, rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(in_c(program, POINTS, single=True), known, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize(
    ("function", "point", "slopes"),
    [
        (lambda x, y: np.cbrt(x * y), (0.0, 1.0), (0.0, 0.0)),
        (lambda x, y: np.arccosh(x), (1.0, 0.0), (0.0, 0.0)),
        (lambda x, y: np.logaddexp(x, y), (1.5, 1.5), (0.5, 0.5)),
        (lambda x, y: np.std([x, y]), (1.5, 1.5), (0.0, 0.0)),
        (lambda x, y: np.linalg.norm([x, y]), (0.0, 0.0), (0.0, 0.0)),
        (lambda x, y: np.interp(x, TABLE, VALUES), (0.0, 0.0), (4.6, 0.0)),  # of the line to the right
        (lambda x, y: np.interp(x, TABLE, VALUES), (2.0, 0.0), (0.0, 0.0)),
        (lambda x, y: math.erf(x) + math.exp2(y), (math.inf, -math.inf), (0.0, 0.0)),
    ],
)
def test_slopes_at_kinks_are_finite(function, point, slopes):
    with np.errstate(all="ignore"):
        found = values_of(slopes_of(function, 1)[1:], np.array(point)[:, None])[:, 0]
    np.testing.assert_allclose(found, slopes, atol=1e-15)


def test_ends_are_those_of_numpy():
    def both(x, y):
        return np.interp(x, TABLE, VALUES), np.logaddexp(x, y), np.logaddexp(x, x)

    graph = Graph()
    given = [graph.given(Place("numbers", k)) for k in range(2)]
    numbers = [graph.number(one) for one in traced(both)(*given)]
    points = np.array(
        [[-5.0, -1.0, 2.0, 7.0, math.nan, math.inf, -math.inf], [1.0, math.inf, -math.inf, 0.0, 1.0, 2.0, 3.0]]
    )
    with np.errstate(all="ignore"):
        np.testing.assert_array_equal(
            values_of(numbers, points), np.array([both(*one) for one in points.T.tolist()]).T
        )
