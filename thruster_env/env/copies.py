"""Many copies of a plant, stepped in place in one call of compiled code."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cached_property, lru_cache
from itertools import count, repeat
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from thruster_env.core.checks import as_floats, covariance_root
from thruster_env.core.checks import options as checked_options
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.sources import as_array, tuple_of, written_out
from thruster_env.effects.effects import Moment, unrolled
from thruster_env.env.plant_data import checked_state
from thruster_env.graphs.draws import Draws
from thruster_env.graphs.graphs import Graph, Number, uncollected, where
from thruster_env.graphs.programs import OF_COPIES, Place, Program, callable_of, program_of
from thruster_env.graphs.values import NUMBER, Line, built, leaves, shape_of
from thruster_env.model.quantities import Quantity

if TYPE_CHECKING:
    from thruster_env.graphs.workers import InParts


# A plant as a page: two pure functions of numbers, traced and run for any number of copies side by side.
#
#     memory, report = begin(p, t)                    an episode starts
#     memory, report = step(p, memory, action, t)     a sample time passes
#
# p are the plant's parameters, t the moment (`effects.effects.Moment`), memory what a copy keeps until the next
# step, and the report what an env shows: all nested tuples of numbers (`graphs.values`). Entries of the report
# may be "reward", "terminated" and "time"; the env names the others.


# The memory of many copies of a plant: one float64 array (blocks, rows, width), block by block.
#
# The rows of a block fit the fastest cache. A single env is one block of width one; blocks of more copies are
# whole groups of copies that are advanced side by side. The first rows of every plant hold what random draws
# depend on and what a step reports; the plant's own rows follow.


KEY_0, KEY_1, STEP, REWARD, TERMINATED, TIME = FRONT = range(6)
FIRST_REPORTED = REWARD
WIDTH = 128  # copies in a block: 23 rows of them are 23 KiB


def new_memory(copies: int, rows: int, lanes: int) -> np.ndarray:
    """Memory (blocks, rows, width) of zeros for a number of copies; the last block may have some to spare.

    The width is a multiple of `lanes`.
    """
    width = min(-(-copies // lanes) * lanes, WIDTH)
    return np.zeros((-(-copies // width), rows, width))


def set_row(memory: np.ndarray, index: int, values: np.ndarray) -> None:
    """Write one value per copy, (copies,), into a row."""
    blocks, _, width = memory.shape
    full = len(values) // width
    memory[:full, index] = values[: full * width].reshape(full, width)
    if full < blocks:
        memory[full, index, : len(values) - full * width] = values[full * width :]


def gathered(memory: np.ndarray, which: np.ndarray, lanes: int) -> np.ndarray:
    """Memory of some copies, given by their numbers (count,), in separate blocks of a multiple of `lanes`."""
    part = new_memory(len(which), memory.shape[1], lanes)
    block, column = np.divmod(which, memory.shape[2])
    own_block, own_column = np.divmod(np.arange(len(which)), part.shape[2])
    part[own_block, :, own_column] = memory[block, :, column]
    return part


def scatter(part: np.ndarray, memory: np.ndarray, which: np.ndarray) -> None:
    """Put the memory of some copies, as `gathered` made it, back into the memory of all."""
    block, column = np.divmod(which, memory.shape[2])
    own_block, own_column = np.divmod(np.arange(len(which)), part.shape[2])
    memory[block, :, column] = part[own_block, :, own_column]


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

    def step(first, last, memory, numbers, lines, begin, out):
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

    def move(copies, numbers):
        before(copies, numbers)
        for _ in range(repetitions):
            body(copies, numbers)
        after(copies, numbers)

    return move


PICKLED = ("page_of", "plant", "task", "count", "memory")


class PlantCopies:
    """N copies of a plant with a task, each with its own key; a report of them is an array (reported, N).

    Attributes:
        report_rows: the row or rows of a report by name.
        reported: the row after the last one that a step reports.
        commands: rows of the memory that hold the inputs of the next step.
    """

    def __init__(self, page_of: Callable, plant: Any, task: Any, count: int):
        """Allocate the memory of `count` copies; call `begin` next.

        Args:
            page_of: `page_of(plant, task)` returns the `Page` and its parameters, a named tuple with the sample
                time `dt`, and `prior_mean` and `prior_root` of the initial state.
            plant: the plant.
            task: its task.
            count: number of copies.
        """
        self.page_of, self.plant, self.task, self.count = page_of, plant, task, count
        rows = self._find_machine_code()
        self.memory = new_memory(count, rows, self._lanes)

    def _find_machine_code(self) -> int:
        """Find the programs and their machine code; return the rows of a copy."""
        page, parameters = self.page_of(self.plant, self.task)
        shape = shape_of(parameters)
        programs = programs_of(page, shape)
        self.parameters, self.numbers = parameters, packed(parameters)
        self.report_rows, self.reported = programs.report, programs.reported
        self.commands, self.lines = programs.action, programs.lines
        self.advance = compiled_page(page, shape, self.count == 1, is_interpreting())
        return programs.rows

    @property
    def _lanes(self) -> int:
        return 1 if self.count == 1 else LANES

    def numbers_from(self, options: Mapping | None) -> np.ndarray | None:
        """Numbers for `begin` with the initial state that a reset's options fix in "state", or None.

        Raises ValueError for other options.
        """
        start = checked_options(options).get("state")
        if start is None:
            return None
        p = self.parameters
        state = checked_state("the state of options", start, len(p.prior_mean))
        root = built(shape_of(p.prior_root), repeat(0.0))
        return packed(p._replace(prior_mean=tuple(state), prior_root=root))

    def __getstate__(self) -> dict:
        """All but the page and its machine code, which every process finds for itself."""
        return {name: getattr(self, name) for name in PICKLED}

    def __setstate__(self, state: dict) -> None:
        """Find the machine code for the restored memory; ValueError for the memory of another version."""
        if state.keys() != set(PICKLED):
            raise ValueError("copies of a plant must be pickled by this version, but these are from an older one")
        vars(self).update(state)
        self._find_machine_code()

    @property
    def bytes_per_copy(self) -> int:
        """Memory per copy."""
        return self.memory.nbytes // (self.memory.shape[0] * self.memory.shape[2])

    def begin(self, keys: np.ndarray, which: np.ndarray | None = None, numbers=None) -> np.ndarray:
        """Start episodes with keys (count, 2) for all copies, or for those named by `which`; return their report.

        `numbers` may replace the plant's own, with another initial state.
        """
        numbers = self.numbers if numbers is None else numbers
        memory = self.memory if which is None else gathered(self.memory, which, self._lanes)
        set_row(memory, KEY_0, keys[:, 0])
        set_row(memory, KEY_1, keys[:, 1])
        out = np.empty(self._shape(memory))
        self._advance(memory, numbers, True)(out)
        if which is not None:
            scatter(memory, self.memory, which)
        return out.reshape(self.reported, -1)[:, : len(keys)]

    def step(self, commands: np.ndarray) -> np.ndarray:
        """Apply commands (N,) of one input, or (N, p), for one sample time; return the report."""
        if commands.ndim == 1:
            set_row(self.memory, self.commands[0], commands)
        else:
            for row, values in zip(self.commands, commands.T, strict=True):
                set_row(self.memory, row, values)
        out = np.empty(self._shape(self.memory))
        self._step(out)
        return out.reshape(self.reported, -1)[:, : self.count]

    def report(self) -> np.ndarray:
        """The report of the last step, without a step."""
        reported = self.memory[:, : self.reported].transpose(1, 0, 2)
        return reported.reshape(self.reported, -1)[:, : self.count].copy()

    def step_into(self, out: np.ndarray) -> Callable[[], Any]:
        """`step()` of a single copy whose episode has begun; its report is put into out (reported, 1, 1)."""
        return self.advance.on_result((self.memory, self.numbers, self.lines, False), out)

    def _shape(self, memory: np.ndarray) -> tuple[int, int, int]:
        """Shape of a report by blocks.

        It has a block more than there are: rows that lie a power of two apart would drive one another out of the
        cache.
        """
        blocks, _, width = memory.shape
        return self.reported, blocks + 1, width

    def _advance(self, memory: np.ndarray, numbers: np.ndarray, begin: bool) -> Callable[[np.ndarray], Any]:
        return self.advance.on(len(memory), (memory, numbers, self.lines, begin), self._shape(memory))

    @cached_property
    def _step(self) -> Callable[[np.ndarray], Any]:
        return self._advance(self.memory, self.numbers, False)


def root_of(cov: np.ndarray) -> tuple[tuple[float | None, ...], ...]:
    """The lower triangular root of a covariance by rows; None for zeros, with which nothing is computed."""
    root = covariance_root(cov)
    return tuple(tuple(value or None for value in row[: i + 1]) for i, row in enumerate(root.tolist()))


def correlated(root: Sequence[Sequence], draws: Sequence) -> list:
    """L w of a root L from `root_of` and independent draws w."""
    rows = ([a * b for a, b in zip(row, draws, strict=False) if a is not None] for row in root)
    return [sum(terms[1:], terms[0]) if terms else 0.0 for terms in rows]


def clipped(value, low, high):
    """A number within low ... high."""
    value = where(value < low, low, value)
    return where(value > high, high, value)


class Channel(NamedTuple):
    """A measured quantity h(x, y, u, c): of the state x, the plant's outputs y at x, its input u and constants c.

    The functions work on tuples of components (floats or arrays) and can be compiled. A channel that does not
    depend on u has slopes: the state alone predicts it, so that a state-space model may contain it.

    Attributes:
        quantity: the measured quantity, with its unit.
        variance: default variance of the channel's Gaussian noise [unit^2].
        read: h(x, y, u, c).
        slopes: `slopes(x, dy, c)`, the n derivatives dh/dx, where row i of dy is the gradient of output i; None if
            the channel depends on the input.
        affine: whether h is affine in x and y, so that a linear plant's model can have it.
    """

    quantity: Quantity
    variance: float
    read: Callable
    slopes: Callable | None = None
    affine: bool = True


def functions_of(
    channels: Sequence[Channel], outputs: Callable, outputs_jacobian: Callable, states: int
) -> tuple[Callable, Callable]:
    """`observe(x, c)` of a model that has these channels, and its Jacobian by rows.

    Args:
        channels: the measured channels, in order; each with slopes.
        outputs: `outputs(x, c)`, the plant's outputs y.
        outputs_jacobian: `outputs_jacobian(x, c)`, their derivatives by rows.
        states: number of components of x.

    Raises:
        ValueError: if a channel depends on the input.
    """
    reads: dict[str, Any] = {f"read_{i}": channel.read for i, channel in enumerate(channels)}
    slopes: dict[str, Any] = {}
    for i, channel in enumerate(channels):
        if channel.slopes is None:
            raise ValueError(
                f"a channel of a model must not depend on the input, but {channel.quantity.name} does"
            )
        slopes[f"slopes_{i}"] = channel.slopes
    readings = tuple_of(f"{name}(x, y, (), c)" for name in reads)
    rows = tuple_of(f"{name}(x, dy, c)" for name in slopes)
    observe = written_out("observe", "x, c", "y = outputs(x, c)", readings, outputs=outputs, **reads)
    jacobian = written_out(
        "observe_jacobian", "x, c", "dy = slopes(x, c)", rows, slopes=outputs_jacobian, **slopes
    )
    count = len(channels)
    return as_array(observe, "x, c", count), as_array(jacobian, "x, c", count, states)


# Recorded runs.


def record(
    copies_of: Callable[[int], PlantCopies], keys: np.ndarray, inputs: np.ndarray, name: str, count: int
) -> tuple[np.ndarray, dict[str, Any]]:
    """Reports (B, K + 1, reported) of a batch of B copies from their start on, and the row or rows by name.

    Args:
        copies_of: `copies_of(count)` makes that many copies.
        keys: of their episodes, (B, 2).
        inputs: (B, K, p), or (B, K) if p is 1.
        name: the name of the inputs, for messages.
        count: their number p.

    Raises:
        ValueError: if shapes do not fit or a number is not finite.
    """
    keys, inputs = (np.ascontiguousarray(as_floats(a)) for a in (keys, inputs))
    if keys.ndim != 2 or keys.shape[1] != 2 or not np.isfinite(keys).all():
        raise ValueError(f"keys must be finite and of shape (B, 2), but got shape {keys.shape}")
    rest = () if count == 1 else (count,)
    fits = inputs.ndim == 2 + len(rest) and len(inputs) == len(keys) and inputs.shape[2:] == rest
    if not fits or np.isnan(inputs).any():
        shape = f"({len(keys)}, K{''.join(f', {size}' for size in rest)})"
        rule = f"{name} must be without NaN and of shape {shape}, one row per key"
        raise ValueError(f"{rule}, but got shape {inputs.shape}")
    copies = copies_of(len(keys))
    reports = np.empty((inputs.shape[1] + 1, copies.reported, len(keys)))
    reports[0] = copies.begin(keys)
    for k in range(inputs.shape[1]):
        reports[k + 1] = copies.step(inputs[:, k])
    return np.ascontiguousarray(reports.transpose(2, 0, 1)), copies.report_rows


def check_finite(what: str, *parts: np.ndarray) -> None:
    """Raise ValueError that names the first step at which a number of the parts (B, K + 1, ...) is not finite."""
    finite = np.all([np.isfinite(part).all(axis=(0, 2)) for part in parts], axis=0)
    if not finite.all():
        raise ValueError(
            f"{what} must stay finite, but it is not from step {np.argmin(finite)} of {len(finite) - 1} on: "
            "check dt and the noise covariances"
        )
