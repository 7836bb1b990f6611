"""A plant as a page: two pure functions of numbers, traced and run for any number of copies side by side.

    memory, report = begin(p, t)                    an episode starts
    memory, report = step(p, memory, action, t)     a sample time passes

p are the plant's parameters, t the moment (`effects.effects.Moment`), memory what a copy keeps until the next
step, and the report what an env shows: all nested tuples of numbers (`graphs.values`). Entries of the report may
be "reward", "terminated" and "time"; the env names the others.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import lru_cache
from itertools import count
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from thruster_env.core.compiled import function_fingerprint, inlined
from thruster_env.core.memory import (
    FIRST_REPORTED,
    FRONT,
    KEY_0,
    KEY_1,
    REWARD,
    STEP,
    TERMINATED,
    TIME,
    WIDTH,
)
from thruster_env.effects.effects import Moment, unrolled
from thruster_env.graphs.draws import Draws
from thruster_env.graphs.graphs import Graph, Number, uncollected, where
from thruster_env.graphs.programs import OF_COPIES, Place, Program, callable_of, program_of
from thruster_env.graphs.values import NUMBER, Line, built, leaves, shape_of

if TYPE_CHECKING:
    from thruster_env.graphs.workers import InParts

LANES = 16  # copies side by side: two of the widest registers, whose instructions the processor overlaps
FEW_BLOCKS = 8  # fewer are done before a second thread has woken up
MOST = 50_000  # operations of a program
MOST_UNROLLED = 8  # repetitions, above which a program is a loop
OF_ALL = {"reward": REWARD, "terminated": TERMINATED, "time": TIME}  # rows that all plants have


class Page(NamedTuple):
    """The functions of a plant.

    Attributes:
        begin: `begin(p, t)` returns memory and report at the start of an episode.
        step: `step(p, memory, action, t)` those after a sample time under an action (p,).
        inputs: the number of entries of an action.
    """

    begin: Callable
    step: Callable
    inputs: int


class Programs(NamedTuple):
    """The programs of a page, and the rows of a copy's memory: front, report, action, what it keeps, lines.

    Attributes:
        begin: at the start of an episode.
        step: of a step; of a page with a loop, before it, of a repetition, and after it.
        repetitions: of the loop; 0 if there is none.
        report: row or rows by name.
        action: rows.
        lines: rows (L, 4) of each number on its way: where it goes in, where it comes out, of the first of those
            between, and how many these are.
        rows: how many a copy has.
    """

    begin: Program
    step: tuple[Program, ...]
    repetitions: int
    report: dict[str, Any]
    action: range
    lines: np.ndarray
    rows: int

    @property
    def reported(self) -> int:
        """The row after the report."""
        return self.action.start


def packed(parameters: Any) -> np.ndarray:
    """A page's parameters as the row of numbers that its programs read: leaves, then tables."""
    values, tables = [], []
    length = sum(2 if isinstance(leaf, np.ndarray) else 1 for leaf in leaves(parameters))
    for leaf in leaves(parameters):
        if isinstance(leaf, np.ndarray):
            values += [float(length), float(leaf.size)]
            tables.append(leaf.ravel())
            length += leaf.size
        else:
            values.append(float(leaf))
    return np.concatenate([np.array(values), *tables])


@lru_cache(maxsize=64)
def programs_of(page: Page, shape: Any) -> Programs:
    """The programs of a page for parameters of a shape.

    Raises:
        TypeError: if it decides by a number, or has too many operations.
    """
    with uncollected():
        return _Tracer(page, shape).programs()


class _Tracer:
    """Traces a page, then finds a row of the memory for each number that copies keep."""

    def __init__(self, page: Page, shape: Any):
        self._page, self._graph = page, Graph(MOST)
        self._p = built(shape, (self._graph.given(Place("numbers", i)) for i in count()))
        self._key, self._now = (self._row(KEY_0), self._row(KEY_1)), self._row(STEP) + 1.0
        self._rows: dict[int, Place] = {}  # of numbers that are read, by their places in the graph
        self._outlets: list[tuple[int, Number, Number]] = []  # of lines: size, what went in last, what comes out
        self._loop: _Loop | None = None

    def _row(self, index: int) -> Number:
        return self._graph.given(Place("memory", index))

    def _moment(self, begin: bool, step: Number, **options) -> Moment:
        return Moment(begin, step, self._p.dt, Draws(self._key, step), **options)

    def _line(self, line: Line) -> Line:
        """A line of the last step, with what comes out of it."""
        shape, outlets = shape_of(line.last), []
        for entry in leaves(line.last):
            outlets.append(self._graph.given(("outlet", len(self._outlets))))
            self._outlets.append((line.size, entry, outlets[-1]))
        arrived = self._now >= float(line.size)
        pairs = zip(outlets, leaves(line.first), strict=True)
        line.oldest = built(shape, (where(arrived, outlet, first) for outlet, first in pairs))
        return line

    def _repeat(self, repetitions: int, body: Callable, x: tuple, inputs: Any) -> tuple:
        if repetitions <= MOST_UNROLLED:
            return unrolled(repetitions, body, x, inputs)
        if self._loop is not None:
            raise TypeError("a page must have at most one loop")
        start = [self._graph.number(number) for number in (*leaves(x), *leaves(inputs))]
        numbers = [self._graph.given(("loop", i)) for i in range(len(start))]
        count_x = len(leaves(x))
        repeated = built(shape_of(x), iter(numbers[:count_x]))
        result = body(repeated, built(shape_of(inputs), iter(numbers[count_x:])))
        self._loop = _Loop(repetitions, numbers, start, [self._graph.number(number) for number in leaves(result)])
        return repeated

    def programs(self) -> Programs:
        """The programs."""
        page, graph = self._page, self._graph
        memory_0, report_0 = page.begin(self._p, self._moment(True, graph.constant(0.0)))
        names = [name for name in report_0 if name not in OF_ALL]
        rows, report = len(FRONT), dict[str, Any]()
        for name in names:
            size = len(leaves(report_0[name]))
            report[name] = rows if shape_of(report_0[name]) == NUMBER else slice(rows, rows + size)
            rows += size
        action = range(rows, rows + page.inputs)
        shape, read = shape_of(memory_0), [graph.given(("leaf", i)) for i in range(len(leaves(memory_0)))]
        memory_1, report_1 = page.step(
            self._p,
            built(shape, iter(read), self._line),
            tuple(map(self._row, action)),
            self._moment(False, self._now, repeat=self._repeat),
        )
        if shape_of(memory_1) != shape or [n for n in report_1 if n not in OF_ALL] != names:
            raise TypeError("memory and report of a page must have the same shape at the start and in a step")
        reported, remembered = (
            [[graph.number(leaf) for leaf in leaves(value)] for value in pair]
            for pair in (
                [{name: of[name] for name in names} for of in (report_0, report_1)],
                (memory_0, memory_1),
            )
        )
        row_of = {(id(a), id(b)): len(FRONT) + i for i, (a, b) in enumerate(zip(*reported, strict=True))}
        memory_rows: list[int] = []
        rows = action.stop  # what is reported is not remembered twice
        for pair in zip(*remembered, strict=True):
            row = row_of.setdefault((id(pair[0]), id(pair[1])), rows)
            rows, memory_rows = max(rows, row + 1), [*memory_rows, row]
        self._rows = {a.place: Place("memory", row) for a, row in zip(read, memory_rows, strict=True)}
        lines, rows = self._lay_lines(rows)
        loop = self._loop or _Loop(0, [], [], [])
        for i, number in enumerate(loop.numbers):
            self._rows[number.place] = Place("memory", rows + i)
        rows += len(loop.numbers)

        def stores(k: int, now: Number) -> list[tuple[Place, Number]]:
            values = {row: (report_0, report_1)[k].get(name, 0.0) for name, row in OF_ALL.items()} | {STEP: now}
            values |= {len(FRONT) + i: number for i, number in enumerate(reported[k])}
            values |= {} if k else dict.fromkeys(action, 0.0)
            values |= dict(zip(memory_rows, remembered[k], strict=True))
            return [(Place("memory", row), graph.number(value)) for row, value in values.items()]

        steps = [self._program(stores(1, self._now))]
        if self._loop:
            loop_rows = [self._rows[number.place] for number in loop.numbers]
            pairs = [list(zip(loop_rows, numbers, strict=False)) for numbers in (loop.start, loop.result)]
            steps = [*map(self._program, pairs), *steps]
        begin = self._program(stores(0, graph.constant(0.0)))
        return Programs(begin, tuple(steps), loop.repetitions, report, action, lines, rows)

    def _lay_lines(self, rows: int) -> tuple[np.ndarray, int]:
        lines = []
        for size, last, outlet in self._outlets:
            self._rows[outlet.place] = Place("memory", rows)
            lines.append((self._rows[last.place].at, rows, rows + 1, size))
            rows += 1 + size
        return np.array(lines, dtype=np.float64).reshape(-1, 4), rows

    def _program(self, stores: list[tuple[Place, Number]]) -> Program:
        changed = [(target, number) for target, number in stores if self._lies(number) != target]
        return program_of(changed, self._rows)

    def _lies(self, number: Number) -> Place | None:
        """Where a number lies that is read."""
        return self._rows.get(number.place) or (number.arguments[0] if number.operation == "given" else None)


class _Loop(NamedTuple):
    """A loop: repetitions, the numbers that a repetition reads, their start, and what the first of them become."""

    repetitions: int
    numbers: list[Number]
    start: list[Number]
    result: list[Number]


@lru_cache(maxsize=64)
def compiled_page(page: Page, shape: Any, single: bool, interpreting: bool) -> InParts:
    """The compiled step of blocks, `on(blocks, (memory, numbers, lines, begin), out.shape)(out)`.

    It works on all blocks of a memory (blocks, rows, width): with `begin` it starts an episode of every copy from
    its key, otherwise it applies the actions for one sample time. Reports are copied to out (reported, blocks,
    width).

    Args:
        page: a plant's functions.
        shape: of its parameters.
        single: for one copy alone.
        interpreting: as Python.
    """
    programs = programs_of(page, shape)
    width, reported = 1 if single else WIDTH if interpreting else LANES, programs.reported
    start, *steps = (callable_of(part, width, OF_COPIES) for part in (programs.begin, *programs.step))
    move = _repeated(steps, programs.repetitions) if programs.repetitions else steps[0]
    fingerprint = function_fingerprint(start, *steps, within=__name__)

    def step(first, last, memory, numbers, lines, begin, out):
        fingerprint  # noqa: B018 - part of the cache's key
        for b in range(first, last):
            block = memory[b]
            for j in range(0, block.shape[1], width):
                if begin:
                    start(block[:, j : j + width], numbers)
                else:
                    move(block[:, j : j + width], numbers)
            move_lines(block, lines)
            for i in range(FIRST_REPORTED, reported):
                for j in range(block.shape[1]):
                    out[i, b, j] = block[i, j]

    from thruster_env.graphs.workers import InParts

    of_memory = (None, programs.rows, 1 if single else None)
    shapes = of_memory, (None,), programs.lines.shape, None, (reported, None, None)
    return InParts(step, shapes, single=single, few=FEW_BLOCKS)


@inlined
def move_lines(block, lines):
    """Put what goes into each line behind the others, and take out what comes out in the next step."""
    for k in range(lines.shape[0]):
        last, outlet, first, size = int(lines[k, 0]), int(lines[k, 1]), int(lines[k, 2]), int(lines[k, 3])
        for j in range(block.shape[1]):
            step = int(block[STEP, j])
            block[first + step % size, j] = block[last, j]
            block[outlet, j] = block[first + (step + 1) % size, j]


def _repeated(steps: list[Callable], repetitions: int) -> Callable:
    before, body, after = steps

    @inlined
    def move(copies, numbers):
        before(copies, numbers)
        for _ in range(repetitions):
            body(copies, numbers)
        after(copies, numbers)

    return move
