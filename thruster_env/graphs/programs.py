"""A graph of numbers that reads and writes rows of memory, for some runs side by side: a program without branches.

It is the same for all runs, so that one instruction works for eight of them. Compiled code has it as machine
instructions (`instructions`). Elsewhere its text runs as Python, with NumPy's arrays in the places of registers:

    t0 = +rows[0]
    t1 = numbers[4]
    t2 = t0 * t1
    rows[5] = t2

A digest of that text identifies the program within a compiled function. It is part of the key of cached machine
code, and the same in each process: no order in it depends on addresses or hashes.

A program with numbers of each member of an ensemble, cut into loops over the members.

Numbers that are the same for all members are evaluated once. A sum over members (`graphs.over_members`) ends a
loop: numbers that depend on it belong to the next turn.

    turn 0   y = h(x),  the sum of y                               a loop
             mean = sum/size                                       once
    turn 1   the sum of (y - mean)^2                               a loop
    ...

A loop evaluates a few sums at a time, so that these stay in registers. If a later loop needs a member's number,
too, it evaluates it again if that takes one operation on numbers of the table; else the table keeps it in a row.

A program as statements of C99, which read arrays, evaluate numbers, and store them.

    const double t0 = x[0];
    const double t1 = 0.5 * t0;
    x[0] = t1;

Constants are literals, with as many digits as distinguish them from neighbouring floats.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple
from weakref import WeakValueDictionary

import numpy as np

from thruster_env.core.streams import exponent_and_mantissa, uniform_block
from thruster_env.graphs.folding import as_single
from thruster_env.graphs.graphs import COMPARISONS, CONDITIONS, REDUCTIONS, Number, needed_by

ARRAYS = ("rows", "change", "numbers", "move")  # arguments of programs with derivatives
OF_STEPS = ("rows", "given", "numbers")  # arguments of programs that run a filter
OF_MEMBERS = ("rows", "given", "numbers", "table", "draws", "size")  # those of programs with loops over members
OF_COPIES = ("memory", "numbers")  # those of programs of copies of a plant; memory (rows, copies) has a stride
BY_MEMBERS = ("table", "draws")  # of these, those with a row for each number and a column for each member
SIDE_BY_SIDE = ("rows", "change", "given", "memory", "own", "results")
"""Of all, those with a number for each run at each place, or for each row of a repeated function."""
SPECIAL = {
    "negative": "-{}",
    "pow": "{} ** {}",
    "and": "{} & {}",
    "or": "{} | {}",
    "sum": "over_members({}, size)",
    "largest": "largest_of_members({}, size)",
    "size": "float(size)",
    "two_to": "exp2({})",
    "table": "table(numbers, {})",
}

CALLED: WeakValueDictionary[str, Callable] = WeakValueDictionary()
"""Functions work(given, found) of two arrays that programs call: what would be too long if it were written out."""
READ_NUMBERS: set[str] = set()
"""Names of those that have the array `numbers` of the program as a third argument."""
CALLED_IN_ROUNDS: dict[str, Callable[[], tuple[Program, Program, Program, int, int]]] = {}
"""Makers of the same as programs: what is done at first, in each round and at last; how many rounds there are, and
how many numbers are in the array `kept` from which and to which rounds lead."""


class Place(NamedTuple):
    """Where a number lies."""

    array: str
    at: int

    def __str__(self) -> str:
        return f"{self.array}[{self.at}]"


class Program(NamedTuple):
    """Numbers that are read, evaluated and stored."""

    reads: list[tuple[Place, Number]]
    works: list[Number]
    stores: list[tuple[Place, Number]]

    @property
    def text(self) -> list[str]:
        """A line for each number."""
        names = {
            number.place: f"t{k}" for k, number in enumerate([*(number for _, number in self.reads), *self.works])
        }
        copied = SIDE_BY_SIDE + BY_MEMBERS
        lines = [
            f"{names[number.place]} = {'+' * (source.array in copied)}{source}" for source, number in self.reads
        ]
        for number in self.works:
            values = [names[a.place] if isinstance(a, Number) else a for a in number.arguments]
            lines.append(
                f"{names[number.place]} = {_expression(number.operation, values)}{'  # exact' * number.exact}"
            )
        return lines + [f"{target} = {names[number.place]}" for target, number in self.stores]


def _expression(operation: str, values: list[str]) -> str:
    if operation == "constant":
        return f"float.fromhex({values[0]!r})"
    if operation == "call":
        name, count, *arguments = values
        arguments = [*arguments, "numbers=numbers"] if name in READ_NUMBERS else arguments
        return f"called({name!r}, {count}, {', '.join(arguments)})"
    if operation == "entry":
        return "{}[{}]".format(*values)
    if operation in SPECIAL:
        return SPECIAL[operation].format(*values)
    known = len(values) == 2 and not operation.isalnum()
    return f" {operation} ".join(values) if known else f"{operation}({', '.join(values)})"


def program_of(stores: Sequence[tuple[Place, Number]], known: Mapping[int, Place]) -> Program:
    """The program that evaluates numbers and stores them.

    Args:
        stores: pairs of a place in memory and the number to store there.
        known: places in memory of numbers that another program has evaluated, by their places in the graph.
    """
    reads, works = [], []
    for needed in needed_by([number for _, number in stores], known):
        if needed.operation == "given" or needed.place in known:
            reads.append((known.get(needed.place) or needed.arguments[0], needed))
        else:
            works.append(needed)
    return Program(reads, works, list(stores))


def values_of(numbers: Sequence[Number], points: np.ndarray) -> np.ndarray:
    """Values of numbers at some points, (len(numbers), points), if the array `numbers` has these values.

    Args:
        numbers: the wanted ones.
        points: values of the given numbers, (places, points).
    """
    rows = np.empty((len(numbers), points.shape[1]))
    program = program_of([(Place("rows", k), number) for k, number in enumerate(numbers)], {})
    _in_python(program.text)(rows, rows, points, points)
    return rows


def callable_of(program: Program, width: int, arrays: Sequence[str] = ARRAYS, scratch: int = 0) -> Callable:
    """The function `work(*arrays)` of a program, for `width` runs or members; compiled functions may call it, too.

    Args:
        program: the program.
        width: of vectors.
        arrays: names of the arguments.
        scratch: the first row of the table that loops over members may use for themselves.
    """
    lines, arguments = program.text, ", ".join(arrays)
    digest = hashlib.sha256("\n".join([str(width), str(scratch), *lines]).encode()).hexdigest()[:24]
    # What the cache of machine code sees is the digest alone; the text lives as long as the function.
    names: dict = {"run": _run, "__name__": __name__, "text": _TEXTS.setdefault(digest, Text(lines))}
    exec(f"def work({arguments}):\n    run('{digest}', {width}, {arguments})\n", names)
    work = names["work"]
    work.program = program, width, arrays, scratch  # of which `loops` makes instructions
    work.name = f"program_{digest}_{len(arrays)}"
    work.calls = [CALLED[number.arguments[0]] for number in program.works if number.operation == "call"]
    return work


class Text:
    """Lines of a program, and the Python function made from them at its first call."""

    def __init__(self, lines: list[str]):
        self._lines = lines
        self._in_python: Callable | None = None

    def in_python(self, kind: Sequence[str]) -> Callable:
        """The function of arrays of some names."""
        if self._in_python is None:
            self._in_python = _in_python(self._lines, kind)
        return self._in_python


_TEXTS: WeakValueDictionary[str, Text] = WeakValueDictionary()


def _run(digest: str, width: int, *arrays) -> None:
    kind = {len(names): names for names in (ARRAYS, OF_STEPS, OF_MEMBERS, OF_COPIES)}[len(arrays)]
    work = _TEXTS[digest].in_python(kind)
    if kind is OF_COPIES:
        memory, numbers = arrays
        with np.errstate(all="ignore"):
            work(memory[:, 0] if memory.shape[1] == 1 else memory, numbers)
        return
    if kind is OF_MEMBERS:
        *before, table, draws, size = arrays
        columns = table.shape[1]
        work(*before, table, draws[: len(draws) // columns * columns].reshape(-1, columns), size)
        return
    named = zip(kind, arrays, strict=True)
    work(*(a.reshape(-1, width) if width > 1 and name in SIDE_BY_SIDE else a for name, a in named))


def _in_python(text: list[str], arrays: Sequence[str] = ARRAYS) -> Callable:
    names = work_names()
    lines = "".join(f"    {line}\n" for line in text or ["pass"])
    exec(f"def work({', '.join(arrays)}):\n{lines}", names)
    return names["work"]


def work_names() -> dict:
    """The functions by their names in a program's text."""
    return {
        **vars(np),
        "where": _chosen,
        "over_members": _total,
        "largest_of_members": _largest,
        "called": _called,
        "philox": uniform_block,
        "exponent": lambda x: exponent_and_mantissa(x)[0],
        "mantissa": lambda x: exponent_and_mantissa(x)[1],
        "table": lambda numbers, index: numbers[np.asarray(index).astype(np.int64)],
        "erf": lambda x: _special("erf", x),
        "erfc": lambda x: _special("erfc", x),
    }


def _special(name: str, x):
    from scipy import special  # which takes long to import

    return getattr(special, name)(x)


def _chosen(condition, a, b):
    """NumPy's `where`, in less time for numbers."""
    return np.where(condition, a, b) if np.ndim(condition) else a if condition else b


def _total(row, size):
    """The sum of what the first `size` members have, which may be the same for all."""
    return row[:size].sum() if np.ndim(row) else row * size


def _largest(row, size):
    """The largest that the first `size` members have; NaN is none."""
    return np.fmax.reduce(row[:size], initial=-np.inf) if np.ndim(row) else row


def _called(name: str, count: int, *arguments, **named):
    shape = np.broadcast_shapes(*map(np.shape, arguments))
    if shape:
        lanes = np.stack([np.broadcast_to(a, shape) for a in arguments], axis=-1)
        return np.stack([_called(name, count, *lane, **named) for lane in lanes], axis=-1)
    results = np.empty(count, dtype=np.result_type(*arguments))
    CALLED[name](np.array(arguments), results, *named.values())
    return results


SUMS = 16  # of one loop: as many vectors, with their terms, fit into the registers

Loop = tuple[int, int]  # its turn, and which one it is in that


class Body(NamedTuple):
    """What a loop does for each member."""

    reads: list[tuple[Place, Number]]
    works: list[Number]
    stores: list[tuple[Place, Number]]
    sums: list[Number]


class Turn(NamedTuple):
    """Numbers that are the same for all members, and the loops that follow."""

    works: list[Number]
    bodies: list[Body]


class Cut(NamedTuple):
    """A program as turns.

    Attributes:
        reads: numbers that are the same for all members, read first.
        turns: the turns in their order.
        stores: of numbers that are the same for all members, last.
        rows: how many rows of the table it uses.
    """

    reads: list[tuple[Place, Number]]
    turns: list[Turn]
    stores: list[tuple[Place, Number]]
    rows: int


def cut(program: Program, scratch: int) -> Cut:
    """A program cut into loops, which keep numbers of members in rows of the table from `scratch` on."""
    outputs = {target: number for target, number in program.stores if target.array in BY_MEMBERS}
    outputs = {target: number for target, number in outputs.items() if number.arguments != (target,)}
    cutter = _Cutter(program, outputs, scratch)
    while late := cutter.overwritten:  # places that are written too early
        cutter = _Cutter(program, outputs, scratch, cutter.late | late)
    return cutter.cut()


class _Cutter:
    """Assigns numbers to loops."""

    def __init__(
        self, program: Program, outputs: Mapping[Place, Number], scratch: int, late: frozenset[Place] = frozenset()
    ):
        self._program, self._scratch, self.late = program, scratch, late
        self._outputs = outputs
        self._numbers = {
            number.place: number for number in [*(number for _, number in program.reads), *program.works]
        }
        self._turn: dict[int, int] = {}
        for k, number in self._numbers.items():
            self._turn[k] = max((self._turn[a.place] for a in number.of), default=0) + (
                number.operation in REDUCTIONS
            )
        self._last = max(self._turn.values(), default=0)
        self._loops: dict[Loop, list[Number]] = {}
        for turn in range(self._last + 1):
            self._add_loops(turn)
        self._end = self._last + 1, 0
        if late:
            self._loops[self._end] = []
        self._made: dict[int, Loop] = {}  # the loop that evaluates a member's number first
        self._rows: dict[
            int, tuple[Loop, Place]
        ] = {}  # rows of the table: the number's place in the graph -> first loop, place
        self.overwritten: frozenset[Place] = frozenset()
        for target, number in outputs.items():
            if number.member and number.operation != "given" and target not in late:
                self._rows.setdefault(number.place, (self._home(number), target))
        for target in late:
            self._keep(outputs[target])
        row_count = -1
        while row_count < len(self._rows) and not self.overwritten:
            row_count = len(self._rows)
            for loop in self._loops:
                self._members_of(loop)

    def _add_loops(self, turn: int) -> None:
        sums = [
            number
            for number in self._numbers.values()
            if number.operation in REDUCTIONS and self._turn[number.place] == turn + 1
        ]
        for k in range(0, max(len(sums), 1), SUMS):
            self._loops[turn, k // SUMS] = sums[k : k + SUMS]

    def _home(self, number: Number) -> Loop:
        return self._turn[number.place], 0

    def _keep(self, number: Number) -> None:
        if number.member and number.operation != "given" and number.place not in self._rows:
            self._rows[number.place] = (
                self._made.get(number.place, self._home(number)),
                Place("table", self._scratch),
            )
            self._scratch += 1

    def _stores(self, loop: Loop) -> list[tuple[Place, Number]]:
        if loop == self._end:
            return [(target, self._outputs[target]) for target in sorted(self.late)]
        stores = [(target, self._numbers[k]) for k, (home, target) in self._rows.items() if home == loop]
        known = {target for target, _ in stores}
        return stores + [
            (target, number)
            for target, number in self._outputs.items()
            if target not in known and target not in self.late and self._home(number) == loop
        ]

    def _place_of(self, number: Number, loop: Loop) -> Place | None:
        """Where a member's number lies when a loop begins."""
        if number.operation == "given":
            location = number.arguments[0]
            written = self._outputs.get(location)
            if written is not None and location not in self.late and self._home(written) < loop:
                self.overwritten |= {location}
            return location
        home, location = self._rows.get(number.place, (loop, None))
        return location if home < loop else None

    def _members_of(self, loop: Loop) -> tuple[list[Number], list[tuple[Place, Number]]]:
        """Numbers that a loop reads or evaluates, and its stores; earlier loops keep what it lacks."""
        stores = self._stores(loop)
        wanted = [number for _, number in stores] + [number.of[0] for number in self._loops[loop]]
        wanted_indices = {number.place for number in wanted}

        cutter = self

        class Known:
            """Numbers whose arguments do not matter: they are the same for all members, or lie in the table."""

            def __contains__(self, index) -> bool:
                number = cutter._numbers[index]
                if not number.member or cutter._place_of(number, loop):
                    return True
                if index in wanted_indices or cutter._made.get(index, loop) >= loop:
                    return False
                if number.is_condition or all(not a.member or cutter._place_of(a, loop) for a in number.of):
                    return False  # done again: it is one operation, or the table, of floats, cannot hold it
                cutter._keep(number)
                return True

        members = [number for number in needed_by(wanted, Known()) if number.member]
        for number in members:
            self._made.setdefault(number.place, loop)
        return members, stores

    def cut(self) -> Cut:
        """All turns."""
        turns = []
        for turn in range(self._last + 1 + bool(self.late)):
            works = [
                number for number in self._program.works if not number.member and self._turn[number.place] == turn
            ]
            bodies = [self._body(loop) for loop in self._loops if loop[0] == turn]
            turns.append(Turn(works, [body for body in bodies if body.stores or body.sums]))
        reads = [(source, number) for source, number in self._program.reads if not number.member]
        stores = [(target, number) for target, number in self._program.stores if target.array not in BY_MEMBERS]
        return Cut(reads, turns, stores, self._scratch)

    def _body(self, loop: Loop) -> Body:
        numbers, stores = self._members_of(loop)
        located = [(self._place_of(number, loop), number) for number in numbers]
        reads = [(source, number) for source, number in located if source is not None]
        return Body(reads, [number for source, number in located if source is None], stores, self._loops[loop])


OF_TWO = {name: name for name in ("+", "-", "*", "/", *COMPARISONS)} | {"and": "&&", "or": "||"}
OTHER_NAMES = {"abs": "fabs"} | {f"arc{name}": f"a{name}" for name in ("tan", "tan2", "sinh", "cosh", "tanh")}
"""Functions of math.h that have other names in NumPy."""


def statements_of(program: Program, single: bool = False) -> list[str]:
    """Statements that run a program; the arrays' names in its places are expressions of C.

    Args:
        program: reads come first, stores last, so results may lie where arguments do.
        single: whether all numbers are floats, not doubles.
    """
    writer = _Writer(single, {})
    writer.write(program.reads, program.works, program.stores)
    return writer.lines


def statements_of_members(parts: Cut, size: int, rows: Mapping[str, tuple[str, int]], single: bool) -> list[str]:
    """Statements that run a program of an ensemble, with loops over its members.

    Args:
        parts: the program, cut into loops.
        size: how many members there are.
        rows: names of the table and the draws in C, and how long their rows are.
        single: whether all numbers are floats, not doubles.
    """
    once = _Writer(single, {})
    once.write(parts.reads, [], [])
    for turn in parts.turns:
        once.write([], turn.works, [])
        for body in turn.bodies:
            sums = [once.named(number) for number in body.sums]
            once.lines += [f"{once.kind} {name} = {literal(0.0, single)};" for name in sums]
            each = _Writer(single, rows, once)
            each.write(body.reads, body.works, body.stores)
            totals = zip(sums, body.sums, strict=True)
            each.lines += [f"{name} += {each.names[number.of[0].place]};" for name, number in totals]
            inside = [f"    {line}" for line in each.lines]
            once.lines += [f"for (int j = 0; j < {size}; j++) {{", *inside, "}"]
    once.write([], [], parts.stores)
    return once.lines


class _Writer:
    """Writes statements.

    Attributes:
        lines: the statements.
        names: of numbers, by their places in the graph.
        kind: of the numbers.
    """

    def __init__(self, single: bool, rows: Mapping[str, tuple[str, int]], around: _Writer | None = None):
        """Begin; within a loop `around` has written what stands before it."""
        self._single, self._rows = single, rows
        self.lines: list[str] = []
        self.names: dict[int, str] = {} if around is None else dict(around.names)
        self.kind, self._letter = "float" if single else "double", "t" if around is None else "m"
        self._count = 0

    def named(self, number: Number) -> str:
        name = self.names[number.place] = f"{self._letter}{self._count}"
        self._count += 1
        return name

    def write(
        self,
        reads: Iterable[tuple[Place, Number]],
        works: Iterable[Number],
        stores: Iterable[tuple[Place, Number]],
    ) -> None:
        for source, number in reads:
            self.lines.append(f"const {self.kind} {self.named(number)} = {self._lies(source)};")
        for number in (number for number in works if number.place not in self.names):  # sums are known
            if number.value is not None:
                self.names[number.place] = literal(number.value, self._single)
            elif number.operation == "call":
                self._call(number)
            else:
                whose = "int" if number.operation in CONDITIONS else self.kind
                value = _c_expression(number, self.names, self._single)
                self.lines.append(f"const {whose} {self.named(number)} = {value};")
        self.lines += [f"{self._lies(target)} = {self.names[number.place]};" for target, number in stores]

    def _call(self, number: Number) -> None:
        name, count, *_ = number.arguments
        arguments, result = ", ".join(self.names[a.place] for a in number.of), self.named(number)
        self.lines.append(f"const {self.kind} of_{result}[{len(number.of)}] = {{{arguments}}};")
        self.lines += [f"{self.kind} {result}[{count}];", f"{name}(of_{result}, {result});"]

    def _lies(self, source: Place) -> str:
        if source.array not in self._rows:
            return str(source)
        name, length = self._rows[source.array]
        return f"{name}[{source.at * length} + j]" if source.at else f"{name}[j]"


def functions_called_by(programs: Iterable[Program], single: bool) -> list[str]:
    """The functions of C that programs call, each once: work(given, found) in rounds."""
    calls = {number.arguments[0] for program in programs for number in program.works if number.operation == "call"}
    return [_function_in_rounds(str(name), single) for name in sorted(calls)]


def _function_in_rounds(name: str, single: bool) -> str:
    first, again, last, rounds, size = CALLED_IN_ROUNDS[name]()
    kind = "float" if single else "double"
    texts = [
        "\n".join(f"        {line}" for line in statements_of(program, single)) for program in (first, again, last)
    ]
    return f"""\
static void {name}(const {kind} *given, {kind} *found)
{{
    {kind} kept[{size}];

    {{
{texts[0]}
    }}
    for (int k = 0; k < {rounds}; k++) {{
{texts[1]}
    }}
    {{
{texts[2]}
    }}
}}
"""


def _c_expression(number: Number, names: dict[int, str], single: bool) -> str:
    values = [names[a.place] if isinstance(a, Number) else str(int(a)) for a in number.arguments]
    if number.operation == "==" and values[0] == values[1]:
        return f"!isnan({values[0]})"
    if number.operation == "entry":
        return "{}[{}]".format(*values)
    if number.operation in OF_TWO:
        return f"{values[0]} {OF_TWO[number.operation]} {values[1]}"
    if number.operation == "negative":
        return f"-{values[0]}"
    if number.operation == "where":
        return f"{values[0]} ? {values[1]} : {values[2]}"
    return f"{OTHER_NAMES.get(number.operation, number.operation)}{'f' * single}({', '.join(values)})"


def literal(value: float, single: bool = False) -> str:
    """A number as C writes it; negative ones in brackets."""
    if math.isnan(value):
        return "NAN"
    value = as_single(value) if single else float(value)
    text = "INFINITY" if math.isinf(value) else str(np.float32(abs(value))) + "f" if single else repr(abs(value))
    return f"(-{text})" if value < 0 else text
