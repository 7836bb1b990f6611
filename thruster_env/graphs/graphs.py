"""Unknown numbers: operations on them build a graph, in which every operation exists once.

A `Number` stands for a float64. Operators and NumPy's functions of Numbers return Numbers, so that a plain
function of floats, called with Numbers, writes down what it computes:

    graph = Graph()
    x, y = graph.given("x"), graph.given("y")
    x * y + x * y        # one product, and one sum of it with itself
    0.0 * x + 1.0 * y    # y itself

Three rules keep the graph small. The same operation on the same arguments exists once (`Graph.make`), products
and sums in either order. Operations on constants give constants, and zeros and ones of a matrix's structure
vanish. A page's division by a number is a product with its reciprocal, which exists once. Within
`Graph.as_written`, where functions of a model are traced, a division stays a division: 49/49 is 1, and
49 * (1/49) is less.

A comparison is a condition. In arithmetic it is 1.0 or 0.0, as in Python. A Number cannot decide a branch:
`if x > 0.0` raises TypeError, except in `branches`, which traces both sides. `where(condition, a, b)` evaluates
both sides.
"""

from __future__ import annotations

import gc
import math
import operator
from collections.abc import Callable, Container, Hashable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from thruster_env.graphs.folding import (
    as_number,
    difference,
    divided,
    floor_quotient,
    modulus,
    negative,
    overflow_of,
    product,
    quotient,
    sign_of,
    total,
    worked_out,
)

UNARY = (
    *"sqrt exp log sin cos tan arctan tanh sinh cosh floor ceil cbrt exp2 expm1".split(),
    *"log1p log2 log10 arcsinh arccosh arctanh erf erfc".split(),
)
TWO_SIDED = {"+", "*"}  # operations whose arguments may change places
COMPARISONS: dict[str, Callable] = {
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}
CONDITIONS = (*COMPARISONS, "and", "or")  # operations whose results are no floats
JUMPS = (*COMPARISONS, "floor", "ceil", "rint", "fmod")  # operations whose results rounding may change by much
REDUCTIONS = ("sum", "largest")  # operations that make one number of those of all members
ROWS = 4  # of a repeated function that machine code evaluates side by side
FEWEST_REPEATED = 200  # operations of a function's rows: with fewer, memory costs more than the code that it saves


class TooLarge(TypeError):
    """A graph has more operations than it may have: code written out for it would take long to compile."""


@contextmanager
def uncollected() -> Iterator[None]:
    """Within this context Python looks for no garbage: a graph has none, and the search took half the time."""
    was = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was:
            gc.enable()


class Graph:
    """The operations on some numbers that are given, in the order in which they were first asked for."""

    def __init__(self, most: int = 1_000_000, size: int | None = None):
        """Begin without numbers; more operations than `most` raise TooLarge. `size` members may be known now."""
        self.numbers: list[Number] = []
        self.size = size
        self.decide: Callable[[Number], bool] | None = None  # what a condition is taken for, see `branches`
        self.answers: dict[int, bool] = {}  # what conditions are taken for now, by their places
        self.outcomes = 0  # of decisions that were not the first, as far as a function has been traced
        self.whole: set[int] = set()  # places of numbers that are not taken apart, as along them slopes are taken
        self.may_raise = True  # whether a branch that raises an exception is NaN, or is refused
        self.exact = False  # whether a model's function is being traced: see `as_written`
        self.repeats: list[Repeat] = []
        self._made: dict[tuple, Number] = {}
        self._most = most

    def make(self, operation: str, *arguments: Number | Hashable) -> Number:
        """The number that an operation makes of others; the same one if it has been made before."""
        key = (operation, *[a.place if isinstance(a, Number) else a for a in arguments])
        number = self._made.get(key)
        if number is None:
            if len(self.numbers) >= self._most:
                raise TooLarge(f"a graph must have at most {self._most} operations")
            number = self._made[key] = Number(self, operation, arguments, len(self.numbers))
            if operation in TWO_SIDED:
                self._made[(operation, key[2], key[1])] = number
            self.numbers.append(number)
        if self.exact and operation in JUMPS:
            self._round_as_written(number)
        return number

    @contextmanager
    def as_written(self, exact: bool = True) -> Iterator[None]:
        """Within this context numbers are those of Python: divisions, and all on which a jump depends; or not."""
        was, self.exact = self.exact, exact
        try:
            yield
        finally:
            self.exact = was

    def _round_as_written(self, jump: Number) -> None:
        """Forbid machine code to reorder or contract the operations that lead to a jump."""
        waiting = [jump]
        while waiting:
            number = waiting.pop()
            if (
                not number.exact
                and number.place not in self.whole
                and number.operation not in ("given", "constant")
            ):
                number.exact = True
                waiting += number.of

    def given(self, name: Hashable, *, member: bool = False) -> Number:
        """A number that is an input of the program, by its name or its place."""
        number = self.make("given", name)
        number.member = member
        return number

    def constant(self, value: float) -> Number:
        """A number that is known now."""
        return self.make("constant", float(value).hex())

    def number(self, value: Number | float) -> Number:
        """A number, known now or not; a condition as 1.0 or 0.0."""
        return as_number(value) if isinstance(value, Number) else self.constant(value)


def _in_both_orders(work):
    """The methods of an operator: what the operation makes of a number and another one, and of the two in turn."""

    def method(self, other):
        return NotImplemented if (b := self._as_number(other)) is None else work(as_number(self), b)

    def turned(self, other):
        return NotImplemented if (b := self._as_number(other)) is None else work(b, as_number(self))

    return method, turned


class Number:
    """A float64 that an operation makes of others.

    Attributes:
        operation, arguments: its operation and the arguments of that: Numbers, or a name or value.
        of: the Numbers among the arguments.
        place: its index in the graph.
        value: of a constant; None for others.
        member: whether it is one number for each member of an ensemble.
        may_overflow, sign: bounds on its size, from `folding.overflow_of` and `folding.sign_of`.
        exact: whether machine code rounds it as Python does.
    """

    __slots__ = tuple("graph operation arguments of place value member may_overflow sign exact".split())
    sqrt: Callable[[], Number]  # and so on, as UNARY has them
    log: Callable[[], Number]
    floor: Callable[[], Number]
    __hash__ = None  # type: ignore[assignment]  # a dictionary of a user's would be asked for a value not known yet

    def __init__(self, graph: Graph, operation: str, arguments: tuple, index: int):
        """For `Graph.make` alone."""
        self.graph, self.operation, self.arguments, self.place = graph, operation, arguments, index
        self.of: tuple[Number, ...] = tuple([a for a in arguments if isinstance(a, Number)])
        self.value = float.fromhex(arguments[0]) if operation == "constant" else None
        self.member: bool = operation not in REDUCTIONS and any([a.member for a in self.of])
        self.may_overflow, self.sign = overflow_of(operation, self.of), sign_of(operation, self.of, self.value)
        self.exact = False

    def __repr__(self) -> str:
        return f"<number {self.place}: {self.operation}>"

    def __format__(self, spec: str) -> str:
        return repr(self)  # for messages only; a conversion to float raises TypeError

    def __bool__(self) -> bool:
        if self.graph.decide is None:
            raise TypeError("a traced value has no truth value: use where(condition, a, b)")
        return self.graph.decide(self)

    @property
    def is_condition(self) -> bool:
        """Whether it is true or false, and no float yet."""
        return self.operation in CONDITIONS

    def _as_number(self, other) -> Number | None:
        """The other one as a Number of this graph; None where it is no number."""
        if isinstance(other, Number):
            return as_number(other)
        if isinstance(other, (int, float, np.generic)) or isinstance(other, np.ndarray) and not other.shape:
            return self.graph.constant(float(other))
        return None

    __add__, __radd__ = _in_both_orders(total)
    __sub__, __rsub__ = _in_both_orders(difference)
    __mul__, __rmul__ = _in_both_orders(product)
    __truediv__, __rtruediv__ = _in_both_orders(lambda a, b: divided(a, b) if a.graph.exact else quotient(a, b))
    __mod__, __rmod__ = _in_both_orders(modulus)
    __floordiv__, __rfloordiv__ = _in_both_orders(floor_quotient)

    def __lt__(self, other):
        return self._compared("<", other)

    def __le__(self, other):
        return self._compared("<=", other)

    def __gt__(self, other):
        return self._compared(">", other)

    def __ge__(self, other):
        return self._compared(">=", other)

    def __eq__(self, other):
        return False if (condition := self._compared("==", other)) is NotImplemented else condition

    def __ne__(self, other):
        return True if (condition := self._compared("!=", other)) is NotImplemented else condition

    def _compared(self, operation: str, other):
        """A condition; of numbers that are known now whether it holds."""
        if (b := self._as_number(other)) is None:
            return NotImplemented
        a = as_number(self)
        if a.value is not None and b.value is not None:
            return COMPARISONS[operation](a.value, b.value)
        return self.graph.make(operation, a, b)

    def __neg__(self):
        return negative(as_number(self))

    def __pos__(self):
        return as_number(self)

    def __abs__(self):
        return worked_out("abs", self)

    def __round__(self, digits=None):
        if digits is not None:
            raise TypeError("a traced value is rounded to whole numbers alone")
        return worked_out("rint", self)

    def __pow__(self, power):
        if isinstance(power, Number):
            return worked_out("pow", self, power) if power.value is None else self**power.value
        if power in (0.5, -0.5):
            return self.sqrt() if power > 0 else 1.0 / self.sqrt()
        if power == int(power) and 0 < abs(power) <= 8:
            product = math.prod([self] * int(abs(power)))
            return product if power > 0 else 1.0 / product
        unit = self.graph.constant(1.0)
        return unit if power == 0 else worked_out("pow", self, self.graph.constant(power))

    def __rpow__(self, base):
        return self._as_number(base) ** self

    def __divmod__(self, other):
        return self // other, self % other

    def __rdivmod__(self, other):
        return other // self, other % self

    def __and__(self, other):
        return self._joined("and", other, known=False)

    def __or__(self, other):
        return self._joined("or", other, known=True)

    __rand__, __ror__ = __and__, __or__

    def __invert__(self):
        if not self.is_condition:
            raise TypeError("floats have no bits: ~ is the contrary of a comparison")
        return self == 0.0

    def __xor__(self, other):
        if isinstance(other, (bool, np.bool_)):
            return ~self if other else self
        self._check_joined(other)
        return self != other

    __rxor__ = __xor__

    def _joined(self, operation: str, other, known: bool):
        """Both conditions, or one of them; one that is known now decides, or the other one does."""
        if isinstance(other, (bool, np.bool_)):
            return known if other == known else self
        self._check_joined(other)
        return self.graph.make(operation, self, other)

    def _check_joined(self, other) -> None:
        if not (self.is_condition and isinstance(other, Number) and other.is_condition):
            raise TypeError("floats have no bits: &, | and ^ join comparisons")


def _unary(name: str):
    def method(self: Number) -> Number:
        return worked_out(name, self)

    method.__doc__ = f"The function {name} of the number, as NumPy asks an object for it."
    return method


for _name in UNARY:
    setattr(Number, _name, _unary(_name))
Number.__floor__, Number.__ceil__ = Number.floor, Number.ceil  # type: ignore[attr-defined]


def where(condition, a, b):
    """`a` where the condition holds, else `b`, of numbers known or not; both are evaluated."""
    known = next((a for a in (condition, a, b) if isinstance(a, Number)), None)
    if not isinstance(condition, Number):
        return a if condition else b
    if condition.value is not None:
        return a if condition.value else b
    if not condition.is_condition:
        condition = condition != 0.0
    a, b = known._as_number(a), known._as_number(b)  # type: ignore[union-attr]
    return a if a is b else condition.graph.make("where", condition, a, b)


def arctan2(y, x):
    """The angle of a point (x, y), of numbers known or not."""
    known = next((a for a in (y, x) if isinstance(a, Number)), None)
    if known is None:
        return np.arctan2(y, x)
    return worked_out("arctan2", known.graph.number(y), known.graph.number(x))


def over_members(a: Number) -> Number:
    """The sum of a number that each member of an ensemble has."""
    return a.graph.make("sum", a) if a.member else a * size_of(a)


def largest_of_members(a: Number) -> Number:
    """The largest of the numbers that the members have; NaN is none."""
    return a.graph.make("largest", a) if a.member else a


def size_of(a: Number) -> Number:
    """The number of members, beside a number."""
    graph = a.graph
    return graph.make("size") if graph.size is None else graph.constant(graph.size)


def called(name: str, count: int, *numbers: Number) -> list[Number]:
    """The results of a function that is compiled as it is, for numbers; its name is that in `programs.CALLED`."""
    graph = numbers[0].graph
    call = graph.make("call", name, count, *numbers)
    return [graph.make("entry", call, k) for k in range(count)]


class Repeat(NamedTuple):
    """A function that was traced for several rows of numbers, whose body machine code may have once.

    Attributes:
        formal: numbers in the place of a row.
        body: the results for them.
        rows: the rows.
        results: the results for each of them, of which no row depends on another.
    """

    formal: Sequence[Number]
    body: Sequence[Number]
    rows: Sequence[Sequence[Number]]
    results: Sequence[Sequence[Number]]


def are_unknown(numbers: np.ndarray) -> bool:
    """Whether all numbers of an array are Numbers, none of them known now or of a member."""
    return all(isinstance(a, Number) and a.value is None and not a.member for a in numbers.flat)


def repeated(function: Callable, rows: np.ndarray) -> np.ndarray:
    """The results `function(row)` of each row of a matrix, (rows, results); many make a `Repeat` of the graph."""
    if len(rows) < 2 or not are_unknown(rows):
        return np.array([function(row) for row in rows], dtype=object)
    graph = rows[0, 0].graph
    formal = [graph.given(("own", k)) for k in range(rows.shape[1])]
    body = function(np.array(formal, dtype=object)).tolist()
    first = len(graph.numbers)
    results = np.array([function(row) for row in rows], dtype=object)
    is_new = all(isinstance(a, Number) and a.place >= first for a in results.flat)
    if is_new and len(graph.numbers) - first >= FEWEST_REPEATED:
        graph.repeats.append(Repeat(formal, body, rows.tolist(), results.tolist()))
    return results


def needed_by(
    numbers: Iterable[Number], known: Container[int] = (), of: Callable = operator.attrgetter("of")
) -> list[Number]:
    """Numbers and all their arguments, in the order of evaluation.

    Args:
        numbers: the wanted ones.
        known: places in the graph of known numbers, whose arguments are not needed.
        of: the arguments of a number.
    """
    visited: set[int] = set()
    ordered = []
    for last in numbers:
        waiting = [last]
        while waiting:
            number = waiting[-1]
            missing = [] if number.place in known else [a for a in of(number) if a.place not in visited]
            if number.place in visited or not missing:
                waiting.pop()
                if number.place not in visited:
                    visited.add(number.place)
                    ordered.append(number)
            else:
                waiting.extend(reversed(missing))
    return ordered
