"""A function of a model as lines of another language, obtained by running it on symbols.

It accepts functions made of + - * / // % abs ** min max and the elementary functions of `math` and numpy, and
their callees. A function that branches on a value cannot be traced.
"""

from __future__ import annotations

import builtins
import linecache
import types
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from thruster_env.core.user_functions import needs_floats
from tuning.reporting import symbols
from tuning.reporting.symbols import Branch, Symbol, Tape, on_symbols, text

OWN = (__file__, symbols.__file__)


def traced(function: Callable, arguments: Sequence[Sequence[str]], constants: Any) -> list[str]:
    """Lines "t1 = a + b;" of a function and, last, "[t7; t9]", its results.

    Args:
        function: of a model, which takes tuples of components and the constants last.
        arguments: names of the components of each tuple.
        constants: of the model.

    Raises:
        ValueError: in one line, with that of the function, where it cannot be traced.
    """
    rule = "a function to be written out must be made of operators and elementary functions, but"
    if reason := needs_floats(function):
        raise ValueError(f"{rule} {reason}")
    tape = Tape()
    try:
        run = _rebound(function, {})
        found = run(*(tuple(Symbol(tape, name) for name in names) for names in arguments), constants)
        results = [text(one) for one in found]
    except (TypeError, AttributeError, ValueError, ArithmeticError, LookupError) as error:
        what = str(error) if isinstance(error, Branch) else f"cannot be run on symbols ({_first_line(error)})"
        raise ValueError(f"{rule} {_place(error, function)} {what}") from None
    return [*(f"{name} = {told};" for name, told in tape.lines(results)), f"[{'; '.join(results)}]"]


def _rebound(value: Any, seen: dict[int, Any]) -> Any:
    """A function with what it calls by name, and the functions in its closure, put on symbols; else the value."""
    if not isinstance(value, types.FunctionType):
        return on_symbols(value)
    if id(value) in seen:
        return seen[id(value)]
    code, names = value.__code__, dict(value.__globals__)
    cells = None if value.__closure__ is None else tuple(types.CellType() for _ in value.__closure__)
    other = types.FunctionType(code, names, value.__name__, value.__defaults__, cells)
    other.__kwdefaults__ = value.__kwdefaults__
    seen[id(value)] = other
    for name in _names(code):
        if name in names:
            names[name] = _rebound(names[name], seen)
        elif hasattr(builtins, name):
            names[name] = on_symbols(getattr(builtins, name))
    for cell, before in zip(cells or (), value.__closure__ or (), strict=True):
        try:
            cell.cell_contents = _rebound(before.cell_contents, seen)
        except ValueError:  # an empty one
            continue
    return other


def _names(code: types.CodeType) -> set[str]:
    inner = [_names(one) for one in code.co_consts if isinstance(one, types.CodeType)]
    return set(code.co_names).union(*inner)


def _place(error: BaseException, function: Callable) -> str:
    """The last line of the user's that an error came through."""
    found, at = None, error.__traceback__
    while at is not None:
        if at.tb_frame.f_code.co_filename not in OWN:
            found = at
        at = at.tb_next
    if found is None:
        return getattr(function, "__name__", "a function")
    file = found.tb_frame.f_code.co_filename
    line = linecache.getline(file, found.tb_lineno).strip()
    return f"{Path(file).name}, line {found.tb_lineno},{f' {line!r},' if line else ''}"


def _first_line(error: BaseException) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
