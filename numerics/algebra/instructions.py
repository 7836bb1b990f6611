"""Programs as instructions of LLVM, each for as many runs as lie side by side.

numba takes a millisecond to type a line of text, and a program has hundreds. But all that numba has to know of
a program is that it is called: its instructions are given to LLVM directly. They are instructions for vectors
of numbers, one of each run, so that nobody has to find out whether some loop could be made of such.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

from llvmlite import ir  # type: ignore[import-untyped]
from numba.core import types
from numba.extending import lower_builtin, type_callable

from numerics.algebra.graphs import Number
from numerics.algebra.programs import SIDE_BY_SIDE, Place, Program
from numerics.compiled import FASTMATH

FLAGS = tuple(sorted(FASTMATH))
OF_TWO = {"+": "fadd", "-": "fsub", "*": "fmul", "/": "fdiv"}
OF_LLVM = {"sqrt": "sqrt", "exp": "exp", "log": "log", "sin": "sin", "cos": "cos", "abs": "fabs", "pow": "pow"} | {
    name: name for name in ("floor", "ceil")
}  # functions of vectors; others are called for each run
IN_LIBRARY = {"arctan": "atan", "arctan2": "atan2"}  # other names than NumPy's in C's library
DOUBLE, LONG = ir.DoubleType(), ir.IntType(64)


def teach(work: Callable, program: Program, width: int, names: Sequence[str]) -> None:
    """Have numba put the instructions of a program in the place of a call of `work`."""

    @type_callable(work)
    def of_arrays(context):
        return eval(f"lambda {', '.join(names)}: none", {"none": types.none})

    @lower_builtin(work, *[types.Array] * len(names))
    def write(context, builder, signature, arrays):
        data = [
            context.make_array(kind)(context, builder, a).data
            for kind, a in zip(signature.args, arrays, strict=True)
        ]
        _Writer(builder, dict(zip(names, data, strict=True)), width).write(program)
        return context.get_dummy_value()


class _Writer:
    """Writes instructions."""

    def __init__(self, builder: ir.IRBuilder, arrays: dict, width: int):
        """Begin; arrays are pointers to their first numbers."""
        self._builder, self._arrays, self._width = builder, arrays, width
        self._vector = ir.VectorType(DOUBLE, width)
        self._values: dict[int, ir.Value] = {}

    def write(self, program: Program) -> None:
        """All instructions of a program."""
        for place, number in program.reads:
            self._values[number.place] = self._read(place)
        for number in program.works:
            self._values[number.place] = self._worked_out(number)
        for place, number in program.stores:
            self._builder.store(self._values[number.place], self._pointer(place), align=8)

    def _pointer(self, place: Place) -> ir.Value:
        of_all = place.array in SIDE_BY_SIDE
        at = ir.Constant(LONG, place.at * (self._width if of_all else 1))
        pointer = self._builder.gep(self._arrays[place.array], [at], source_etype=DOUBLE)
        return self._builder.bitcast(pointer, self._vector.as_pointer()) if of_all else pointer

    def _read(self, place: Place) -> ir.Value:
        of_all = place.array in SIDE_BY_SIDE
        value = self._builder.load(self._pointer(place), align=8, typ=self._vector if of_all else DOUBLE)
        return value if of_all else self._same_for_all(value)

    def _same_for_all(self, value: ir.Value) -> ir.Value:
        places, nothing = ir.VectorType(ir.IntType(32), self._width), ir.Constant(self._vector, ir.Undefined)
        one = self._builder.insert_element(nothing, value, ir.Constant(ir.IntType(32), 0))
        return self._builder.shuffle_vector(one, nothing, ir.Constant(places, [0] * self._width))

    def _worked_out(self, number: Number) -> ir.Value:
        operation, builder = number.operation, self._builder
        if operation == "constant":
            return ir.Constant(self._vector, [number.value] * self._width)
        values = [self._values[one.place] for one in number.of]
        if operation in OF_TWO:
            return getattr(builder, OF_TWO[operation])(*values, flags=FLAGS)
        if operation == "negative":
            return builder.fneg(*values, flags=FLAGS)
        if operation == "where":
            return builder.select(*values)
        if operation == "and":
            return builder.and_(*values)
        if operation == "!=":
            return builder.fcmp_unordered(operation, *values)
        if operation in ("<", "<=", ">", ">=", "=="):
            return builder.fcmp_ordered(operation, *values)
        return self._called(operation, values)

    def _called(self, name: str, values: list[ir.Value]) -> ir.Value:
        builder, module = self._builder, self._builder.module
        if name in OF_LLVM:
            function = _declared(module, f"llvm.{OF_LLVM[name]}.v{self._width}f64", self._vector, len(values))
            return builder.call(function, values, fastmath=FLAGS)
        function, found = _declared(module, IN_LIBRARY.get(name, name), DOUBLE, len(values)), values[0]
        for k in range(self._width):
            at = ir.Constant(ir.IntType(32), k)
            one = builder.call(function, [builder.extract_element(value, at) for value in values])
            found = builder.insert_element(found, one, at)
        return found


def _declared(module: ir.Module, name: str, kind: ir.Type, count: int) -> ir.Function:
    """The function of some arguments of a kind that returns such a one, by its name."""
    return module.globals.get(name) or ir.Function(module, ir.FunctionType(kind, [kind] * count), name)
