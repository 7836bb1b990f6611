"""Loops over the members of an ensemble as instructions of LLVM, for eight members at a time.

Numbers that are the same for all members are worked out once, before the loop that needs them. Sums are kept for
each of the eight, and added when the loop ends. The table has columns for whole vectors: what lies in those behind
the last member is worked out, too, but counts in no sum.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.extending import lower_builtin, type_callable

from thruster_env.graphs.graphs import Number
from thruster_env.graphs.instructions import DOUBLE, FLAGS, LONG, Writer
from thruster_env.graphs.loops import Body, Cut, cut
from thruster_env.graphs.programs import BY_MEMBERS, OF_MEMBERS, Place, Program

INT = ir.IntType(32)


def teach_loops(work: Callable, program: Program, width: int, scratch: int) -> None:
    """Have numba put the instructions of a program with loops in the place of a call of `work`."""

    @type_callable(work)
    def of_arrays(context):
        return eval(f"lambda {', '.join(OF_MEMBERS)}: none", {"none": types.none})

    @lower_builtin(work, *[types.Array] * 5, types.Integer)
    def write(context, builder, signature, arguments):
        *kinds, kind = signature.args
        arrays = [
            context.make_array(one)(context, builder, a) for one, a in zip(kinds, arguments[:-1], strict=True)
        ]
        columns = builder.extract_value(arrays[OF_MEMBERS.index("table")].shape, 1)
        size = context.cast(builder, arguments[-1], kind, types.int64)
        data = dict(zip(OF_MEMBERS, (one.data for one in arrays), strict=False))
        _LoopWriter(context, builder, data, width, columns, size).write(cut(program, scratch))
        return context.get_dummy_value()


class _LoopWriter:
    """Writes what is done once, and loops."""

    def __init__(
        self, context, builder: ir.IRBuilder, arrays: dict, width: int, columns: ir.Value, size: ir.Value
    ):
        self._context, self._builder, self._arrays, self._width = context, builder, arrays, width
        self._columns, self._size = columns, size
        self._once = Writer(context, builder, arrays, 1)
        self._once.values_of["size"] = self._as_vector(builder.sitofp(size, DOUBLE))

    def _as_vector(self, value: ir.Value) -> ir.Value:
        one = ir.VectorType(DOUBLE, 1)
        return self._builder.insert_element(ir.Constant(one, ir.Undefined), value, ir.Constant(INT, 0))

    def write(self, parts: Cut) -> None:
        """All of it."""
        self._once.read(parts.reads)
        for turn in parts.turns:
            self._once.work(turn.works)
            for body in turn.bodies:
                self._loop(body)
        self._once.store(parts.stores)

    def _loop(self, body: Body) -> None:
        builder, width = self._builder, self._width
        each = Writer(self._context, builder, self._arrays, width)
        self._same_for_all(each, body)
        mask = self._lanes() if body.sums else None
        before = builder.block
        inside, after = builder.append_basic_block("members"), builder.append_basic_block("after")
        builder.branch(inside)
        builder.position_at_end(inside)
        at = builder.phi(LONG)
        at.add_incoming(ir.Constant(LONG, 0), before)
        vector = ir.VectorType(DOUBLE, width)
        sums = [builder.phi(vector) for _ in body.sums]
        for one, of in zip(sums, body.sums, strict=True):
            one.add_incoming(ir.Constant(vector, [-np.inf if of.operation == "largest" else 0.0] * width), before)
        each.pointer_of = lambda place: self._pointer(place, at, vector)
        each.read(body.reads)
        each.work(body.works)
        each.store(body.stores)
        following = builder.add(at, ir.Constant(LONG, width))
        if body.sums:
            left = self._to_all(builder.sub(self._size, at), ir.VectorType(LONG, width))
            counts = builder.icmp_signed("<", mask, left)
            for one, total in zip(body.sums, sums, strict=True):
                value = each.values[one.of[0].place]
                if one.operation == "largest":
                    more, found = value, builder.and_(counts, builder.fcmp_ordered(">", value, total))
                else:
                    more, found = builder.fadd(total, value, flags=FLAGS), counts
                total.add_incoming(builder.select(found, more, total), builder.block)
        at.add_incoming(following, builder.block)
        builder.cbranch(builder.icmp_signed("<", following, self._columns), inside, after)
        ends = [(one, phi.incomings[-1][0]) for one, phi in zip(body.sums, sums, strict=True)]
        builder.position_at_end(after)
        for one, value in ends:
            of_all = self._largest(value) if one.operation == "largest" else self._added(value)
            self._once.values[one.place] = self._as_vector(of_all)

    def _same_for_all(self, each: Writer, body: Body) -> None:
        """Vectors of the numbers that a loop needs and that are the same for all members."""
        needed: dict[int, Number] = {}
        for one in [*body.works, *(one.of[0] for one in body.sums)]:
            needed |= {a.place: a for a in (*one.of, one) if not a.member}
        needed |= {one.place: one for _, one in body.stores if not one.member}
        for place, one in needed.items():
            each.values[place] = each.same_for_all(self._once.values[place], one)

    def _lanes(self) -> ir.Value:
        return ir.Constant(ir.VectorType(LONG, self._width), list(range(self._width)))

    def _to_all(self, value: ir.Value, vector: ir.VectorType) -> ir.Value:
        one = self._builder.insert_element(ir.Constant(vector, ir.Undefined), value, ir.Constant(INT, 0))
        places = ir.Constant(ir.VectorType(INT, self._width), [0] * self._width)
        return self._builder.shuffle_vector(one, ir.Constant(vector, ir.Undefined), places)

    def _pointer(self, place: Place, at: ir.Value, vector: ir.VectorType) -> ir.Value:
        assert place.array in BY_MEMBERS
        row = self._builder.mul(ir.Constant(LONG, place.at), self._columns)
        pointer = self._builder.gep(self._arrays[place.array], [self._builder.add(row, at)], source_etype=DOUBLE)
        return self._builder.bitcast(pointer, vector.as_pointer())

    def _added(self, value: ir.Value) -> ir.Value:
        return self._reduced("fadd", [ir.Constant(DOUBLE, 0.0), value])

    def _largest(self, value: ir.Value) -> ir.Value:
        return self._reduced("fmax", [value])

    def _reduced(self, operation: str, values: list[ir.Value]) -> ir.Value:
        name, module = f"llvm.vector.reduce.{operation}.v{self._width}f64", self._builder.module
        kind = ir.FunctionType(DOUBLE, [one.type for one in values])
        function = module.globals.get(name) or ir.Function(module, kind, name)
        return self._builder.call(function, values, fastmath=FLAGS)
