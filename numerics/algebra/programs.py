"""A graph of numbers that reads and writes rows of memory, for some runs side by side: a program without branches.

It is the same for all runs, so that one instruction works for eight of them. Compiled code has it as machine
instructions (`instructions`). Elsewhere its text runs as Python, with NumPy's arrays in the places of registers:

    t0 = +rows[0]
    t1 = numbers[4]
    t2 = t0 * t1
    rows[5] = t2

Which program a compiled function contains is told by a digest of that text. It is part of the key under which
machine code is kept, and the same in each process: no order in it depends on addresses or hashes.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from numerics.algebra.graphs import Number, needed_by
from numerics.compiled import overloaded, when_compiling

ARRAYS = ("rows", "change", "numbers", "move")  # arguments of each program
SIDE_BY_SIDE = (
    "rows",
    "change",
)  # of these, those with a number for each run, one behind the other, at each place
DECISIONS = ("<", "<=", ">", ">=", "==", "!=", "and")  # operations whose results are no floats
SPECIAL = {"negative": "-{}", "pow": "{} ** {}", "and": "{} & {}"}


class Place(NamedTuple):
    """Where a number lies."""

    array: str
    at: int

    def __str__(self) -> str:
        return f"{self.array}[{self.at}]"


class Program(NamedTuple):
    """Numbers that are read, worked out, and stored."""

    reads: list[tuple[Place, Number]]
    works: list[Number]
    stores: list[tuple[Place, Number]]

    @property
    def text(self) -> list[str]:
        """A line for each number."""
        names = {one.place: f"t{k}" for k, one in enumerate([*(one for _, one in self.reads), *self.works])}
        lines = [f"{names[one.place]} = {'+' * (place.array in SIDE_BY_SIDE)}{place}" for place, one in self.reads]
        for one in self.works:
            values = [names[a.place] if isinstance(a, Number) else a for a in one.arguments]
            lines.append(f"{names[one.place]} = {_expression(one.operation, values)}")
        return lines + [f"{place} = {names[one.place]}" for place, one in self.stores]

    @property
    def operations(self) -> int:
        """How many operations it has."""
        return len(self.works)


def _expression(operation: str, values: list[str]) -> str:
    if operation == "constant":
        return f"float.fromhex({values[0]!r})"
    if operation in SPECIAL:
        return SPECIAL[operation].format(*values)
    known = len(values) == 2 and not operation.isalnum()
    return f" {operation} ".join(values) if known else f"{operation}({', '.join(values)})"


def program_of(stores: Sequence[tuple[Place, Number]], known: Mapping[int, Place]) -> Program:
    """The program that makes some stores, of numbers that are given by their places.

    Args:
        stores: what is to be stored, and where.
        known: where numbers lie that another program has worked out, by their places in the graph.
    """
    reads, works = [], []
    for one in needed_by([number for _, number in stores], known):
        if one.operation == "given" or one.place in known:
            reads.append((known.get(one.place) or one.arguments[0], one))
        else:
            works.append(one)
    return Program(reads, works, list(stores))


def values_of(numbers: Sequence[Number], given: np.ndarray) -> np.ndarray:
    """Values of numbers, of the values of those that are given in the array `numbers`."""
    rows = np.empty((len(numbers), 1))
    program = program_of([(Place("rows", k), one) for k, one in enumerate(numbers)], {})
    _in_python(program.text)(rows, rows, given, given)
    return rows[:, 0]


def callable_of(program: Program, width: int) -> Callable:
    """`work(rows, change, numbers, move)`, which does it for `width` runs; compiled functions may call it, too."""
    lines = program.text
    digest = hashlib.sha256("\n".join([str(width), *lines]).encode()).hexdigest()[:24]
    _TEXTS[digest] = lines
    names: dict = {"run": _run, "__name__": __name__}  # what the cache of machine code sees is the digest alone
    exec(f"def work({', '.join(ARRAYS)}):\n    run('{digest}', {width}, {', '.join(ARRAYS)})\n", names)
    work = overloaded(names["work"])
    when_compiling(lambda: _teach(work, program, width))
    return work


_TEXTS: dict[str, list[str]] = {}
_IN_PYTHON: dict[str, Callable] = {}


def _run(digest: str, width: int, rows, change, numbers, move) -> None:
    """Run a program as Python."""
    if digest not in _IN_PYTHON:
        _IN_PYTHON[digest] = _in_python(_TEXTS[digest])
    _IN_PYTHON[digest](rows.reshape(-1, width), change.reshape(-1, width), numbers, move)


def _in_python(text: list[str]) -> Callable:
    names: dict = {**vars(np)}
    lines = "".join(f"    {line}\n" for line in text or ["pass"])
    exec(f"def work({', '.join(ARRAYS)}):\n{lines}", names)
    return names["work"]


def _teach(work: Callable, program: Program, width: int) -> None:
    from numerics.algebra.instructions import teach  # which imports numba

    teach(work, program, width)
