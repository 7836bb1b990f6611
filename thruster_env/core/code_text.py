"""What a function computes, as text: its byte code, its constants and the values that it finds under its names."""

from __future__ import annotations

import types
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np


def code_text(function: Callable) -> str:
    """Byte code and constants of a plain function, and the values that it reads.

    Functions that it calls are not followed. Compilation makes constants of values that a function reads, wherever
    they are: a number imported from another file, an attribute of a module, a cell of its closure.
    """
    code = function.__code__
    return " ".join([_byte_code(code), *(f"{name} {_plain(value)}" for name, value in values_read(function))])


def values_read(function: Callable) -> list[tuple[str, Any]]:
    """Names and values of all numbers, texts, tuples and arrays that a plain function reads, sorted by name."""
    code, cells = function.__code__, function.__closure__ or ()
    names = names_read(code)
    found = dict(zip(code.co_freevars, (cell.cell_contents for cell in cells), strict=True))
    return sorted(
        {**_values_in(found, code.co_freevars, ""), **_values_in(function.__globals__, names, "")}.items()
    )


def _values_in(scope: dict, names, prefix: str, above: tuple = ()) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name in names:
        value = scope.get(name)
        if isinstance(value, types.ModuleType) and value not in above:
            found |= _values_in(vars(value), names, f"{prefix}{name}.", (*above, value))
        elif value is not None and is_plain(value):
            found[prefix + name] = value
    return found


def is_plain(value: Any) -> bool:
    """Whether a value is a number, a text, an array of these, a tuple of such, or None."""
    if isinstance(value, tuple):
        return all(map(is_plain, value))
    plain = bool | int | float | complex | str | bytes | np.generic
    return (
        value is None or isinstance(value, plain) or (isinstance(value, np.ndarray) and not value.dtype.hasobject)
    )


def _plain(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"array {value.dtype.str} {value.shape} {value.tobytes().hex()}"
    return f"({' '.join(map(_plain, value))})" if isinstance(value, tuple) else repr(value)


def names_read(code: types.CodeType) -> list[str]:
    """Names of globals and attributes in a function's code and in that of functions within it, sorted."""
    return sorted({name for one in _codes(code) for name in one.co_names})


def _codes(code: types.CodeType) -> Iterator[types.CodeType]:
    yield code
    for one in code.co_consts:
        if isinstance(one, types.CodeType):
            yield from _codes(one)


def _byte_code(code: types.CodeType) -> str:
    constants = [_byte_code(one) if isinstance(one, types.CodeType) else repr(one) for one in code.co_consts]
    return " ".join([code.co_name, code.co_code.hex(), *constants, *code.co_names])
