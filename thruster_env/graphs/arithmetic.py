"""Arithmetic of loops as instructions of LLVM; what is known already is computed at once.

Whole numbers have 64 bits, conditions one. NumPy's unsigned numbers are whole numbers, too: only a shift to the
right by one of them differs from that by a number of Python.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from functools import reduce
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]

from thruster_env.core.streams import nearest_whole
from thruster_env.graphs.instructions import DOUBLE, IN_LIBRARY, LONG, OF_LLVM

BOOL = ir.IntType(1)
OPERATORS: dict[str, Callable] = {  # of two known numbers
    **{"Add": operator.add, "Sub": operator.sub, "Mult": operator.mul, "Div": operator.truediv},
    **{"FloorDiv": operator.floordiv, "Mod": operator.mod, "Pow": operator.pow},
    **{"BitAnd": operator.and_, "BitOr": operator.or_, "BitXor": operator.xor},
    **{"LShift": operator.lshift, "RShift": operator.rshift},
    **{"Lt": operator.lt, "LtE": operator.le, "Gt": operator.gt, "GtE": operator.ge},
    **{"Eq": operator.eq, "NotEq": operator.ne, "Is": operator.is_, "IsNot": operator.is_not},
}
OF_WHOLE = {"Add": "add", "Sub": "sub", "Mult": "mul", "BitAnd": "and_", "BitOr": "or_", "BitXor": "xor"}
OF_WHOLE |= {"LShift": "shl", "RShift": "ashr"}
OF_FLOATS = {"Add": "fadd", "Sub": "fsub", "Mult": "fmul", "Div": "fdiv"}
COMPARISONS = {"Lt": "<", "LtE": "<=", "Gt": ">", "GtE": ">=", "Eq": "==", "NotEq": "!="}
BIAS, EXPONENTS = 1023, 2047  # of a float64's exponent: what is added to it, and its bits
MOST_FACTORS = 8  # of a power that is written as a product
OF_TWO = "arctan2", "hypot", "pow"  # functions of two numbers


class Untranslated(TypeError):
    """A function has what cannot be translated."""


class OnlyPython(Untranslated):
    """A user's function runs as Python, for the reason that this says."""


def is_known(value: Any) -> bool:
    """Whether a value is an object of Python, and not computed by the instructions."""
    return not isinstance(value, ir.Value | tuple) or isinstance(value, tuple) and all(map(is_known, value))


def as_value(value: Any) -> ir.Value:
    """A number as a value of LLVM."""
    if isinstance(value, ir.Value):
        return value
    kinds = (BOOL, bool | np.bool_), (LONG, int | np.integer), (DOUBLE, float | np.floating)
    for kind, known in kinds:
        if isinstance(value, known):
            return ir.Constant(kind, float(value) if kind == DOUBLE else int(value))
    raise Untranslated(f"a number must be known, or one of LLVM, but got a {type(value).__name__}")


class Arithmetic:
    """Operations on numbers, which a builder adds to its block."""

    def __init__(self, builder: ir.IRBuilder, flags: tuple[str, ...]):
        self.builder, self._flags = builder, flags

    def as_float(self, value: Any) -> ir.Value:
        """A number as a float."""
        value = as_value(float(value) if isinstance(value, int | np.integer) else value)
        return value if value.type == DOUBLE else self.builder.sitofp(self.as_whole(value), DOUBLE)

    def as_whole(self, value: Any) -> ir.Value:
        """A number as a whole number, if it is one."""
        value = as_value(value)
        if value.type == DOUBLE:
            raise Untranslated("a float in the place of a whole number")
        return self.builder.zext(value, LONG) if value.type == BOOL else value

    def cut(self, value: Any) -> Any:
        """Python's `int`."""
        if is_known(value):
            return int(value)
        return self.builder.fptosi(value, LONG) if value.type == DOUBLE else self.as_whole(value)

    def cut_unsigned(self, value: Any) -> Any:
        """NumPy's `uint64`."""
        if is_known(value):
            return np.uint64(value)
        return self.builder.fptoui(value, LONG) if value.type == DOUBLE else self.as_whole(value)

    def converted(self, kind: ir.Type, value: Any) -> ir.Value:
        """A number as one of a type."""
        value = as_value(value)
        if value.type == kind or kind not in (DOUBLE, LONG):
            return value
        return self.as_float(value) if kind == DOUBLE else self.as_whole(value)

    def truth(self, value: Any) -> ir.Value:
        """Whether a number is not zero."""
        value = as_value(value)
        if value.type == DOUBLE:
            return self.builder.fcmp_unordered("!=", value, ir.Constant(DOUBLE, 0.0))
        return value if value.type == BOOL else self.builder.icmp_signed("!=", value, ir.Constant(LONG, 0))

    def of_two(self, name: str, a: Any, b: Any) -> Any:
        """An operation of Python's syntax tree, such as "Add" or "Lt", on two numbers."""
        if is_known(a) and is_known(b):
            try:
                return OPERATORS[name](a, b)
            except (ArithmeticError, ValueError) as error:  # where machine code goes on with inf or NaN
                raise Untranslated(f"{name} of {a} and {b}: {error}") from None
        if name in ("Is", "IsNot"):  # a number is none of the objects that are known
            return name == "IsNot"
        if name in COMPARISONS:
            return self._compared(name, a, b)
        if name == "Pow":
            return self._power(a, b)
        integer = DOUBLE not in (as_value(a).type, as_value(b).type)
        if integer and name in (*OF_WHOLE, "FloorDiv", "Mod"):
            return self._of_whole(name, a, b)
        if name not in OF_FLOATS:
            raise Untranslated(f"{name} of two numbers")
        return getattr(self.builder, OF_FLOATS[name])(self.as_float(a), self.as_float(b), flags=self._flags)

    def _of_whole(self, name: str, a: Any, b: Any) -> ir.Value:
        if name == "RShift" and isinstance(b, np.unsignedinteger):
            return self.builder.lshr(self.as_whole(a), self.as_whole(b))
        a, b, builder, zero = self.as_whole(a), self.as_whole(b), self.builder, ir.Constant(LONG, 0)
        if name in OF_WHOLE:
            return getattr(builder, OF_WHOLE[name])(a, b)
        # Python's `//` or `%`: LLVM rounds towards zero, Python down, and its remainder has the sign of b.
        rest = builder.srem(a, b)
        rounded_up = builder.and_(
            builder.icmp_signed("!=", rest, zero), builder.icmp_signed("<", builder.xor(rest, b), zero)
        )
        if name == "Mod":
            return builder.add(rest, builder.select(rounded_up, b, zero))
        return builder.sub(builder.sdiv(a, b), builder.zext(rounded_up, LONG))

    def _compared(self, name: str, a: Any, b: Any) -> ir.Value:
        a, b = as_value(a), as_value(b)
        if DOUBLE not in (a.type, b.type):
            return self.builder.icmp_signed(COMPARISONS[name], self.as_whole(a), self.as_whole(b))
        compare = self.builder.fcmp_unordered if name == "NotEq" else self.builder.fcmp_ordered
        return compare(COMPARISONS[name], self.as_float(a), self.as_float(b))

    def _power(self, a: Any, b: Any) -> ir.Value:
        if isinstance(b, int) and 0 < b <= MOST_FACTORS:
            return reduce(lambda product, factor: self.of_two("Mult", product, factor), [a] * b)
        return self.function("pow", a, b)

    def function(self, name: str, *arguments: Any) -> ir.Value:
        """A function of floats by its name in NumPy: an intrinsic of LLVM, or a function of C's library."""
        values, module = [self.as_float(value) for value in arguments], self.builder.module
        if len(values) != (2 if name in OF_TWO else 1):
            raise Untranslated(f"{name} of {len(values)} numbers")
        if name in OF_LLVM:
            return self.builder.call(
                module.declare_intrinsic(f"llvm.{OF_LLVM[name]}", [DOUBLE]), values, fastmath=self._flags
            )
        name = IN_LIBRARY.get(name, name)
        kind = ir.FunctionType(DOUBLE, [DOUBLE] * len(values))
        return self.builder.call(module.globals.get(name) or ir.Function(module, kind, name), values)

    def extreme(self, name: str, *values: Any) -> Any:
        """The least ("Lt") or the largest ("Gt") of numbers, or of a tuple of these, the first of equal ones."""
        if len(values) == 1:
            if type(values[0]) is not tuple or not values[0]:
                raise Untranslated("min or max of what is no tuple of numbers")
            (values,) = values
        first, *rest = values
        for value in rest:
            if is_known(first) and is_known(value):
                first = value if OPERATORS[name](value, first) else first
            else:
                kind = DOUBLE if DOUBLE in (as_value(first).type, as_value(value).type) else LONG
                first, value = self.converted(kind, first), self.converted(kind, value)
                first = self.builder.select(self.of_two(name, value, first), value, first)
        return first

    def exponent(self, x: Any) -> tuple[ir.Value, ir.Value]:
        """`math.frexp` of a normal number."""
        bits, of_two = self.bits_as(LONG, self.as_float(x)), self.of_two
        exponent = of_two("Sub", of_two("BitAnd", of_two("RShift", bits, 52), EXPONENTS), BIAS - 1)
        mantissa = of_two("BitOr", of_two("BitAnd", bits, ~(EXPONENTS << 52)), (BIAS - 1) << 52)
        return self.bits_as(DOUBLE, mantissa), exponent

    def with_exponent(self, x: Any, exponent: Any) -> Any:
        """`math.ldexp`, of a power of two that is a normal number."""
        power = self.bits_as(DOUBLE, self.of_two("LShift", self.of_two("Add", self.as_whole(exponent), BIAS), 52))
        return self.of_two("Mult", x, power)

    def bits_as(self, kind: ir.Type, value: Any) -> ir.Value:
        """The bits of a number as another number."""
        return self.builder.bitcast(as_value(value), kind)


NAMES = "sqrt exp log sin cos tan floor ceil rint arctan arctan2 sinh cosh tanh expm1 log1p hypot".split()
ROUNDED = "floor", "ceil", "rint"  # which are whole numbers, or lacking, in Python's module
MATH_NAMES = {"arctan": "atan", "arctan2": "atan2"}


def _of_floats(name: str) -> Callable:
    return lambda arithmetic, *values: arithmetic.function(name, *values)


def _magnitude(arithmetic: Arithmetic, x: Any) -> Any:
    return abs(x) if is_known(x) else arithmetic.function("abs", x)


def _as_known_float(arithmetic: Arithmetic, x: Any) -> Any:
    return float(x) if is_known(x) else arithmetic.as_float(x)


def _is_finite(arithmetic: Arithmetic, x: Any) -> ir.Value:
    return arithmetic.of_two("Lt", arithmetic.function("abs", x), math.inf)


def _is_nan(arithmetic: Arithmetic, x: Any) -> ir.Value:
    return arithmetic.of_two("NotEq", as_value(x), as_value(x))


FUNCTIONS: dict[Any, Callable] = {
    **{module.isfinite: _is_finite for module in (math, np)},
    **{module.isnan: _is_nan for module in (math, np)},
    **{getattr(np, name): _of_floats(name) for name in NAMES},
    **{getattr(math, MATH_NAMES.get(name, name)): _of_floats(name) for name in NAMES if name not in ROUNDED},
    math.floor: lambda arithmetic, x: arithmetic.cut(arithmetic.function("floor", x)),
    math.ceil: lambda arithmetic, x: arithmetic.cut(arithmetic.function("ceil", x)),
    math.erf: _of_floats("erf"),
    math.erfc: _of_floats("erfc"),
    math.frexp: Arithmetic.exponent,
    math.ldexp: Arithmetic.with_exponent,
    abs: _magnitude,
    np.abs: _magnitude,
    nearest_whole: lambda arithmetic, x: arithmetic.function("floor", arithmetic.of_two("Add", x, 0.5)),
    int: Arithmetic.cut,
    np.int64: Arithmetic.cut,
    np.uint64: Arithmetic.cut_unsigned,
    float: _as_known_float,
    np.float64: _as_known_float,
    bool: lambda arithmetic, x: bool(x) if is_known(x) else arithmetic.truth(x),
    min: lambda arithmetic, *values: arithmetic.extreme("Lt", *values),
    max: lambda arithmetic, *values: arithmetic.extreme("Gt", *values),
}
"""Functions of Python, NumPy and this package, as functions (arithmetic, *arguments)."""
OF_ENTRIES = {abs, np.abs, *(getattr(np, name) for name in NAMES)}
"""Those that take arrays entry by entry."""
