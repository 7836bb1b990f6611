"""Whether functions run as machine code or as Python, and what machine code may do with their arithmetic.

`graphs.loops` translates plain Python functions into machine code. Within `interpreted()`, or with the environment
variable NUMBA_DISABLE_JIT=1, the same functions run as Python.
"""

from __future__ import annotations

import contextlib
import dis
import functools
import hashlib
import inspect
import os
import threading
import types
import weakref
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.user_functions import OURS, codes_in, is_plain, names_read

# No "nnan" and "ninf": with them isfinite and isnan are compiled away, and failures would pass unseen.
FASTMATH = frozenset({"contract", "reassoc", "arcp", "nsz", "afn"})

JUMPS = frozenset("floor ceil trunc fix rint round fmod mod remainder floor_divide divmod".split())
IN_PYTHON = "the model runs as Python, some hundred times slower"

_instead: weakref.WeakKeyDictionary[Callable, Callable[[], Instead]] = weakref.WeakKeyDictionary()
_finding = threading.RLock()
_interpreting = os.environ.get("NUMBA_DISABLE_JIT", "").strip() not in ("", "0")


class Instead(NamedTuple):
    """What machine code has in place of a function.

    Attributes:
        function: another one, which it calls; None if the function runs as Python.
        reason: why the function is not traced, with its name and line; empty if it is.
    """

    function: Callable | None
    reason: str = ""


def compiled_in_place_of(function: Callable, find: Callable[[], Instead]) -> Callable:
    """Mark a function in whose place machine code has another one: `find()`, asked once, when it is needed.

    `find` must not hold the function itself, which lives as long as somebody has it.
    """
    _instead[function] = functools.cache(find)
    return function


def instead_of(function: Callable) -> Instead | None:
    """What machine code has in place of a function; None if nothing else."""
    if function not in _instead:
        return None
    with _finding:  # one thread traces, others wait
        return _instead[function]()


@contextlib.contextmanager
def interpreted():
    """Within this context nothing is compiled: the same sources run as Python, for tests and debugging."""
    global _interpreting
    before, _interpreting = _interpreting, True
    try:
        yield
    finally:
        _interpreting = before


def is_interpreting() -> bool:
    """Whether functions run as Python."""
    return _interpreting


def fastmath_of(function: Callable) -> set[str]:
    """What LLVM may do with the arithmetic of a function.

    Division in a user's function stays a division: 49/49 is 1, but 49 * (1/49) is less. A function that rounds is
    compiled exactly as written, because one ulp may change its result.
    """
    if (function.__module__ or "").partition(".")[0] in OURS:
        return set(FASTMATH)
    code = getattr(function, "__code__", None)  # an object that is called has none
    return {"nsz"} if code is not None and rounds(code) else set(FASTMATH - {"arcp"})


def rounds(code: types.CodeType) -> bool:
    """Whether a function rounds numbers or computes remainders."""
    signs = {"%", "//", "%=", "//="}
    return not JUMPS.isdisjoint(names_read(code)) or any(
        instruction.opname == "BINARY_OP" and instruction.argrepr in signs
        for part in codes_in(code)
        for instruction in dis.get_instructions(part)
    )


def with_callees(functions: Iterable[Callable]) -> Iterator[Callable]:
    """Functions and all plain functions that they call by a global name or have in closures, each once."""
    visited: set[Callable] = set()
    waiting = list(functions)
    while waiting:
        function = waiting.pop()
        if function not in visited and isinstance(function, types.FunctionType):
            visited.add(function)
            yield function
            cells = [cell.cell_contents for cell in function.__closure__ or ()]
            names = (function.__globals__.get(name) for name in function.__code__.co_names)
            waiting += [part for part in (*cells, *names) if isinstance(part, types.FunctionType)]


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
    captured = dict(zip(code.co_freevars, (cell.cell_contents for cell in cells), strict=True))
    return sorted(
        {**_values_in(captured, code.co_freevars, ""), **_values_in(function.__globals__, names, "")}.items()
    )


def _values_in(scope: dict, names, prefix: str, above: tuple = ()) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for name in names:
        value = scope.get(name)
        if isinstance(value, types.ModuleType) and value not in above:
            values |= _values_in(vars(value), names, f"{prefix}{name}.", (*above, value))
        elif value is not None and is_plain(value):
            values[prefix + name] = value
    return values


def _plain(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"array {value.dtype.str} {value.shape} {value.tobytes().hex()}"
    return f"({' '.join(map(_plain, value))})" if isinstance(value, tuple) else repr(value)


def _byte_code(code: types.CodeType) -> str:
    constants = [
        _byte_code(constant) if isinstance(constant, types.CodeType) else repr(constant)
        for constant in code.co_consts
    ]
    return " ".join([code.co_name, code.co_code.hex(), *constants, *code.co_names])


def function_fingerprint(*functions: Callable) -> str:
    """Hash of the byte code of functions, of all that they call by name, and of the values that these read.

    The values may be in other files. Of users' functions it covers the files, too.
    """
    digest = hashlib.sha256()
    for function in with_callees(functions):
        digest.update(code_text(function).encode())
        if (function.__module__ or "").partition(".")[0] not in OURS:
            with contextlib.suppress(OSError, TypeError):  # from a prompt: the byte code tells changes apart
                digest.update(Path(inspect.getsourcefile(function) or "").read_bytes())
    return digest.hexdigest()
