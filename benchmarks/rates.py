"""The arithmetic limit of the machine at hand: the rate of each kind of operation, and a program's operations.

Each rate is that of a loop in the widest vectors, in the fastest cache, whose operations depend on one another too
little to wait and too much to be dropped. The limit of a computation is the time of its operations, one kind after
the other: that of a program without memory, calls, branches or remainders, and of no other program.

Operations are counted by numbers that know the operation and the operands they are the result of. Those on which a
result depends count, each once, however often the source writes it: what a compiler drops, or finds twice, is no
work. Operations on constants alone are done before, and count nothing; so do comparisons, signs, roundings and
masks.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from time import perf_counter
from typing import Any, NamedTuple
from unittest import mock

import gymnasium as gym
import numpy as np
from numpy.lib.mixins import NDArrayOperatorsMixin

from filters.engine.compile import new_memory
from filters.filter import Filter
from thruster_env.core.compiled import compiled, interpreted
from thruster_env.core.streams import FILTER_PROCESS, normal_block
from thruster_env.core.threads import cores as all_cores
from thruster_env.core.threads import spread

ADD, MULTIPLY, DIVIDE, ROOT, RECIPROCAL_ROOT = "add", "multiply", "divide", "root", "reciprocal root"
PRODUCT, INTEGER = "integer product", "integer"  # of 32 bits by 32, and shifts, sums and exclusive ors

KINDS = {  # of operations; None for those that are free beside others, and for the mathematical library's
    **dict.fromkeys(("add", "subtract"), ADD),
    **{"multiply": MULTIPLY, "square": MULTIPLY, "divide": DIVIDE, "sqrt": ROOT},
    **dict.fromkeys(("right_shift", "left_shift", "bitwise_xor", "bitwise_or"), INTEGER),
    **dict.fromkeys(("absolute", "negative", "positive", "bitwise_and", "minimum", "maximum")),
    **dict.fromkeys(("floor", "ceil", "rint", "remainder")),
    **dict.fromkeys(("sin", "cos", "tan", "arctan2", "exp", "log")),
}
COMPARISONS = "less", "less_equal", "greater", "greater_equal", "equal", "not_equal"
COMMUTATIVE = "add", "multiply", "bitwise_xor", "bitwise_or"
NEUTRAL = {"add": 0.0, "multiply": 1.0}  # operands that change nothing
POWERS = {0.5: ROOT, -0.5: RECIPROCAL_ROOT, 2: MULTIPLY}
FUSED, ROUND = "fused multiply-add", "product, shift and two exclusive ors"
IN_A_ROUND = 3  # operations on whole numbers that go with a product in a round of Philox
WIDTH, REPEATS, ROUNDS = 1024, 500, 15
PARTS = 8  # of the work on all cores
NORMALS = 4  # that one block of the generator makes
FEW = 8, 16  # members that are enough to count, whole vector registers of them


# Counts of operations: a computation's source is run on numbers that record their operands.


class Counted(NDArrayOperatorsMixin):
    """A number and the operation that computed it."""

    __slots__ = ("graph", "kind", "operands", "value")

    def __init__(self, graph: Graph, value, kind: str | None, operands: tuple[Counted, ...]):
        self.graph, self.value, self.kind, self.operands = graph, value, kind, operands

    def __array_ufunc__(self, ufunc, method, *inputs, out=None):
        if any(isinstance(x, np.ndarray) and x.ndim for x in inputs):
            return ufunc(*(x if isinstance(x, np.ndarray) else _entry(x) for x in inputs))
        name, value = ufunc.__name__, ufunc(*(x.value if isinstance(x, Counted) else x for x in inputs))
        if name in COMPARISONS:
            return value
        for x, other in (inputs, inputs[::-1]) if name in NEUTRAL else ():
            if not isinstance(other, Counted) and other == NEUTRAL[name]:
                return x
        return self.graph.number(name, inputs, value, _kind(name, inputs, value))

    def __float__(self) -> float:
        """For functions of the mathematical library; their result counts as a constant."""
        self.graph.results.append(self)
        return float(self.value)

    def __int__(self) -> int:
        """For places in arrays and numbers of rounds."""
        self.graph.results.append(self)
        return int(self.value)

    def view(self, kind: _Converter) -> Counted:
        """The same bits as a number of another type."""
        return self.graph.number(f"as {kind.type.__name__}", (self,), self.value.view(kind.type), None)


def _method(name: str) -> Callable:
    return lambda self: getattr(np, name)(self)


for _name in ("sqrt", "sin", "cos", "tan", "exp", "log", "floor", "ceil"):  # NumPy asks entries of arrays for them
    setattr(Counted, _name, _method(_name))


def _entry(x) -> np.ndarray:
    """A number as an array without axes, so that NumPy takes it for one beside an array's entries."""
    out = np.array(None)
    out[()] = x
    return out


class Graph:
    """All numbers of one computation."""

    def __init__(self):
        self._known: dict[tuple, Counted] = {}
        self._variables: list[Counted] = []
        self.results: list[Counted] = []

    def variables(self, array: np.ndarray) -> np.ndarray:
        """An array as variables: numbers that are inputs, not constants."""
        out = array.astype(object)
        for index, value in np.ndenumerate(array):
            out[index] = Counted(self, value, None, ())
        self._variables += out.ravel().tolist()
        return out

    def number(self, name: str, inputs: tuple, value, kind: str | None) -> Counted:
        """The result of an operation; the same operation on the same operands gives the same object."""
        names = [id(x) if isinstance(x, Counted) else (x,) for x in inputs]
        key = (name, *(sorted(names, key=str) if name in COMMUTATIVE else names))
        if key not in self._known:
            operands = tuple(x for x in inputs if isinstance(x, Counted))
            if kind == DIVIDE and len(operands) == 1 and operands[0].kind == ROOT:
                kind, operands = RECIPROCAL_ROOT, operands[0].operands
            self._known[key] = Counted(self, value, kind, operands)
        return self._known[key]

    def operations(self, *arrays: np.ndarray) -> Counter[str]:
        """Number of operations of each kind on which the numbers in arrays depend."""
        numbers = [x for array in arrays for x in array.ravel().tolist() if isinstance(x, Counted)]
        waiting = {id(x): x for x in numbers + self.results}
        visited, count = set(waiting), Counter()
        while waiting:
            _, number = waiting.popitem()
            if number.kind is not None:
                count[number.kind] += 1
            waiting |= {id(x): x for x in number.operands if id(x) not in visited}
            visited |= {id(x) for x in number.operands}
        return count


def _kind(name: str, inputs: tuple, value) -> str | None:
    if name == "divide" and not isinstance(inputs[1], Counted):
        return MULTIPLY  # by the reciprocal of a constant
    if name == "power" and inputs[1] in POWERS:
        return POWERS[inputs[1]]
    if name not in KINDS:
        raise TypeError(f"operations that are counted must be among {', '.join(KINDS)}, but got {name}")
    if isinstance(value, int | np.integer):
        return {ADD: INTEGER, MULTIPLY: PRODUCT}.get(KINDS[name], KINDS[name])
    return KINDS[name]


class _Converter:
    """One of NumPy's types of numbers, which lets a counted number remain one."""

    def __init__(self, kind: type):
        self.type = kind

    def __call__(self, x):
        if not isinstance(x, Counted):
            return self.type(x)
        return x.graph.number(self.type.__name__, (x,), self.type(x.value), None)


def _zeros(shape, *_: Any) -> np.ndarray:
    return np.full(shape, 0.0, dtype=object)


@contextmanager
def counting() -> Iterator[Graph]:
    """Within this context sources run as Python, on numbers of a new graph, also in arrays that they make."""
    patched = {name: _Converter(getattr(np, name)) for name in ("float64", "int64", "uint64")}
    with interpreted(), mock.patch.multiple(np, empty=_zeros, zeros=_zeros, **patched):
        yield Graph()


def operations_of(function: Callable, *arguments) -> Counter[str]:
    """Operations of a function of vectors (tuples) that returns one; arguments that are arrays are variables."""
    with counting() as graph:
        operands = (tuple(graph.variables(a)) if isinstance(a, np.ndarray) else a for a in arguments)
        return graph.operations(np.array(function(*operands), dtype=object))


_MULTIPLIER_0, _MULTIPLIER_1 = np.uint64(0xD2511F53), np.uint64(0xCD9E8D57)
_LOW, _SHIFT, _WEYL = np.uint64(0xFFFFFFFF), np.uint64(32), np.uint64(0x9E3779B9)
_LEFT, _RIGHT, _FURTHER = np.uint64(13), np.uint64(7), np.uint64(17)
_START = 0x5FE6EB50C7B537A9  # minus half the bits of x is near the bits of x^-1/2


def arithmetic_limit(count: Counter[str], *, cores: int = 1) -> float:
    """Seconds that operations take on so many cores, each kind at its best measured rate.

    Additions and multiplications come in pairs, as far as they go: one instruction does both.
    """
    if not count:
        return 0.0
    rate = rates(cores)
    within_rounds = IN_A_ROUND * count[PRODUCT]
    return (
        max(count[ADD], count[MULTIPLY]) * rate[FUSED]
        + count[DIVIDE] * rate[DIVIDE]
        + count[ROOT] * rate[ROOT]
        + count[RECIPROCAL_ROOT] * rate[RECIPROCAL_ROOT]
        + count[PRODUCT] * rate[ROUND]
        + max(count[INTEGER] - within_rounds, 0.0) * rate[INTEGER]
    )


def _fused(data, repeats):
    for _ in range(repeats):
        for j in range(data.shape[0]):
            c = data[j]
            x, y, z, w = 0.9 * c, 0.8 * c, 0.7 * c, 0.6 * c
            for _ in range(16):
                x = x * x - c
                y = y * y - c
                z = z * z - c
                w = w * w - c
            data[j] = c + 1e-9 * (x * y + z * w)


def _divided(data, repeats):
    for _ in range(repeats):
        for j in range(data.shape[0]):
            data[j] = 1.0 / (data[j] + 1.0)


def _root(data, repeats):
    for _ in range(repeats):
        for j in range(data.shape[0]):
            data[j] = (data[j] + 1.0) ** 0.5


def _reciprocal_root(data, repeats):
    for _ in range(repeats):
        for j in range(data.shape[0]):
            data[j] = 1.0 / (data[j] + 1.0) ** 0.5


def _newtons_root(data, repeats):  # the same to 1e-15
    for _ in range(repeats):
        for j in range(data.shape[0]):
            x = data[j] + 1.0
            half = 0.5 * x
            y = np.int64(_START - (np.float64(x).view(np.int64) >> 1)).view(np.float64)
            for _ in range(4):
                y = y * (1.5 - half * y * y)
            data[j] = y


def _rounds(data, repeats):
    for _ in range(repeats):
        for j in range(data.shape[0]):
            c0 = c1 = c2 = c3 = data[j]
            for _ in range(10):
                product_0, product_1 = _MULTIPLIER_0 * (c0 & _LOW), _MULTIPLIER_1 * (c2 & _LOW)
                c0, c1 = (product_1 >> _SHIFT) ^ c1 ^ _WEYL, product_1 & _LOW
                c2, c3 = (product_0 >> _SHIFT) ^ c3 ^ _WEYL, product_0 & _LOW
            data[j] = c0 ^ c1 ^ c2 ^ c3


def _shifts(data, repeats):
    for _ in range(repeats):
        for j in range(data.shape[0]):
            x = data[j]
            for _ in range(8):
                x = x ^ (x << _LEFT)
                x = x ^ (x >> _RIGHT)
                x = x ^ (x << _FURTHER)
            data[j] = x


class Loop(NamedTuple):
    """A loop over data, and how often each of their entries meets the operation."""

    function: Callable  # function(data, repeats)
    count: int
    data: np.ndarray


_NUMBERS, _WORDS = np.linspace(1.0, 2.0, WIDTH), np.arange(WIDTH).astype(np.uint64) * np.uint64(77777)
LOOPS = {
    FUSED: [Loop(_fused, 71, -0.1 * _NUMBERS)],
    DIVIDE: [Loop(_divided, 1, _NUMBERS)],
    ROOT: [Loop(_root, 1, _NUMBERS)],
    RECIPROCAL_ROOT: [Loop(_reciprocal_root, 1, _NUMBERS), Loop(_newtons_root, 1, _NUMBERS)],
    ROUND: [Loop(_rounds, 20, _WORDS)],
    INTEGER: [Loop(_shifts, 48, _WORDS)],
}


@cache
def rates(cores: int) -> dict[str, float]:
    """Seconds an operation of each kind, on one core or on all; measured at the first call."""
    return _measured(cores)


def measure_again() -> None:
    """Measure the rates once more and keep the better ones: others may have used the machine before, or do now."""
    for cores in {1, all_cores()}:
        rates(cores).update({kind: min(rates(cores)[kind], rate) for kind, rate in _measured(cores).items()})


def _measured(cores: int) -> dict[str, float]:
    return {kind: min(_seconds(loop, cores) for loop in loops) for kind, loops in LOOPS.items()}


def _seconds(loop: Loop, cores: int) -> float:
    """The best of many rounds."""
    run = _compiled(loop.function)

    def part(first: int, last: int) -> None:
        for _ in range(first, last):
            run(loop.data.copy(), REPEATS)

    part(0, 1)
    best = np.inf
    for _ in range(ROUNDS):
        begin = perf_counter()
        if cores == 1:
            part(0, PARTS)
        else:
            spread(part, PARTS)
        best = min(best, perf_counter() - begin)
    return best / (PARTS * REPEATS * len(loop.data) * loop.count)


@cache
def _compiled(function: Callable) -> Callable:
    return compiled(function)


def vector_bits() -> int:
    """Bits in the vectors of which the compiler makes our loops, as its assembly shows."""
    from numba.core.caching import NullCache

    def scale(values):
        for j in range(values.shape[0]):
            values[j] *= 2.0

    run = compiled(scale)
    run._cache = NullCache()  # there is no assembly of code that was read from a file
    run(np.ones(1))
    (code,) = run.inspect_asm().values()
    return 512 if "%zmm" in code else 256 if "%ymm" in code else 128


# Operations of one step of an env, of a filter and of noise, for the arithmetic limits of the rows.


def step_of_env(env: gym.Env) -> Counter[str]:
    """Operations of one step of an env's plant, its noise and what it reports included."""
    with interpreted():
        copies = env.unwrapped.copies_of(1)
        copies.begin(np.array([[1.0, 2.0]]))
    with counting() as graph:
        memory, out = graph.variables(copies.memory), np.zeros((copies.reported, 2, 1))
        copies.advance.on_result((memory, copies.numbers, copies.lines, False), out)()
    return graph.operations(memory, out)


def step_of_filtered(env: gym.Env) -> Counter[str]:
    """The same of an env and the filter around it."""
    return step_of_env(env) + step_of_filter(env.get_wrapper_attr("filter"))


def step_of_filter(filter_: Filter) -> Counter[str]:
    """Operations of one prediction and one update, of all members where there are some."""
    if filter_.size <= FEW[1]:
        return step_of_members(filter_, filter_.size)
    fixed, a_member = step_by_size(filter_)
    return fixed + times(a_member, filter_.size)


def step_by_size(filter_: Filter, few: tuple[int, int] = FEW) -> tuple[Counter[str], Counter[str]]:
    """Operations of a step of an ensemble filter without its members, and of each member: within 2 % a line."""
    first, second = (step_of_members(filter_, size) for size in few)
    a_member = times(second - first, 1 / (few[1] - few[0]))
    return first - times(a_member, few[0]), a_member


def step_of_members(filter_: Filter, size: int) -> Counter[str]:
    """The same with so many members, all of them counted."""
    kernels, model, numbers = filter_.kernels(), filter_.kernel_model, filter_.numbers
    memory = new_memory(kernels, size)
    with interpreted():
        kernels.start(memory, numbers, size)
    with counting() as graph:
        row, table, draws = memory = tuple(graph.variables(part) for part in memory)
        u, z = (graph.variables(np.ones(count)) for count in (model.inputs, model.m))
        kernels.predict(memory, u, numbers, size)
        kernels.update(memory, z, numbers, size)
    return graph.operations(row, table[: model.n, :size])


def normals(count: int) -> Counter[str]:
    """Operations of so many standard normals."""
    with counting() as graph:
        (block,) = graph.variables(np.arange(1))
        drawn = np.array(normal_block(block, 1, FILTER_PROCESS, 2, 3), dtype=object)
    return times(graph.operations(drawn), count / NORMALS)


def times(count: Counter[str], factor: float) -> Counter[str]:
    """The operations multiplied by a factor."""
    return Counter({kind: factor * number for kind, number in count.items()})
