"""The values that loops compute with: numbers of LLVM, arrays and tuples of such, and objects of Python.

A value is its numbers of LLVM, and its form, which is the rest: a form with other numbers is another value.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from llvmlite import ir  # type: ignore[import-untyped]

from thruster_env.graphs.arithmetic import BOOL, Untranslated, as_value, is_known
from thruster_env.graphs.instructions import DOUBLE, LONG


class Array(NamedTuple):
    """An array of float64: the address of its first number, its lengths, and the steps along them, in numbers."""

    pointer: ir.Value
    shape: tuple
    steps: tuple


class Known(NamedTuple):
    """The form of an object of Python; what else than its value tells it from equal ones."""

    value: Any
    kind: Any


def form_of(value: Any, numbers: list) -> Any:
    """What there is of a value beside its numbers of LLVM, which are appended to `numbers`."""
    if isinstance(value, ir.Value):
        numbers.append(value)
        return value.type
    if isinstance(value, tuple) and not is_known(value):
        return type(value), *(form_of(part, numbers) for part in value)
    return Known(value, repr(value) if isinstance(value, float | tuple) else type(value))


def value_of(form: Any, numbers: Iterator) -> Any:
    """The value of a form and its numbers."""
    if isinstance(form, ir.Type):
        return next(numbers)
    if isinstance(form, Known):
        return form.value
    kind, *parts = form
    entries = [value_of(part, numbers) for part in parts]
    return tuple(entries) if kind is tuple else kind(*entries)


def common_form(values: Sequence) -> Any:
    """The form of what is one of several values."""
    first = values[0]
    if all(is_known(value) and form_of(value, []) == form_of(first, []) for value in values):
        return form_of(first, [])
    if isinstance(first, tuple):
        if any(type(value) is not type(first) or len(value) != len(first) for value in values):
            raise Untranslated("results of different kinds")
        return type(first), *(common_form(parts) for parts in zip(*values, strict=True))
    kinds = {as_value(value).type for value in values}
    return kinds.pop() if len(kinds) == 1 else DOUBLE if DOUBLE in kinds else LONG


def changing_form(value: Any) -> Any:
    """The form of what changes, in which numbers are of LLVM."""
    if isinstance(value, tuple):
        return type(value), *map(changing_form, value)
    kind = as_value(value).type
    return LONG if kind == BOOL else kind


def is_tuple(value: Any) -> bool:
    """Whether a value is a tuple, and no array."""
    return isinstance(value, tuple) and not isinstance(value, Array)
