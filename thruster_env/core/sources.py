"""Source text of functions for fixed sizes: written out by entries where that is short, else loops over arrays.

A function is described once, as the entries of its result and the sums in them. Small, it is written out, as
`collections.namedtuple` does for its classes: vectors are tuples of components, matrices tuples of rows, which the
compiler keeps in registers. Large, the same description becomes loops over float64 arrays, whose text does not
grow with the size. Which of the two a value is depends on its shape alone, so that all functions agree on it.
"""

from __future__ import annotations

import linecache
import re
import sys
import weakref
import zlib
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache

import numpy as np

_shown: Counter[str] = Counter()  # files of texts, with the number of functions made of each
_MAKERS = (__name__, "thruster_env.core.sources")  # of which the names do not tell anything
LARGEST_TUPLE = 36  # entries of a vector or matrix that is a tuple: as many have nine sigma points of four states
LARGEST_SIDE = 5  # of a matrix that is one
LONGEST_TEXT = 128  # products that are written out: those of two matrices of five rows


# Functions made of source text, which tracebacks and debuggers show under names that say their sizes.


def tuple_of(expressions: Iterable[str]) -> str:
    """Source of a tuple with the given expressions."""
    return "(" + "".join(f"{expression}, " for expression in expressions) + ")"


def matrix_of(rows: int, columns: int, entry: Callable[[int, int], str]) -> str:
    """Source of a matrix, a tuple of rows, whose entries have the sources entry(i, j)."""
    return tuple_of(tuple_of(entry(i, j) for j in range(columns)) for i in range(rows))


def written_out(name: str, arguments: str, *lines: str, **names) -> Callable:
    """Make a function from source lines, whose last is the expression it returns; `names` are its globals.

    Tracebacks and debuggers show the source, under a name that says who made it, and for which sizes.
    """
    names["__name__"] = __name__
    body = "".join(f"    {line}\n" for line in (*lines[:-1], f"return {lines[-1]}"))
    text = f"def {name}({arguments}):\n{body}"
    file = _name_in_tracebacks(name, text)
    exec(compile(text, file, "exec"), names)
    function = names[name]
    _shown[file] += 1
    weakref.finalize(function, _forget, file).atexit = False
    return function


def _forget(file: str) -> None:
    _shown[file] -= 1
    if not _shown[file]:
        del _shown[file]
        linecache.cache.pop(file, None)


def _name_in_tracebacks(name: str, text: str) -> str:
    """A file name for a text, under which `linecache` finds it.

    The name has a digest of the text, and no counter, which would depend on what the process has generated before.
    """
    frame = sys._getframe(2)
    while frame.f_globals.get("__name__") in _MAKERS and frame.f_back is not None:
        frame = frame.f_back
    code, values = frame.f_code, frame.f_locals
    sizes = (values.get(argument) for argument in code.co_varnames[: code.co_argcount])
    size_list = ", ".join(str(size) for size in sizes if type(size) is int)
    maker, digest = f"{frame.f_globals.get('__name__')}.{code.co_name}({size_list})", zlib.crc32(text.encode())
    file = f"<{name}, written out by {maker}, {digest:08x}>"
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    return file


def made_here(function: Callable) -> bool:
    """Whether a function was generated, so that it returns large results as arrays."""
    return getattr(function, "__module__", None) == __name__


def is_array(*shape: int) -> bool:
    """Whether a vector (count,) or matrix (rows, columns) of this size is a float64 array, not a tuple."""
    return int(np.prod(shape)) > LARGEST_TUPLE or (len(shape) == 2 and min(shape) > LARGEST_SIDE)


def as_value(values) -> tuple | np.ndarray:
    """A vector in the form that functions take: a tuple, or an array if it is large."""
    return np.asarray(values) if is_array(len(values)) else tuple(values)


def lower_pairs(size: int) -> list[tuple[int, int]]:
    """Indices (i, j) on and below the diagonal."""
    return [(i, j) for i in range(size) for j in range(i + 1)]


class Index(str):
    """The name of a loop's index, with which one may count as with a number."""

    def __add__(self, other) -> Index:
        return Index(f"({self} + {other})") if other != 0 else self

    def __sub__(self, other) -> Index:
        return Index(f"({self} - {other})")

    __radd__ = __add__

    def __mul__(self, other) -> Index:
        return Index(f"({self} * {other})")


class Local:
    """A function's local vector or matrix: a variable for each entry, or an array."""

    def __init__(self, name: str, shape: tuple[int, ...], loops: bool):
        self.name, self.shape, self._loops = name, shape, loops

    def __getitem__(self, index) -> str:
        """Source of the entry i or (i, j)."""
        indices = index if isinstance(index, tuple) else (index,)
        if self._loops:
            return f"{self.name}[{', '.join(map(str, indices))}]"
        return self.name + "_".join(map(str, indices))


class Source:
    """The text of one function, line by line, in the form that its sizes ask for.

    Attributes:
        loops: whether it has loops over arrays.
    """

    def __init__(self, name: str, arguments: str, *, result: tuple[int, ...] = (), work: int = 0, **shapes):
        """Begin with the function's name and arguments.

        Args:
            name: of the function.
            arguments: their names, comma separated.
            result: shape of the vector or matrix that it returns; empty for others.
            work: how many products it would be written out as.
            shapes: of those arguments that are vectors or matrices.

        Raises:
            ValueError: if a shape is of no argument.
        """
        if unknown := set(shapes) - {argument.strip() for argument in arguments.split(",")}:
            raise ValueError(f"{name}({arguments}) has no argument {', '.join(sorted(unknown))}")
        self._name, self._arguments, self._result = name, arguments, result
        self.loops = work > LONGEST_TEXT or any(is_array(*shape) for shape in (result, *shapes.values()) if shape)
        self._lines: list[str] = []
        self._depth = self._count = 0
        self._matrices: set[str] = set()
        self._names: dict = {"np": np} if self.loops else {}
        self._renamed: dict[str, str] = {}
        if self.loops:
            for argument, shape in shapes.items():
                self._as_array(argument, shape)

    def _as_array(self, argument: str, shape: tuple[int, ...]) -> None:
        """Copy an argument that is a tuple into an array, because loops read arrays."""
        name = argument
        if not is_array(*shape):
            name = f"{argument}_"
            self._lines.append(f"{name} = np.empty({shape})")
            for index in np.ndindex(*shape):
                at = "".join(f"[{i}]" for i in index)
                self._lines.append(f"{name}[{', '.join(map(str, index))}] = {argument}{at}")
            self._renamed[argument] = name
        if len(shape) == 2:
            self._matrices.add(name)

    def line(self, text: str) -> None:
        """Add a line."""
        self._lines.append("    " * self._depth + self._rewritten(text))

    def _rewritten(self, text: str) -> str:
        if not self.loops:
            return text
        for argument, name in self._renamed.items():
            text = re.sub(rf"\b{argument}(?=\[)", name, text)
        for name in self._matrices:
            text = re.sub(rf"\b{name}\[([^\[\]]+)\]\[([^\[\]]+)\]", rf"{name}[\1, \2]", text)
        return text

    def _fresh(self, letter: str) -> Index:
        self._count += 1
        return Index(f"{letter}{self._count}_")

    def range(self, *bounds) -> Iterator:
        """Numbers as `range` has them; in loops one index, and lines added meanwhile are the body of its loop."""
        if not self.loops:
            yield from range(*bounds)
            return
        yield from self._each(f"range({', '.join(map(str, bounds))})")

    def among(self, numbers: Sequence[int]) -> Iterator:
        """Numbers one after the other, at least one; in loops one index as by `range`."""
        if not self.loops:
            yield from numbers
            return
        yield from self._each(str(tuple(numbers)))

    def _each(self, numbers: str) -> Iterator[Index]:
        index = self._fresh("i")
        self.line(f"for {index} in {numbers}:")
        self._depth += 1
        yield index
        self._depth -= 1

    def reversed(self, count: int) -> Iterator:
        """Numbers count - 1 ... 0."""
        return self.range(count - 1, -1, -1)

    def inside(self, opening: str) -> Iterator[None]:
        """Once; lines added meanwhile are within a block that `opening` opens, in both forms."""
        self.line(opening)
        self._depth += 1
        yield
        self._depth -= 1

    def totals(self, size: str, entries, term: Callable, each: Iterable[str] = ()) -> Local:
        """Sums of terms over members j < size, one for each entry.

        Args:
            size: source of the number of members.
            entries: number of entries i, or their indices (i, j).
            term: term(i) or term(i, j) is the source of a term.
            each: lines that come first for each member, where the function is written out.
        """
        if self.loops:
            out = self.local("s", entries)
            for i in self.range(entries):
                self.line("total = 0.0")
                self.line(f"for j in range({size}):")
                self.line(f"    total += {term(i)}")
                self.line(f"{out[i]} = total")
            return out
        entries = [(i,) for i in range(entries)] if isinstance(entries, int) else entries
        out = Local("s", tuple(max(entry) + 1 for entry in zip(*entries, strict=True)), False)
        for entry in entries:
            self.line(f"{out[entry]} = 0.0")
        for _ in self.inside(f"for j in range({size}):"):
            for text in each:
                self.line(text)
            for entry in entries:
                self.line(f"{out[entry]} += {term(*entry)}")
        return out

    def array_of(self, argument: str) -> str:
        """In loops, the name of the array that holds an argument."""
        return self._renamed.get(argument, argument)

    def local(self, name: str, *shape: int) -> Local:
        """A local vector or matrix; if it is an array, it starts at zero."""
        if self.loops:
            self.line(f"{name} = np.zeros({shape})")
        return Local(name, shape, self.loops)

    def sum(self, terms: Iterable[str]) -> str:
        """Source of the sum of terms, whose indices come from `range`; "0.0" if there is none."""
        return self._total("0.0", "+", terms) if self.loops else " + ".join(terms) or "0.0"

    def less(self, first: str, terms: Iterable[str], sign: str = "-") -> str:
        """Source of the first minus all terms, or plus all terms with sign="+"."""
        return self._total(first, sign, terms) if self.loops else first + "".join(f" {sign} {t}" for t in terms)

    def product(self, factors: Iterable[str]) -> str:
        """Source of the product of factors, as `sum` of terms."""
        return self._total("1.0", "*", factors) if self.loops else " * ".join(factors)

    def _total(self, first: str, sign: str, terms: Iterable[str]) -> str:
        total = self._fresh("t")
        self.line(f"{total} = {first}")
        for term in terms:  # one, in the body of the loop that `range` begins when it is asked for
            self.line(f"{total} {sign}= {term}")
        return str(total)

    def if_same(self, i, j, same: str, other: str) -> str:
        """Source of `same` where i = j and of `other` elsewhere."""
        if isinstance(i, Index) or isinstance(j, Index):
            return f"({same} if {i} == {j} else {other})"
        return same if i == j else other

    def vector(self, count: int, entry: Callable) -> str:
        """Source of a vector whose entries have the sources entry(i)."""
        if not self.loops:
            return tuple_of(entry(i) for i in range(count))
        out = self.local(f"{self._fresh('v')}", count)
        for i in self.range(count):
            self.line(f"{out[i]} = {entry(i)}")
        return self.all_entries(out)

    def matrix(self, rows: int, columns: int, entry: Callable) -> str:
        """Source of a matrix whose entries have the sources entry(i, j)."""
        if not self.loops:
            return matrix_of(rows, columns, entry)
        out = self.local(f"{self._fresh('m')}", rows, columns)
        for i in self.range(rows):
            for j in self.range(columns):
                self.line(f"{out[i, j]} = {entry(i, j)}")
        return self.all_entries(out)

    def entries(self, shape: tuple[int, ...], entry: Callable) -> str:
        """Source of a vector or matrix of this shape, as `vector` or `matrix` has it."""
        return self.vector(shape[0], entry) if len(shape) == 1 else self.matrix(shape[0], shape[1], entry)

    def symmetric(self, name: str, size: int, entry: Callable) -> str:
        """Source of a symmetric matrix whose entries on and below the diagonal have the sources entry(i, j)."""
        out = self.local(name, size, size)
        for i in self.range(size):
            for j in self.range(i + 1):
                self.line(f"{out[i, j]} = {entry(i, j)}")
        return self.mirrored(out)

    def all_entries(self, local: Local) -> str:
        """Source of a local vector or matrix, of its lower triangle if ..."""
        return self._value(local, lambda i, j: local[i, j])

    def lower(self, local: Local) -> str:
        """... others are zero: they must not have been set."""
        return self._value(local, lambda i, j: local[i, j] if j <= i else "0.0")

    def mirrored(self, local: Local) -> str:
        """Source of a symmetric matrix whose entries on and below the diagonal have been set."""
        if self.loops:
            for i in self.range(local.shape[0]):
                for j in self.range(i):
                    self.line(f"{local[j, i]} = {local[i, j]}")
        return self._value(local, lambda i, j: local[max(i, j), min(i, j)])

    def _value(self, local: Local, entry: Callable) -> str:
        if self.loops and is_array(*local.shape):
            return local.name
        if len(local.shape) == 1:
            return tuple_of(local[i] for i in range(local.shape[0]))
        rows, columns = local.shape
        return matrix_of(rows, columns, (lambda i, j: local[i, j]) if self.loops else entry)

    def function(self, result: str = "None", **names) -> Callable:
        """The function, which returns the expression `result`; `names` are its globals."""
        lines = *self._lines, self._rewritten(result)
        return written_out(self._name, self._arguments, *lines, **self._names, **names)


def entrywise(
    name: str, arguments: str, shape: tuple[int, ...], entry: Callable, *, work: int = 0, **shapes: tuple[int, ...]
) -> Callable:
    """Return the function of a vector or matrix whose entries have the sources entry(i) or entry(i, j)."""
    source = Source(name, arguments, result=shape, work=work, **shapes)
    return source.function(source.entries(shape, entry))


# Vectors and matrices as tuples: one form that floats, arrays, tensors and machine code all run fast.


@cache
def column_reader(count: int, first: int = 0) -> Callable:
    """Return `column(array, j)`: `count` entries of column j, from row first on, as a tuple."""
    return entrywise("column", "array, j", (count,), lambda i: f"array[{first + i}, j]")


@cache
def column_writer(count: int, first: int = 0) -> Callable:
    """Return `store(array, j, x)`: write the tuple x into rows first, first + 1, ... of column j."""
    source = Source("store", "array, j, x", x=(count,))
    for i in source.range(count):
        source.line(f"array[{first + i}, j] = x[{i}]")
    return source.function()


@cache
def vector_reader(count: int, start: int = 0) -> Callable:
    """Return `read(row)`: entries start ... start + count - 1 of a one-dimensional array as a tuple."""
    return entrywise("read", "row", (count,), lambda i: f"row[{start + i}]")


@cache
def vector_writer(count: int, start: int = 0) -> Callable:
    """Return `store(row, x)`: write the tuple x of `count` components into row[start], row[start + 1], ..."""
    source = Source("store", "row, x", x=(count,))
    for i in source.range(count):
        source.line(f"row[{start + i}] = x[{i}]")
    return source.function()


@cache
def matrix_reader(rows: int, columns: int, start: int = 0) -> Callable:
    """Return `read(row)`: a matrix that lies by rows in row[start], row[start + 1], ..., as a tuple of rows."""
    return entrywise("read", "row", (rows, columns), lambda i, j: f"row[{i * columns + j + start}]")


@cache
def matrix_writer(rows: int, columns: int, start: int = 0) -> Callable:
    """Return `store(row, a)`: write a matrix by rows into row[start], row[start + 1], ..."""
    source = Source("store", "row, a", a=(rows, columns))
    for i in source.range(rows):
        for j in source.range(columns):
            source.line(f"row[{i * columns + j + start}] = a[{i}][{j}]")
    return source.function()


@cache
def scaled_sum(count: int) -> Callable:
    """Return `add(x, a, y)`: the tuple x + a y for tuples of `count` components and a scalar a."""
    if is_array(count):
        return written_out("add", "x, a, y", "x + a * y")  # of any type: also of complex numbers
    return written_out("add", "x, a, y", tuple_of(f"x[{i}] + a * y[{i}]" for i in range(count)))


@cache
def vector_part(count: int, size: int, first: int = 0) -> Callable:
    """Return `part(x)`: `count` components, from index `first` on, of a vector of `size` components."""
    return entrywise("part", "x", (count,), lambda i: f"x[{i + first}]", x=(size,))


@cache
def joiner(first: int, second: int) -> Callable:
    """Return `join(x, y)`: one vector of the components of two."""
    source = Source("join", "x, y", result=(first + second,), x=(first,), y=(second,))
    both = source.local("z", first + second)
    for i in source.range(first):
        source.line(f"{both[i]} = x[{i}]")
    for i in source.range(second):
        source.line(f"{both[i + first]} = y[{i}]")
    return source.function(source.all_entries(both))


def assembled(name: str, arguments: str, shape: tuple[int, int], parts: dict) -> Callable:
    """Return the function of a matrix of a shape that is made of parts, zero elsewhere.

    Args:
        name: of the function.
        arguments: names of the parts, comma separated.
        shape: rows and columns of the result.
        parts: of each part its shape, and the row and column at which it begins.
    """
    source = Source(name, arguments, result=shape, **{part: size for part, (size, _, _) in parts.items()})
    if not source.loops:
        entries = {
            (top + i, left + j): f"{part}[{i}][{j}]"
            for part, (size, top, left) in parts.items()
            for i, j in np.ndindex(*size)
        }
        return source.function(matrix_of(*shape, lambda i, j: entries.get((i, j), "0.0")))
    matrix = source.local("whole", *shape)
    for part, (size, top, left) in parts.items():
        for i in source.range(size[0]):
            for j in source.range(size[1]):
                source.line(f"{matrix[i + top, j + left]} = {part}[{i}][{j}]")
    return source.function(source.all_entries(matrix))


@cache
def zeros_of(*shape: int) -> Callable:
    """Return `zeros()`: a vector (count,) or matrix (rows, columns) of zeros."""
    return entrywise("zeros", "", shape, lambda *index: "0.0")


@cache
def part_of(rows: int, columns: int, shape: tuple[int, int], top: int = 0, left: int = 0) -> Callable:
    """Return `part(a)`: the block (rows, columns) at (top, left) of a matrix of this shape."""
    return entrywise("part", "a", (rows, columns), lambda i, j: f"a[{i + top}][{j + left}]", a=shape)


def fill(out, value):
    """Copy a vector or matrix, in whatever form, into an array."""
    out[...] = value


def as_array(function: Callable, arguments: str, *shape: int) -> Callable:
    """Return a function with the same result as an array, for a function that returns a tuple of this shape."""
    if not is_array(*shape):
        return function
    lines = f"out = np.empty({shape})", f"fill(out, function({arguments}))"
    names = {"function": function, "fill": fill, "np": np}
    return written_out("array_valued", arguments, *lines, "out", **names)
