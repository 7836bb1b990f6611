"""Programs as instructions of LLVM, each for as many runs as lie side by side.

They work on vectors with one number of each run, so no compiler has to find out whether a loop can be vectorised.

Numbers that are the same for all members are evaluated once, before the loop that needs them. Each lane has its
own sum, and the loop's end adds the lanes. The table has columns for full vectors: those behind the last member
are evaluated, too, but count in no sum.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]

from thruster_env.core.compiled import FASTMATH
from thruster_env.core.streams import ROUNDER, ROUNDER_BITS, SQRT_HALF_BITS
from thruster_env.graphs.graphs import COMPARISONS, ROWS, Number, Repeat, needed_by
from thruster_env.graphs.programs import (
    BY_MEMBERS,
    SIDE_BY_SIDE,
    Body,
    Cut,
    Place,
    Program,
)

FLAGS = tuple(sorted(FASTMATH))
EXACT = ("nsz",)  # of what is rounded as Python does
OF_TWO = {"+": "fadd", "-": "fsub", "*": "fmul", "/": "fdiv"}
OF_LLVM = {"sqrt": "sqrt", "exp": "exp", "log": "log", "sin": "sin", "cos": "cos", "abs": "fabs", "pow": "pow"} | {
    name: name for name in ("floor", "ceil", "rint", "copysign")
}  # functions of vectors; others are called for each run
IN_LIBRARY = {"arctan": "atan", "arctan2": "atan2", "arcsinh": "asinh", "arccosh": "acosh", "arctanh": "atanh"}
"""Other names than NumPy's in C's library."""
DOUBLE, LONG = ir.DoubleType(), ir.IntType(64)
MOST_NUMBERS = 2**40  # the length of an array of which only the pointer is known


class Writer:
    """Writes instructions.

    Attributes:
        values: of numbers of a graph, by their places.
        values_of: of operations without arguments, by their names.
        pointer_of: where a place lies, as a pointer to vectors or numbers.
        stride: numbers between two rows of the array `memory`.
    """

    def __init__(self, call: Callable, builder: ir.IRBuilder, arrays: dict, width: int):
        """Begin; arrays are pointers to their first numbers."""
        self._call, self._builder, self._arrays, self._width = call, builder, arrays, width
        self._vector, self._longs = ir.VectorType(DOUBLE, width), ir.VectorType(LONG, width)
        self.stride: ir.Value | None = None
        self.values: dict[int, ir.Value] = {}
        self.values_of: dict[str, ir.Value] = {}
        self._memory_of: dict[int, tuple[ir.Value, int]] = {}  # of the numbers of repeated functions
        self.pointer_of: Callable[[Place], ir.Value] = self._pointer

    def write(self, program: Program) -> None:
        """All instructions of a program."""
        self.read(program.reads)
        self.work(program.works)
        self.store(program.stores)

    def write_repeated(self, program: Program, new_function: Callable) -> None:
        """The same, but functions that were traced for many rows are functions of LLVM, for `ROWS` rows a call.

        Side by side, the matrices of many runs would not fit into the fastest memory, so these have no functions.

        Args:
            program: the program.
            new_function: makes a function of a type.
        """
        bodies = _bodies_of(program) if self._width == 1 else []
        if not bodies:
            return self.write(program)
        reads = {number.place: source for source, number in program.reads}
        by_result = {number.place: body for body in bodies for number in body.results}

        def arguments_of(node: Number | _RepeatedBody) -> Sequence:
            body = None if isinstance(node, _RepeatedBody) else by_result.get(node.place)
            return node.of if body is None else (body,)

        for node in needed_by([number for _, number in program.stores], reads, arguments_of):
            if isinstance(node, _RepeatedBody):
                self._call_body(node, new_function)
            elif node.place in reads:
                self.values[node.place] = self._read(reads[node.place])
            elif node.place in by_result:
                pointer = self._vector_at(*self._memory_of[node.place])
                self.values[node.place] = self._builder.load(pointer, align=8, typ=self._vector)
            else:
                self.work([node])
        self.store(program.stores)

    def _call_body(self, body: _RepeatedBody, new_function: Callable) -> None:
        rows, common = self._in_memory(body.entries), self._in_memory(body.common)
        results = self._on_stack(body.results)
        function = new_function(ir.FunctionType(ir.VoidType(), [rows.type] * 3))
        function.attributes.add("noinline")
        for argument in function.args:
            argument.add_attribute("noalias")
        arrays = dict(zip(("own", "common", "results"), function.args, strict=True))
        writer = Writer(self._call, ir.IRBuilder(function.append_basic_block()), arrays, ROWS)
        writer.write(body.program)
        writer._builder.ret_void()
        of_group = ROWS * body.length, ROWS * len(body.program.stores)
        for k in range(len(body.entries) // of_group[0]):
            row, result = (self._behind(*part) for part in ((rows, k * of_group[0]), (results, k * of_group[1])))
            self._builder.call(function, [row, common, result])

    def _in_memory(self, numbers: Sequence[Number]) -> ir.Value:
        """Where numbers lie one after the other, as the results of another function do, or a copy of them."""
        memory, first = self._memory_of.get(numbers[0].place, (None, 0)) if numbers else (None, 0)
        located = [self._memory_of.get(number.place) for number in numbers]
        if memory is None or located != [(memory, first + k) for k in range(len(numbers))]:
            memory, first = self._on_stack(numbers), 0
            for k, number in enumerate(numbers):
                self._builder.store(self.values[number.place], self._vector_at(memory, k), align=8)
        return self._behind(memory, first)

    def _on_stack(self, numbers: Sequence[Number]) -> ir.Value:
        memory = self._builder.alloca(DOUBLE, size=ir.Constant(LONG, max(len(numbers), 1)))
        memory.align = 64
        self._memory_of |= {number.place: (memory, k) for k, number in enumerate(numbers)}
        return memory

    def _vector_at(self, memory: ir.Value, at: int) -> ir.Value:
        return self._builder.bitcast(self._behind(memory, at), self._vector.as_pointer())

    def _behind(self, memory: ir.Value, at: int) -> ir.Value:
        return self._builder.gep(memory, [ir.Constant(LONG, at)], source_etype=DOUBLE)

    def read(self, reads: Sequence[tuple[Place, Number]]) -> None:
        """Read numbers."""
        for source, number in reads:
            self.values[number.place] = self._read(source)

    def work(self, numbers: Sequence[Number]) -> None:
        """Work numbers out."""
        for number in numbers:
            if number.place not in self.values:
                self.values[number.place] = self._worked_out(number)

    def store(self, stores: Sequence[tuple[Place, Number]]) -> None:
        """Store numbers."""
        for target, number in stores:
            self._builder.store(self.values[number.place], self.pointer_of(target), align=8)

    def same_for_all(self, value: ir.Value, number: Number) -> ir.Value:
        """The vector of a number that is the same for all; a constant is one already."""
        if number.operation == "constant":
            return ir.Constant(self._vector, [number.value] * self._width)
        return self._broadcast(value, ir.Constant(value.type, ir.Undefined))

    def _pointer(self, location: Place) -> ir.Value:
        of_all = location.array in SIDE_BY_SIDE
        if location.array == "memory":
            at = self._builder.mul(ir.Constant(LONG, location.at), self.stride)
        else:
            at = ir.Constant(LONG, location.at * (self._width if of_all else 1))
        pointer = self._builder.gep(self._arrays[location.array], [at], source_etype=DOUBLE)
        return self._builder.bitcast(pointer, self._vector.as_pointer()) if of_all else pointer

    def _read(self, source: Place) -> ir.Value:
        of_all = source.array in (*SIDE_BY_SIDE, *BY_MEMBERS)
        value = self._builder.load(self.pointer_of(source), align=8, typ=self._vector if of_all else DOUBLE)
        if of_all:
            return value
        nothing = ir.Constant(self._vector, ir.Undefined)
        return self._broadcast(
            self._builder.insert_element(nothing, value, ir.Constant(ir.IntType(32), 0)), nothing
        )

    def _broadcast(self, value: ir.Value, nothing: ir.Value) -> ir.Value:
        lanes = ir.VectorType(ir.IntType(32), self._width)
        return self._builder.shuffle_vector(value, nothing, ir.Constant(lanes, [0] * self._width))

    def _worked_out(self, number: Number) -> ir.Value:
        operation, builder = number.operation, self._builder
        if operation == "constant":
            return ir.Constant(self._vector, [number.value] * self._width)
        if operation in self.values_of:
            return self.values_of[operation]
        values = [self.values[argument.place] for argument in number.of]
        flags = EXACT if number.exact or operation == "/" and number.of[0].value != 1.0 else FLAGS
        if operation in OF_TWO:
            return getattr(builder, OF_TWO[operation])(*values, flags=flags)
        if operation == "negative":
            return builder.fneg(*values, flags=flags)
        if operation == "call":
            return self._worked_out_by(number.arguments[0], number.arguments[1], values)
        if operation == "entry":
            return values[0][number.arguments[1]]
        without_flags = {"where": builder.select, "and": builder.and_, "or": builder.or_}
        without_flags |= {"two_to": self._two_to, "hypot": self._length, "philox": self._philox}
        without_flags |= {"exponent": self._exponent, "mantissa": self._mantissa, "table": self._looked_up}
        if operation in without_flags:
            return without_flags[operation](*values)
        if operation == "!=":
            return builder.fcmp_unordered(operation, *values)
        if operation in COMPARISONS:
            return builder.fcmp_ordered(operation, *values)
        return self._called(operation, values, flags)

    def _length(self, x: ir.Value, y: ir.Value) -> ir.Value:
        """The root of x^2 + y^2, of numbers scaled by the larger one where squares would leave float64."""
        builder = self._builder

        def times(a, b):
            return builder.fmul(a, b, flags=FLAGS)

        def root_of_squares(a, b):
            square = builder.fadd(times(a, a), times(b, b), flags=FLAGS)
            return square, self._called("sqrt", [square], FLAGS)

        least, most, unit, none, infinite = (
            ir.Constant(self._vector, [value] * self._width) for value in (1e-280, 1e300, 1.0, 0.0, math.inf)
        )
        square, root = root_of_squares(x, y)
        usual = builder.and_(builder.fcmp_ordered(">", square, least), builder.fcmp_ordered("<", square, most))
        x_size, y_size = (self._called("abs", [value], FLAGS) for value in (x, y))
        scale = builder.select(builder.fcmp_ordered(">", x_size, y_size), x_size, y_size)
        divides = builder.and_(builder.fcmp_ordered(">", scale, none), builder.fcmp_ordered("<", scale, infinite))
        scale = builder.select(divides, scale, unit)
        _, scaled = root_of_squares(*(builder.fdiv(value, scale, flags=EXACT) for value in (x, y)))
        return builder.select(usual, root, times(scale, scaled))

    def _constant(self, value: float) -> ir.Constant:
        """A vector of one number, of integers if it is one."""
        return ir.Constant(self._longs if isinstance(value, int) else self._vector, [value] * self._width)

    def _two_to(self, exponents: ir.Value) -> ir.Value:
        """2^k of whole numbers k, whose last bits become the exponent's."""
        builder = self._builder
        bits = builder.bitcast(builder.fadd(exponents, self._constant(ROUNDER)), self._longs)
        bits = builder.add(bits, self._constant(1023 - ROUNDER_BITS))
        return builder.bitcast(builder.shl(bits, self._constant(52)), self._vector)

    def _exponent_bits(self, x: ir.Value) -> tuple[ir.Value, ir.Value]:
        bits = self._builder.bitcast(x, self._longs)
        exponent = self._builder.sub(bits, self._constant(SQRT_HALF_BITS))
        return bits, self._builder.ashr(exponent, self._constant(52))

    def _exponent(self, x: ir.Value) -> ir.Value:
        """The exponent of `streams.exponent_and_mantissa`."""
        return self._builder.sitofp(self._exponent_bits(x)[1], self._vector)

    def _mantissa(self, x: ir.Value) -> ir.Value:
        """Its mantissa."""
        bits, exponent = self._exponent_bits(x)
        bits = self._builder.sub(bits, self._builder.shl(exponent, self._constant(52)))
        return self._builder.bitcast(bits, self._vector)

    def _philox(self, *words: ir.Value) -> list[ir.Value]:
        """The four uniform numbers of `streams.uniform_block`."""
        b, low, shift = self._builder, self._constant(0xFFFFFFFF), self._constant(32)
        block, step, stream, *key = (b.fptoui(word, self._longs) for word in words)
        counter = (block, step, stream, self._constant(0))
        for i in range(10):
            if i:
                weyl = map(self._constant, (0x9E3779B9, 0xBB67AE85))
                key = [b.and_(b.add(k, w), low) for k, w in zip(key, weyl, strict=True)]
            first = b.mul(self._constant(0xD2511F53), b.and_(counter[0], low))
            second = b.mul(self._constant(0xCD9E8D57), b.and_(counter[2], low))
            left = b.xor(b.xor(b.lshr(second, shift), counter[1]), key[0])
            right = b.xor(b.xor(b.lshr(first, shift), counter[3]), key[1])
            counter = (left, second, right, first)
        numbers = [b.fadd(b.sitofp(b.and_(w, low), self._vector), self._constant(0.5)) for w in counter]
        return [b.fmul(number, self._constant(2.0**-32)) for number in numbers]

    def _looked_up(self, index: ir.Value) -> ir.Value:
        """The entry of the array `numbers` at a whole number, which differs between runs."""
        builder, entries = self._builder, ir.Constant(self._vector, ir.Undefined)
        index = builder.fptosi(index, self._longs)
        for k in range(self._width):
            lane = ir.Constant(ir.IntType(32), k)
            at = builder.extract_element(index, lane)
            pointer = builder.gep(self._arrays["numbers"], [at], source_etype=DOUBLE)
            entries = builder.insert_element(entries, builder.load(pointer, typ=DOUBLE), lane)
        return entries

    def _worked_out_by(self, name: str, count: int, values: list[ir.Value]) -> list[ir.Value]:
        """The results of a function of two arrays, run after run."""
        builder, results = self._builder, [ir.Constant(self._vector, ir.Undefined)] * count
        for k in range(self._width):
            at = ir.Constant(ir.IntType(32), k)
            numbers = [builder.extract_element(value, at) for value in values]
            for i, result in enumerate(self._call(name, numbers, count, self._arrays.get("numbers"))):
                results[i] = builder.insert_element(results[i], result, at)
        return results

    def _called(self, name: str, values: list[ir.Value], flags: Sequence[str]) -> ir.Value:
        builder, module = self._builder, self._builder.module
        if name in OF_LLVM:
            function = _declared(module, f"llvm.{OF_LLVM[name]}.v{self._width}f64", self._vector, len(values))
            return builder.call(function, values, fastmath=flags)
        function, result = _declared(module, IN_LIBRARY.get(name, name), DOUBLE, len(values)), values[0]
        for k in range(self._width):
            at = ir.Constant(ir.IntType(32), k)
            entry = builder.call(function, [builder.extract_element(value, at) for value in values])
            result = builder.insert_element(result, entry, at)
        return result


def _declared(module: ir.Module, name: str, kind: ir.Type, count: int) -> ir.Function:
    return module.globals.get(name) or ir.Function(module, ir.FunctionType(kind, [kind] * count), name)


class _RepeatedBody:
    """A `Repeat` of a program: among its numbers it stands for its results, as one operation on all rows.

    Attributes:
        place: a number that no other one has.
        program: of a row ("own"), and of numbers that are the same for all rows ("common").
        length: of a row.
        entries: the numbers of the rows, as `_in_groups` has them; the last row fills the last group.
        common: numbers that are the same for all rows.
        of: all of them.
        results: of the rows, in the same order.
    """

    def __init__(self, place: int, repeat: Repeat):
        """Find the numbers that are the same for all rows."""
        self.place, self.length = place, len(repeat.formal)
        self.entries, self.results = _in_groups(repeat.rows), _in_groups(repeat.results)
        formal = {number.place: Place("own", k) for k, number in enumerate(repeat.formal)}
        of_row, ordered = set(formal), needed_by(repeat.body)
        for number in ordered:
            if any(a.place in of_row for a in number.of):
                of_row.add(number.place)
        reads, works, self.common = [], [], list[Number]()
        for number in needed_by(repeat.body, {number.place for number in ordered} - of_row):
            if number.place in formal:
                reads.append((formal[number.place], number))
            elif number.place in of_row or number.operation == "constant":
                works.append(number)
            else:
                reads.append((Place("common", len(self.common)), number))
                self.common.append(number)
        self.program = Program(
            reads, works, [(Place("results", k), number) for k, number in enumerate(repeat.body)]
        )
        self.of = [*self.entries, *self.common]


def _in_groups(rows: Sequence[Sequence[Number]]) -> list[Number]:
    rows = [*rows, *[rows[-1]] * (-len(rows) % ROWS)]
    return [
        rows[k + row][j] for k in range(0, len(rows), ROWS) for j in range(len(rows[0])) for row in range(ROWS)
    ]


def _bodies_of(program: Program) -> list[_RepeatedBody]:
    """The repeated functions of which a program needs most results, and computes the inputs."""
    if not program.works:
        return []
    works, bodies = {number.place: number for number in program.works}, []
    known = {number.place for _, number in program.reads} | works.keys()
    for k, repeat in enumerate(program.works[0].graph.repeats):
        needed = [works[a.place] for row in repeat.results for a in row if a.place in works]
        if 2 * len(needed) > len(repeat.results) * len(repeat.body) and not any(a.exact for a in needed):
            body = _RepeatedBody(-1 - k, repeat)
            if all(a.place in known and not a.is_condition for a in body.of):
                bodies.append(body)
    return bodies


INT = ir.IntType(32)


class LoopWriter:
    """Writes what is done once, and loops; `columns` of the table, and `size` members."""

    def __init__(
        self, call: Callable, builder: ir.IRBuilder, arrays: dict, width: int, columns: ir.Value, size: ir.Value
    ):
        self._call, self._builder, self._arrays, self._width = call, builder, arrays, width
        self._columns, self._size = columns, size
        self._once = Writer(call, builder, arrays, 1)
        self._once.values_of["size"] = self._as_vector(builder.sitofp(size, DOUBLE))

    def _as_vector(self, value: ir.Value) -> ir.Value:
        vector = ir.VectorType(DOUBLE, 1)
        return self._builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(INT, 0))

    def write(self, parts: Cut) -> None:
        """All turns of a program."""
        self._once.read(parts.reads)
        for turn in parts.turns:
            self._once.work(turn.works)
            for body in turn.bodies:
                self._loop(body)
        self._once.store(parts.stores)

    def _loop(self, body: Body) -> None:
        builder, width = self._builder, self._width
        each = Writer(self._call, builder, self._arrays, width)
        self._same_for_all(each, body)
        mask = ir.Constant(ir.VectorType(LONG, width), list(range(width))) if body.sums else None
        before = builder.block
        inside, after = builder.append_basic_block("members"), builder.append_basic_block("after")
        builder.branch(inside)
        builder.position_at_end(inside)
        at = builder.phi(LONG)
        at.add_incoming(ir.Constant(LONG, 0), before)
        vector = ir.VectorType(DOUBLE, width)
        sums = [builder.phi(vector) for _ in body.sums]
        for total, of in zip(sums, body.sums, strict=True):
            total.add_incoming(
                ir.Constant(vector, [-np.inf if of.operation == "largest" else 0.0] * width), before
            )
        each.pointer_of = lambda location: self._pointer(location, at, vector)
        each.read(body.reads)
        each.work(body.works)
        each.store(body.stores)
        following = builder.add(at, ir.Constant(LONG, width))
        if body.sums:
            left = self._broadcast(builder.sub(self._size, at), ir.VectorType(LONG, width))
            counts = builder.icmp_signed("<", mask, left)
            for number, total in zip(body.sums, sums, strict=True):
                value = each.values[number.of[0].place]
                if number.operation == "largest":
                    more, applies = value, builder.and_(counts, builder.fcmp_ordered(">", value, total))
                else:
                    more, applies = builder.fadd(total, value, flags=FLAGS), counts
                total.add_incoming(builder.select(applies, more, total), builder.block)
        at.add_incoming(following, builder.block)
        builder.cbranch(builder.icmp_signed("<", following, self._columns), inside, after)
        ends = [(number, phi.incomings[-1][0]) for number, phi in zip(body.sums, sums, strict=True)]
        builder.position_at_end(after)
        for number, value in ends:
            is_largest = number.operation == "largest"
            zero = [] if is_largest else [ir.Constant(DOUBLE, 0.0)]
            of_all = self._reduced("fmax" if is_largest else "fadd", [*zero, value])
            self._once.values[number.place] = self._as_vector(of_all)

    def _same_for_all(self, each: Writer, body: Body) -> None:
        """Vectors of the numbers that a loop needs and that are the same for all members."""
        needed: dict[int, Number] = {}
        for number in [*body.works, *(number.of[0] for number in body.sums)]:
            needed |= {a.place: a for a in (*number.of, number) if not a.member}
        needed |= {number.place: number for _, number in body.stores if not number.member}
        for index, number in needed.items():
            each.values[index] = each.same_for_all(self._once.values[index], number)

    def _broadcast(self, value: ir.Value, vector: ir.VectorType) -> ir.Value:
        first = self._builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(INT, 0))
        lanes = ir.Constant(ir.VectorType(INT, self._width), [0] * self._width)
        return self._builder.shuffle_vector(first, ir.Constant(vector, ir.Undefined), lanes)

    def _pointer(self, location: Place, at: ir.Value, vector: ir.VectorType) -> ir.Value:
        assert location.array in BY_MEMBERS
        row = self._builder.mul(ir.Constant(LONG, location.at), self._columns)
        pointer = self._builder.gep(
            self._arrays[location.array], [self._builder.add(row, at)], source_etype=DOUBLE
        )
        return self._builder.bitcast(pointer, vector.as_pointer())

    def _reduced(self, operation: str, values: list[ir.Value]) -> ir.Value:
        name, module = f"llvm.vector.reduce.{operation}.v{self._width}f64", self._builder.module
        kind = ir.FunctionType(DOUBLE, [value.type for value in values])
        function = module.globals.get(name) or ir.Function(module, kind, name)
        return self._builder.call(function, values, fastmath=FLAGS)
