"""Source text of functions for fixed sizes: written out by entries where that is short, else loops over arrays.

A function is described once, as the entries of its result and the sums in them. Small, it is written out, as
`collections.namedtuple` does for its classes: vectors are tuples of components, matrices tuples of rows, which the
compiler keeps in registers. Large, the same description becomes loops over float64 arrays, whose text does not
grow with the size. Which of the two a value is depends on its shape alone, so that all functions agree on it.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Sequence

import numpy as np

from thruster_env.core.written import matrix_of, tuple_of, written_out

LARGEST_TUPLE = 36  # entries of a vector or matrix that is a tuple: as many have nine sigma points of four states
LARGEST_SIDE = 5  # of a matrix that is one
LONGEST_TEXT = 128  # products that are written out: those of two matrices of five rows


def is_array(*shape: int) -> bool:
    """Whether a vector (count,) or matrix (rows, columns) is a float64 array and no tuple."""
    return int(np.prod(shape)) > LARGEST_TUPLE or (len(shape) == 2 and min(shape) > LARGEST_SIDE)


def as_value(values) -> tuple | np.ndarray:
    """A vector of numbers in the form that functions take: a tuple of them, or an array if it is large."""
    return np.asarray(values) if is_array(len(values)) else tuple(values)


def lower_pairs(size: int) -> list[tuple[int, int]]:
    """Places (i, j) on and below the diagonal."""
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
    """Numbers that a function works out, one for each place: names of their own, or an array."""

    def __init__(self, name: str, shape: tuple[int, ...], loops: bool):
        self.name, self.shape, self._loops = name, shape, loops

    def __getitem__(self, place) -> str:
        """Source of the number at a place i or (i, j)."""
        places = place if isinstance(place, tuple) else (place,)
        if self._loops:
            return f"{self.name}[{', '.join(map(str, places))}]"
        return self.name + "_".join(map(str, places))


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
        if unknown := set(shapes) - {one.strip() for one in arguments.split(",")}:
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
        """Loops read arrays: one is made of an argument that is a tuple."""
        name = argument
        if not is_array(*shape):
            name = f"{argument}_"
            self._lines.append(f"{name} = np.empty({shape})")
            for place in np.ndindex(*shape):
                at = "".join(f"[{i}]" for i in place)
                self._lines.append(f"{name}[{', '.join(map(str, place))}] = {argument}{at}")
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

    def totals(self, size: str, places, term: Callable, each: Iterable[str] = ()) -> Local:
        """Sums of terms over members j < size, one for each place.

        Args:
            size: source of the number of members.
            places: number of places i, or pairs (i, j) of them.
            term: term(i) or term(i, j) is the source of a term.
            each: lines that come first for each member, where the function is written out.
        """
        if self.loops:
            out = self.local("s", places)
            for i in self.range(places):
                self.line("total = 0.0")
                self.line(f"for j in range({size}):")
                self.line(f"    total += {term(i)}")
                self.line(f"{out[i]} = total")
            return out
        places = [(i,) for i in range(places)] if isinstance(places, int) else places
        out = Local("s", tuple(max(place) + 1 for place in zip(*places, strict=True)), False)
        for place in places:
            self.line(f"{out[place]} = 0.0")
        for _ in self.inside(f"for j in range({size}):"):
            for text in each:
                self.line(text)
            for place in places:
                self.line(f"{out[place]} += {term(*place)}")
        return out

    def array_of(self, argument: str) -> str:
        """In loops, the name of the array that holds an argument."""
        return self._renamed.get(argument, argument)

    def local(self, name: str, *shape: int) -> Local:
        """Numbers to be worked out, one a place; zero at first in an array."""
        if self.loops:
            self.line(f"{name} = np.zeros({shape})")
        return Local(name, shape, self.loops)

    def sum(self, terms: Iterable[str]) -> str:
        """Source of the sum of terms, whose indices come from `range`; "0.0" if there is none."""
        return self._total("0.0", "+", terms) if self.loops else " + ".join(terms) or "0.0"

    def less(self, first: str, terms: Iterable[str], sign: str = "-") -> str:
        """Source of what is left of the first after all terms, or of the first and all terms with sign="+"."""
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
        return self.whole(out)

    def matrix(self, rows: int, columns: int, entry: Callable) -> str:
        """Source of a matrix whose entries have the sources entry(i, j)."""
        if not self.loops:
            return matrix_of(rows, columns, entry)
        out = self.local(f"{self._fresh('m')}", rows, columns)
        for i in self.range(rows):
            for j in self.range(columns):
                self.line(f"{out[i, j]} = {entry(i, j)}")
        return self.whole(out)

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

    def whole(self, local: Local) -> str:
        """Source of a vector or matrix of numbers worked out, of those on and below the diagonal if ..."""
        return self._value(local, lambda i, j: local[i, j])

    def lower(self, local: Local) -> str:
        """... others are zero: they must not have been set."""
        return self._value(local, lambda i, j: local[i, j] if j <= i else "0.0")

    def mirrored(self, local: Local) -> str:
        """Source of a symmetric matrix of which entries on and below the diagonal have been set."""
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
        return written_out(self._name, self._arguments, *lines, _loops=self.loops, **self._names, **names)


def entrywise(
    name: str, arguments: str, shape: tuple[int, ...], entry: Callable, *, work: int = 0, **shapes: tuple[int, ...]
) -> Callable:
    """Return the function of a vector or matrix whose entries have the sources entry(i) or entry(i, j)."""
    source = Source(name, arguments, result=shape, work=work, **shapes)
    return source.function(source.entries(shape, entry))
