"""A program as statements of C99, which read arrays, evaluate numbers, and store them.

    const double t0 = x[0];
    const double t1 = 0.5 * t0;
    x[0] = t1;

Constants are literals, with as many digits as distinguish them from neighbouring floats.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping

import numpy as np

from thruster_env.graphs.folding import as_single
from thruster_env.graphs.graphs import COMPARISONS, CONDITIONS, Number
from thruster_env.graphs.programs import CALLED_IN_ROUNDS, Cut, Place, Program

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
                value = _expression(number, self.names, self._single)
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


def _expression(number: Number, names: dict[int, str], single: bool) -> str:
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
