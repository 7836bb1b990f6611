"""Attacks on the arithmetic of traced models: random expressions at whole multiples, zeros, huge numbers and NaN.

Python's own value is the judge, of graphs, machine code, tensors and C.
"""

from __future__ import annotations

import math
import re
import shutil
import subprocess
import tempfile
import warnings
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np

from filters import make_filter, run
from filters.c.programs import _Single
from filters.tensors.graphs import values_of as tensors_of
from tests.fuzz.python_interface import _line, _until
from tests.models import state_space
from thruster_env.core.streams import filter_keys
from thruster_env.graphs.graphs import Graph, Number, needed_by
from thruster_env.graphs.loops import Loops
from thruster_env.graphs.programs import (
    Place,
    Program,
    callable_of,
    program_of,
    statements_of,
    values_of,
    work_names,
)
from thruster_env.graphs.python_floats import in_python
from thruster_env.graphs.tracing import traced

LEAVES = ("x", "y", "x", "y", "49.0", "0.1", "3.0", "7", "-2.5", "0.5", "1", "2", "-3.0", "1e-3")
OPERATORS = ("+", "-", "*", "/", "%", "//", "+", "*", "%")
OF_ONE = (
    *("abs({})", "-({})", "float(math.floor({}))", "float(math.ceil({}))", "np.floor({})", "float(round({}))"),
    *("np.trunc({})", "np.sign({})", "np.round(float({}))", "math.fabs({})", "float({})", "np.rint(float({}))"),
    *(
        "np.isnan({}) * 1.0",
        "np.isfinite({}) * 2.0",
        "bool(np.logical_not({}))",
        "np.square(float({}))",  # of a truth value NumPy has eight bits, of its rounding sixteen
        "np.heaviside({}, 0.5)",
        "math.copysign({}, x)",
    ),
)
OF_TWO = (
    *("max({}, {})", "min({}, {})", "np.maximum({}, {})", "np.minimum({}, {})", "math.fmod({}, {})"),
    *("math.remainder({}, {})", "np.mod({}, float({}))", "np.floor_divide({}, float({}))"),
    *("np.fmax({}, {})", "np.fmin({}, {})", "np.clip({}, -1.5, 3.0) - ({})", "sum([{}, {}])"),
    *("divmod({}, {})[0]", "np.logical_or({}, {}) + 1.0"),
)
COMPARED = ("({}) > ({})", "({}) <= ({})", "({}) == ({})", "({}) != ({})", "({}) < ({})")
SMOOTH = (
    *("math.sin({})", "math.exp({})", "math.sqrt({})", "math.hypot({}, y)", "math.tanh({})", "np.hypot({}, x)"),
    *("np.cbrt(float({}))", "math.log2({})", "np.log1p(float({}))", "math.expm1({})", "np.exp2(float({}))"),
    *("math.erf({})", "math.erfc({})", "np.logaddexp(float({}), y)", "math.asinh({})", "math.log10({})"),
    *("np.interp(float({}), [-3.0, 0.0, 0.5, 49.0], [1.0, -2.0, 0.3, 4.0])", "np.polyval([0.5, -1.0, 3.0], {})"),
    *("np.std([float({}), x, y])", "np.var([float({}), y, 2.0])", "np.linalg.norm([float({}), y])"),
    "np.select([({}) > 0.3, x > y], [x, y], 0.5)",
)
NUMBERS = (
    *(0.0, 1.0, -1.0, 49.0, 98.0, -49.0, 147.0, 0.3, 0.1, 0.7, 2.5, -0.5, 3.5),
    *(1e-20, -1e-20, 1e17, 1e160, -1e200),
)
USUAL = tuple(one for one in NUMBERS if one == 0.0 or 1e-3 < abs(one) < 1e10)  # whose sums may be reordered
VARIABLE = r"\b[xy]\b"
SIZE = 12  # expressions that are compiled together


class Expression:
    """A random function of x and y.

    Attributes:
        text: of Python.
        parts: texts of what it is made of, whose sizes say how far rounding reaches.
        conditions: whether it may be true or false.
    """

    def __init__(self, rng: np.random.Generator):
        """Draw one."""
        self.parts: list[str] = []
        self._rng = rng
        text = self._drawn(int(rng.integers(2, 5)))
        self.text = self._noted(rng.choice(SMOOTH).format(text)) if rng.random() < 0.3 else text

    def _noted(self, text: str) -> str:
        """The text, unless it is a constant: a constant zero makes what it is multiplied by vanish."""
        if not re.search(VARIABLE, text):
            return str(self._rng.choice(("x", "y")))
        self.parts.append(text)
        return text

    def _drawn(self, depth: int) -> str:
        rng = self._rng
        if depth == 0:
            return str(rng.choice(LEAVES))
        kind = rng.random()
        if kind < 0.45:
            a, b = self._drawn(depth - 1), self._drawn(depth - 1)
            return self._noted(f"(({a}) {rng.choice(OPERATORS)} ({b}))")
        if kind < 0.65:
            return self._noted(f"({rng.choice(OF_ONE).format(self._drawn(depth - 1))})")
        if kind < 0.8:
            a, b = self._drawn(depth - 1), self._drawn(depth - 1)
            return self._noted(f"({str(rng.choice(OF_TWO)).format(a, b)})")
        condition = self._condition(depth)
        if kind < 0.9:
            return self._noted(f"({condition})")
        a, b = self._drawn(depth - 1), self._drawn(depth - 1)
        return self._noted(f"float(np.where({condition}, {a}, {b}))")

    def _condition(self, depth: int) -> str:
        first, other = (self._comparison(max(0, depth - 2)) for _ in range(2))
        joined = self._rng.choice(("", "", "&", "|", "^"))
        return f"({first}) {joined} ({other})" if joined else first

    def _comparison(self, depth: int) -> str:
        text = str(self._rng.choice(COMPARED)).format(self._drawn(depth), self._drawn(depth))
        if "np." in text:  # of NumPy's truth values a rest by zero is 0, of Python's there is none
            text = f"bool({text})"
        return text if re.search(VARIABLE, text) else "x > 1.0"

    @property
    def function(self) -> Callable:
        """It as a function of Python."""
        return eval(f"lambda x, y: {self.text}", {"math": math, "np": np})

    def values(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """What Python has at points (2, count), NaN where it raises, and how large the largest part is there."""
        found, sizes = (np.full(points.shape[1], np.nan) for _ in range(2))
        function = self.function
        parts = [eval(f"lambda x, y: {text}", {"math": math, "np": np}) for text in self.parts]
        for k, (x, y) in enumerate(points.T.tolist()):
            try:
                found[k] = function(x, y)
                sizes[k] = max([1.0, abs(x), abs(y), *(abs(float(part(x, y))) for part in parts)])
            except (ArithmeticError, ValueError, TypeError):
                pass
        return found, sizes


def points_of(rng: np.random.Generator, numbers=NUMBERS) -> np.ndarray:
    """Points (2, 16): numbers where arithmetic is tempted."""
    return rng.choice(numbers, size=(2, 16)) * rng.choice((1.0, 1.0, 2.0, 7.0), size=(2, 16))


def drawn(rng: np.random.Generator, count: int) -> list[Expression]:
    """Some expressions that depend on x or y, and that Python can compute."""
    found: list[Expression] = []
    while len(found) < count:
        one = Expression(rng)
        with warnings.catch_warnings(), np.errstate(all="ignore"):
            warnings.simplefilter("ignore")
            try:
                known = float(one.function(0.37, 1.91)) + float(one.function(2.2, -0.6))
            except (ArithmeticError, ValueError, TypeError):
                continue
        if not math.isnan(known) and ("x" in one.text or "y" in one.text):
            found.append(one)
    return found


def traced_together(expressions: list[Expression]) -> tuple[Graph, list[Number]]:
    """A graph of expressions of two numbers."""
    graph = Graph()
    given = [graph.given(Place("numbers", k)) for k in range(2)]
    graph.whole |= {one.place for one in given}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of constants without a value
        return graph, [graph.number(traced(one.function)(*given)) for one in expressions]


def agree(found, expected, sizes, what, rounding: float = 1e-12) -> None:
    """Raise AssertionError unless values are equal but for rounding, where they are known."""
    with np.errstate(all="ignore"):
        close = abs(found - expected) <= rounding * sizes
    same = close | (found == expected) | np.isnan(found) & np.isnan(expected)
    assert same.all(), (what, found[~same], expected[~same])


def in_c(program: Program, points: np.ndarray, single: bool) -> np.ndarray:
    """Values (stores, points) of a program that a C compiler has compiled."""
    kind, stores = "float" if single else "double", len(program.stores)
    with tempfile.TemporaryDirectory() as folder:
        source, library = Path(folder) / "work.c", Path(folder) / "work.so"
        body = "\n".join(statements_of(program, single))
        source.write_text(f"#include <math.h>\nvoid work(const {kind} *numbers, {kind} *rows)\n{{\n{body}\n}}\n")
        flags = "-std=c99 -O2 -Wall -Wextra -Werror -Wno-unused-variable -shared -fPIC".split()
        command = ["gcc", *flags, str(source), "-lm", "-o", str(library)]
        subprocess.run(command, check=True, capture_output=True, text=True)
        return called_in_c(library, points, stores, single)


def called_in_c(library: Path, points: np.ndarray, stores: int, single: bool) -> np.ndarray:
    """Values of the function `work` of a library, at each point."""
    import ctypes

    work = ctypes.CDLL(str(library)).work
    kind = np.float32 if single else np.float64
    found = np.empty((stores, points.shape[1]), kind)
    with np.errstate(over="ignore"):
        points = points.astype(kind)
    for k in range(points.shape[1]):
        given, rows = points[:, k].copy(), np.empty(stores, kind)
        work(ctypes.c_void_p(given.ctypes.data), ctypes.c_void_p(rows.ctypes.data))
        found[:, k] = rows
    return found.astype(np.float64)


def traced_arithmetic(rng: np.random.Generator, seconds: float) -> str:
    """Random expressions: Python's values are those of graphs, tensors and C, double and single."""
    import torch

    counts: Counter = Counter()
    for _ in _until(seconds):
        expressions, points = drawn(rng, SIZE), points_of(rng)
        points[rng.random(points.shape) < 0.05] = np.nan
        _, numbers = traced_together(expressions)
        program = program_of([(Place("rows", k), one) for k, one in enumerate(numbers)], {})
        given = {Place("numbers", k): torch.tensor(row) for k, row in enumerate(points)}
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            graph_values = values_of(numbers, points)
            python = [one.values(points) for one in expressions]
            single = np.array(_of_single(program, points))
        usual = ~(abs(points) > 1e100).any(axis=0)  # torch's fmod has NaN for rests of larger quotients
        tensors = tensors_of(numbers, needed_by(numbers), given, torch.tensor(0.0, dtype=torch.float64))
        by_c = [in_c(program, points, single) for single in (False, True)] if shutil.which("gcc") else None
        for k, one in enumerate(expressions):
            expected, sizes = python[k]
            known = ~np.isnan(sizes)
            agree(graph_values[k][known], expected[known], sizes[known], one.text)
            scale = np.nan_to_num(sizes, nan=1.0)
            tensor = torch.as_tensor(tensors[k], dtype=torch.float64).expand(points.shape[1]).numpy()
            agree(tensor[usual], graph_values[k][usual], scale[usual], f"torch: {one.text}")
            if by_c is not None:
                agree(by_c[0][k], graph_values[k], scale, f"C: {one.text}")
                agree(by_c[1][k], single[k], scale, f"C, single: {one.text}", 1e-4)
            counts["expressions"] += 1
    return _line("traced arithmetic", counts)


def _of_single(program: Program, points: np.ndarray) -> np.ndarray:
    rows = np.empty((len(program.stores), points.shape[1]), np.float32)
    names = {**work_names(), "float": _Single, "rows": rows, "numbers": points.astype(np.float32)}
    exec("\n".join(program.text), names)
    return rows.astype(np.float64)


def in_machine_code(numbers: list[Number], points: np.ndarray) -> np.ndarray:
    """Values (numbers, points) of numbers that are compiled together."""
    work = callable_of(program_of([(Place("rows", k), one) for k, one in enumerate(numbers)], {}), 1)

    def call(rows, given):
        work(rows, rows, given, given)

    run_it, found = Loops(call), []
    for point in points.T:
        found.append(np.empty(len(numbers)))
        run_it(found[-1], np.ascontiguousarray(point))
    return np.transpose(found)


def compiled_arithmetic(rng: np.random.Generator, seconds: float) -> str:
    """Random expressions: machine code has Python's values, where it jumps as well."""
    counts: Counter = Counter()
    for _ in _until(seconds):
        expressions, points = drawn(rng, SIZE), points_of(rng, USUAL)
        _, numbers = traced_together(expressions)
        found = in_machine_code(numbers, points)
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            for k, one in enumerate(expressions):
                expected, sizes = one.values(points)
                known = ~np.isnan(sizes)
                agree(found[k][known], expected[known], sizes[known], one.text)
                counts["expressions"] += 1
    return _line("compiled arithmetic", counts)


def python_arithmetic(rng: np.random.Generator, seconds: float) -> str:
    """Random expressions that run as Python: Python's values; where it raises those of graphs or NumPy's scalars.

    Graphs have no sign of zero, and so other infinities.
    """
    counts: Counter = Counter()
    for _ in _until(seconds):
        expressions, points = drawn(rng, SIZE), points_of(rng)
        _, numbers = traced_together(expressions)
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            graph_values = values_of(numbers, points)
            for k, one in enumerate(expressions):
                of_python, sizes = one.values(points)
                of_vector = _of_vector(one.function)
                for i, point in enumerate(points.T):
                    try:
                        found = np.array([in_python(of_vector, [tuple(point)])[0]], dtype=float)
                    except (ArithmeticError, ValueError, TypeError):  # of constants and whole numbers alone
                        counts["refused"] += 1
                        continue
                    size = np.nan_to_num(sizes[i], nan=1.0)
                    if not np.isnan(sizes[i]):
                        agree(found, of_python[[i]], size, one.text)
                    elif not np.isclose(found, graph_values[k][i], rtol=1e-12, equal_nan=True):
                        try:
                            agree(found, np.array([float(one.function(*point))]), size, one.text)
                        except (ArithmeticError, ValueError):  # it takes floats of NumPy's scalars
                            expected = graph_values[k][[i]]
                            if np.isfinite([*found, *expected]).all():
                                agree(abs(found), abs(expected), size, (one.text, point))
                    counts["values"] += 1
    return _line("python arithmetic", counts)


def _of_vector(function: Callable) -> Callable:
    return lambda x: (function(*x),)


def filtered_arithmetic(rng: np.random.Generator, seconds: float) -> str:
    """A model of random expressions: what a filter predicts is what Python has at its prior mean."""
    counts: Counter = Counter()
    for _ in _until(seconds):
        texts = [one.text for one in drawn(rng, 2)]
        names: dict = {"math": math, "np": np}
        exec(f"def f(s, u, c):\n    x, y = s\n    return ({texts[0]}) * 1.0, ({texts[1]}) * 1.0\n", names)
        mean = rng.choice(USUAL, size=2)
        try:
            with np.errstate(all="ignore"), warnings.catch_warnings():
                warnings.simplefilter("ignore")
                expected = np.array(names["f"](tuple(mean.tolist()), (), ()), dtype=float)
                noise = {"q": [1e-6] * 2, "r": [1.0], "cov": [1e-12] * 2}
                model = state_space(names["f"], lambda s, c: (s[0],), **noise, mean=mean, inputs=0)
                filter_ = make_filter("ekf", model)
                found = run(filter_, filter_keys([0]), np.zeros((1, 1, 0)), np.full((1, 2, 1), np.nan))
        except (ArithmeticError, ValueError, TypeError):
            counts["refused"] += 1
            continue
        if not found.divergences.any():
            sizes = np.full(2, max(1.0, *abs(mean), *abs(expected)))
            agree(found.means[0, 1], expected, sizes, (texts, mean), 1e-9)
            counts["models"] += 1
    return _line("filtered arithmetic", counts)
