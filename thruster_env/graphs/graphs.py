"""Numbers that are not known yet: what is done with them builds a graph, in which everything is worked out once.

A `Number` stands for a float64. Operators and NumPy's functions of Numbers return Numbers, so that a plain
function of floats, called with Numbers, writes down what it computes:

    graph = Graph()
    x, y = graph.given("x"), graph.given("y")
    x * y + x * y        # one product, and one sum of it with itself
    0.0 * x + 1.0 * y    # y itself

Three things keep the graph small. An operation on the same arguments is there already (`Graph.make`), products
and sums in either order. What constants make is a constant, and zeros and ones of a matrix's structure vanish.
A page's division by a number is a product with its reciprocal, of which there is one. Within `Graph.as_written`,
where the functions of a model are traced, a division is one: 49/49 is 1, and 49 * (1/49) is less.

A comparison is a condition. In arithmetic it is 1.0 or 0.0, as in Python. What a Number cannot do is decide:
`if x > 0.0` raises TypeError, unless both sides are asked for (`branches`). `where(condition, a, b)` works out
both sides.
"""

from __future__ import annotations

import gc
import math
import operator
from collections.abc import Callable, Container, Hashable, Iterable, Iterator
from contextlib import contextmanager

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
    *(
        "sqrt",
        "exp",
        "log",
        "sin",
        "cos",
        "tan",
        "arctan",
        "tanh",
        "sinh",
        "cosh",
        "floor",
        "ceil",
        "cbrt",
        "exp2",
    ),
    *("expm1", "log1p", "log2", "log10", "arcsinh", "arccosh", "arctanh", "erf", "erfc"),
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
        self.whole: set[int] = set()  # places of numbers that are not taken apart, as along them slopes are taken
        self.exact = False  # whether a model's function is being traced: see `as_written`
        self._made: dict[tuple, Number] = {}
        self._most = most

    def make(self, operation: str, *arguments: Number | Hashable) -> Number:
        """The number that an operation makes of others; the same one if it has been made before."""
        key = (operation, *[a.place if isinstance(a, Number) else a for a in arguments])
        found = self._made.get(key)
        if found is None:
            if len(self.numbers) >= self._most:
                raise TooLarge(f"a graph must have at most {self._most} operations")
            found = self._made[key] = Number(self, operation, arguments, len(self.numbers))
            if operation in TWO_SIDED:
                self._made[(operation, key[2], key[1])] = found
            self.numbers.append(found)
        if self.exact and operation in JUMPS:
            self._round_as_written(found)
        return found

    @contextmanager
    def as_written(self) -> Iterator[None]:
        """Within this context numbers are those of Python: divisions, and all on which a jump depends."""
        was, self.exact = self.exact, True
        try:
            yield
        finally:
            self.exact = was

    def _round_as_written(self, jump: Number) -> None:
        """Have machine code neither reorder nor contract what a jump is made of, up to a function's arguments."""
        waiting = [jump]
        while waiting:
            one = waiting.pop()
            if not one.exact and one.place not in self.whole and one.operation not in ("given", "constant"):
                one.exact = True
                waiting += one.of

    def given(self, name: Hashable, *, member: bool = False) -> Number:
        """A number that is known when the graph is worked out: its name, or where it lies."""
        found = self.make("given", name)
        found.member = member
        return found

    def constant(self, value: float) -> Number:
        """A number that is known now."""
        return self.make("constant", float(value).hex())

    def number(self, value: Number | float) -> Number:
        """A number, known now or not; a condition as 1.0 or 0.0."""
        return as_number(value) if isinstance(value, Number) else self.constant(value)


class Number:
    """A float64 that an operation makes of others.

    Attributes:
        operation, arguments: what makes it, and of what: Numbers, or the name or value of one that is known.
        of: the Numbers among the arguments.
        place: its index in the graph.
        value: what a constant is; None for others.
        member: whether it is one number for each member of an ensemble.
        may_overflow, sign: what is known of its size, as `magnitudes` says.
        exact: whether machine code rounds it as Python does.
    """

    __slots__ = (
        "graph",
        "operation",
        "arguments",
        "of",
        "place",
        "value",
        "member",
        "may_overflow",
        "sign",
        "exact",
    )
    sqrt: Callable[[], Number]  # and so on, as UNARY has them
    log: Callable[[], Number]
    floor: Callable[[], Number]
    __hash__ = None  # type: ignore[assignment]  # a dictionary of a user's would be asked for a value not known yet

    def __init__(self, graph: Graph, operation: str, arguments: tuple, place: int):
        """For `Graph.make` alone."""
        self.graph, self.operation, self.arguments, self.place = graph, operation, arguments, place
        self.of: tuple[Number, ...] = tuple([a for a in arguments if isinstance(a, Number)])
        self.value = float.fromhex(arguments[0]) if operation == "constant" else None
        self.member: bool = operation not in REDUCTIONS and any([a.member for a in self.of])
        self.may_overflow, self.sign = overflow_of(operation, self.of), sign_of(operation, self.of, self.value)
        self.exact = False

    def __repr__(self) -> str:
        return f"<number {self.place}: {self.operation}>"

    def __format__(self, spec: str) -> str:
        return repr(self)  # of a message, which nobody reads: what makes a float of it raises TypeError

    def __bool__(self) -> bool:
        if self.graph.decide is None:
            raise TypeError("a traced value has no truth value: use where(condition, a, b)")
        return self.graph.decide(self)

    @property
    def is_condition(self) -> bool:
        """Whether it is true or false, and no float yet."""
        return self.operation in CONDITIONS

    def _with(self, other) -> Number | None:
        """The other one as a Number of this graph; None where it is no number."""
        if isinstance(other, Number):
            return as_number(other)
        return self.graph.constant(other) if isinstance(other, (int, float)) or _is_scalar(other) else None

    def _of_two(self, work: Callable, other, turned: bool = False):
        """What an operation makes of this number and another one, or of the two in turn."""
        if (b := self._with(other)) is None:
            return NotImplemented
        return work(b, as_number(self)) if turned else work(as_number(self), b)

    def __add__(self, other):
        return self._of_two(total, other)

    def __radd__(self, other):
        return self._of_two(total, other, turned=True)

    def __sub__(self, other):
        return self._of_two(difference, other)

    def __rsub__(self, other):
        return self._of_two(difference, other, turned=True)

    def __mul__(self, other):
        return self._of_two(product, other)

    def __rmul__(self, other):
        return self._of_two(product, other, turned=True)

    def __truediv__(self, other):
        return self._of_two(_over, other)

    def __rtruediv__(self, other):
        return self._of_two(_over, other, turned=True)

    def __mod__(self, other):
        return self._of_two(modulus, other)

    def __rmod__(self, other):
        return self._of_two(modulus, other, turned=True)

    def __floordiv__(self, other):
        return self._of_two(floor_quotient, other)

    def __rfloordiv__(self, other):
        return self._of_two(floor_quotient, other, turned=True)

    def __lt__(self, other):
        return self._compared("<", other)

    def __le__(self, other):
        return self._compared("<=", other)

    def __gt__(self, other):
        return self._compared(">", other)

    def __ge__(self, other):
        return self._compared(">=", other)

    def __eq__(self, other):
        return False if (found := self._compared("==", other)) is NotImplemented else found

    def __ne__(self, other):
        return True if (found := self._compared("!=", other)) is NotImplemented else found

    def _compared(self, operation: str, other):
        """A condition; of numbers that are known now whether it holds."""
        if (b := self._with(other)) is None:
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
            found = math.prod([self] * int(abs(power)))
            return found if power > 0 else 1.0 / found
        one = self.graph.constant(1.0)
        return one if power == 0 else worked_out("pow", self, self.graph.constant(power))

    def __rpow__(self, base):
        return self._with(base) ** self

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


def _over(a: Number, b: Number) -> Number:
    return divided(a, b) if a.graph.exact else quotient(a, b)


def _is_scalar(value) -> bool:
    return isinstance(value, np.generic) or isinstance(value, np.ndarray) and not value.shape


def where(condition, a, b):
    """`a` where the condition holds, else `b`, of numbers known or not; both are worked out."""
    known = next((one for one in (condition, a, b) if isinstance(one, Number)), None)
    if not isinstance(condition, Number):
        return a if condition else b
    if condition.value is not None:
        return a if condition.value else b
    if not condition.is_condition:
        condition = condition != 0.0
    a, b = known._with(a), known._with(b)  # type: ignore[union-attr]
    return a if a is b else condition.graph.make("where", condition, a, b)


def arctan2(y, x):
    """The angle of a point (x, y), of numbers known or not."""
    known = next((one for one in (y, x) if isinstance(one, Number)), None)
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
    """What a function that is compiled as it is makes of numbers; its name is that in `programs.CALLED`."""
    graph = numbers[0].graph
    call = graph.make("call", name, count, *numbers)
    return [graph.make("entry", call, k) for k in range(count)]


def needed_by(numbers: Iterable[Number], known: Container[int] = ()) -> list[Number]:
    """Numbers and all that they are made of, in an order in which to work them out.

    Args:
        numbers: that are wanted.
        known: places in the graph of numbers that are known; what they are made of is not needed.
    """
    seen: set[int] = set()
    found = []
    for last in numbers:
        waiting = [last]
        while waiting:
            number = waiting[-1]
            missing = [] if number.place in known else [one for one in number.of if one.place not in seen]
            if number.place in seen or not missing:
                waiting.pop()
                if number.place not in seen:
                    seen.add(number.place)
                    found.append(number)
            else:
                waiting.extend(reversed(missing))
    return found
