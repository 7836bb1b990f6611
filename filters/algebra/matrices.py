"""Symbolic matrices and vectors: an algorithm written with them is a graph of operations.

`sym(F @ P @ F.T) + Q`, as a textbook writes it, is a function of matrices. Called with NumPy's arrays it computes;
called with a `Matrix` it returns the graph of its operations. A graph can be differentiated (`slopes_of`),
evaluated with Numbers in the place of floats (`evaluate`), or written out as calls of functions for its sizes
(`calls`).

An `Operation` has a function of arrays, whose entries may be floats or Numbers, the shape of its result, and its
derivative.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from thruster_env.graphs.graphs import are_unknown, repeated


class Matrix:
    """A matrix (rows, columns), vector (rows,) or number (), the result of an operation.

    Attributes:
        operation: an `Operation`, or the name or place of a given matrix.
        arguments: of the operation, Matrices and other values that can be hashed.
        shape: (rows, columns), (rows,) or ().
        symmetric: whether it equals its transpose.
        member: whether each member of an ensemble has one.
    """

    __array_ufunc__ = None  # an array's operator leaves it to ours
    __slots__ = ("operation", "arguments", "shape", "symmetric", "member", "_made")

    def __init__(self, operation: Any, arguments: tuple = (), shape: tuple = (), symmetric=False, created=None):
        """Only operations, and `input_matrix`, call this."""
        self.operation, self.arguments, self.shape, self.symmetric = operation, arguments, shape, symmetric
        self.member: bool = not getattr(operation, "reduces", False) and any(a.member for a in self.of)
        self._made: dict = {} if created is None else created

    @property
    def of(self) -> tuple[Matrix, ...]:
        """The matrices among the arguments."""
        return tuple(a for a in self.arguments if isinstance(a, Matrix))

    @property
    def T(self) -> Matrix:
        """The transpose."""
        return self if self.symmetric else self.arguments[0] if self.operation is transposed else transposed(self)

    def __repr__(self) -> str:
        name = getattr(self.operation, "name", self.operation)
        return f"<{name} {'x'.join(map(str, self.shape))}>"

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, index):
        raise TypeError(
            "a page must be written without entries, by the operations of filters.algebra,"
            f" but it takes {index!r} of {self!r}"
        )

    def __iter__(self):
        raise TypeError(f"a page must be written without entries, but it goes through those of {self!r}")

    def __bool__(self):
        raise TypeError(f"a page must not branch on values, but it asks whether {self!r} is true")

    def __array__(self, *arguments, **options):
        raise TypeError(
            "a page must call the operations of filters.algebra, as divide(C, S) for C S^-1,"
            f" not functions of NumPy, but it calls one with {self!r}"
        )

    def __lt__(self, other):
        raise TypeError(
            "a page must choose by operations, choose(exceeds(a, value), b, c), at_least or at_most, "
            f"but it compares {self!r} with {other!r}"
        )

    __gt__ = __le__ = __ge__ = __lt__

    def __add__(self, other):
        return add(self, other) if isinstance(other, Matrix) else shifted(self, _number(other))

    __radd__ = __add__

    def __sub__(self, other):
        return subtract(self, other) if isinstance(other, Matrix) else shifted(self, -_number(other))

    def __rsub__(self, other):
        return -self + other

    def __matmul__(self, other):
        return multiply(self, other)

    def __mul__(self, factor):
        if not isinstance(factor, Matrix):
            return scale(self, _number(factor))
        return entries_product(self, factor) if factor.shape else scale(self, factor)

    __rmul__ = __mul__

    def __truediv__(self, other):
        if isinstance(other, Matrix) and len(other.shape) == 2 and other.symmetric:
            raise TypeError(
                f"a page must write C S^-1 as divide(C, S), as / divides each entry, but got {other!r}"
            )
        return self * (reciprocal(other) if isinstance(other, Matrix) else 1.0 / other)

    def __rtruediv__(self, other):
        return reciprocal(self) * other

    def __pow__(self, exponent):
        if len(self.shape) == 2 and exponent < 0:
            raise TypeError(f"a page must write C S^-1 as divide(C, S), as ** raises each entry, but got {self!r}")
        return power(self, exponent)

    def __abs__(self):
        return magnitude(self)

    def __neg__(self):
        return scale(self, -1.0)


def _number(value: Any) -> float:
    try:
        return float(value)
    except TypeError:
        rule = "a page must calculate with numbers and matrices of its own (eye(P) is the identity)"
        raise TypeError(f"{rule}, but got {value!r}") from None


class Operation:
    """An operation on matrices; called with arrays it computes at once."""

    def __init__(self, compute: Callable, shape: Callable, symmetric: Callable, *, reduces: bool = False):
        """`operation` calls this, and so do the functions of a model."""
        self.compute, self.shape, self.symmetric, self.reduces = compute, shape, symmetric, reduces
        self.name, self.__doc__ = compute.__name__, compute.__doc__
        self.slope: Callable = self._no_rule

    def __call__(self, *arguments):
        """The result, or a Matrix that stands for it."""
        known = next((a for a in arguments if isinstance(a, Matrix)), None)
        if known is None:
            return self.compute(*arguments)
        created, key = known._made, (self, *arguments)
        if key not in created:
            shapes = [a.shape if isinstance(a, Matrix) else a for a in arguments]
            created[key] = Matrix(self, arguments, self.shape(*shapes), self.symmetric(*arguments), created)
        return created[key]

    def _no_rule(self, *_) -> Matrix:
        raise TypeError(f"there is no derivative of {self.name}")

    def derivative(self, rule: Callable) -> Callable:
        """Decorate rule(result, arguments, slopes), the slope of the result; None stands for a slope of zero."""
        self.slope = rule
        return rule


def never(*arguments) -> bool:
    """Return False: the `symmetric` of operations whose results are not symmetric."""
    return False


def operation(shape: Callable, symmetric: Callable = never, *, reduces: bool = False) -> Callable:
    """Decorate a function of arrays.

    Args:
        shape: of the result, a function of the arguments' shapes, and of arguments that are no matrices.
        symmetric: whether the result is, a function of the arguments.
        reduces: whether the result is one for all members of an ensemble, such as their mean.
    """
    return lambda compute: Operation(compute, shape, symmetric, reduces=reduces)


def input_matrix(
    name: Any, shape: tuple[int, ...], *, symmetric: bool = False, member: bool = False, like: Matrix | None = None
) -> Matrix:
    """An input of a graph, called `name`; `like` is another matrix of the same graph."""
    matrix = Matrix(name, (), shape, symmetric, None if like is None else like._made)
    matrix.member = member
    return matrix


def same(shape, *shapes):
    """The shape of the first argument."""
    return shape


def alike(shape, other):
    """The shape of two arguments of one shape; TypeError if they differ."""
    if shape != other:
        raise TypeError(
            f"a page must add, subtract and multiply by entries of one shape, but got {shape} and {other}"
        )
    return shape


def of_product(a, b):
    """The shape of a product; TypeError if rows and columns do not match."""
    if not a or not b or a[-1] != b[0]:
        raise TypeError(f"a page must multiply by @ as many columns as there are rows, but got {a} @ {b}")
    return *a[:-1], *b[1:]


@operation(alike, symmetric=lambda a, b: a.symmetric and b.symmetric)
def add(a, b):
    """The sum a + b."""
    return a + b


@operation(alike, symmetric=lambda a, b: a.symmetric and b.symmetric)
def subtract(a, b):
    """The difference a - b."""
    return a - b


@operation(same, symmetric=lambda a, factor: a.symmetric)
def scale(a, factor):
    """A matrix times a number."""
    return a * factor


@operation(alike)
def entries_product(a, b):
    """The products of the entries of two vectors, or of two matrices."""
    return a * b


@operation(same)
def shifted(a, value):
    """A number, or each entry, plus the float `value`."""
    return a + value


@operation(same)
def reciprocal(a):
    """1/a of a number, or of each entry."""
    return 1.0 / a


@operation(same)
def power(a, exponent):
    """A number, or each entry, to the power of the float `exponent`."""
    return a**exponent


@operation(same)
def magnitude(a):
    """The absolute value of a number, or of each entry."""
    return abs(a)


@operation(lambda shape: shape[::-1])
def transposed(a):
    """The transpose a'."""
    return a.T


@operation(of_product)
def multiply(a, b):
    """The product a b; its derivative is in `operations`, with that of quotients."""
    if a.ndim < 2 or b.ndim < 2 or a.dtype != object or b.dtype != object:
        return a @ b
    return repeated(lambda column: a @ column, b.T).T if are_unknown(b) else repeated(lambda row: row @ b, a)


def plus(*slopes: Matrix | None) -> Matrix | None:
    """The sum of slopes; None is zero."""
    moving = [slope for slope in slopes if slope is not None]
    return sum(moving[1:], moving[0]) if moving else None


def minus(first: Matrix | None, second: Matrix | None) -> Matrix | None:
    """The difference of two slopes; None is zero."""
    return (
        first - second if first is not None and second is not None else plus(first, through(lambda a: -a, second))
    )


def through(operate: Callable, *arguments) -> Matrix | None:
    """An operation that is linear in each argument; None, which is zero, if an argument is None."""
    return None if any(a is None for a in arguments) else operate(*arguments)


add.derivative(lambda result, arguments, slopes: plus(*slopes))
subtract.derivative(lambda result, arguments, slopes: minus(*slopes))


@scale.derivative
def _of_multiple(result, arguments, slopes):
    (a, factor), (da, df) = arguments, (*slopes, None)[:2]
    return plus(through(lambda slope: slope * factor, da), through(lambda slope: a * slope, df))


transposed.derivative(lambda result, arguments, slopes: through(lambda slope: slope.T, slopes[0]))


def evaluate(wanted: Sequence[Matrix], known: dict[Matrix, Any]) -> list:
    """Values of matrices from those of the given ones: arrays of floats or of Numbers."""
    values = dict(known)
    for matrix in in_order(wanted, known):
        if matrix not in values:
            arguments = (values[a] if isinstance(a, Matrix) else a for a in matrix.arguments)
            values[matrix] = matrix.operation.compute(*arguments)
    return [values[matrix] for matrix in wanted]


def in_order(wanted: Sequence[Matrix], known=(), of: Callable = lambda matrix: matrix.of) -> list[Matrix]:
    """Matrices and all on which they depend, each after its arguments.

    Args:
        wanted: the matrices.
        known: matrices whose arguments are left out.
        of: the arguments of a matrix.
    """
    order: dict[Matrix, None] = {}

    def visit(matrix: Matrix) -> None:
        if matrix not in order:
            for argument in () if matrix in known else of(matrix):
                visit(argument)
            order[matrix] = None

    for matrix in wanted:
        visit(matrix)
    return list(order)
