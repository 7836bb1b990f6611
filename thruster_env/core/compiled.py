"""Whether functions run as machine code or as Python, and what machine code may do with their arithmetic.

`graphs.loops` translates plain Python functions into machine code. Within `interpreted()`, or with the environment
variable NUMBA_DISABLE_JIT=1, the same functions run as Python.
"""

from __future__ import annotations

import atexit
import contextlib
import dis
import functools
import hashlib
import importlib
import inspect
import os
import shutil
import tempfile
import threading
import types
import weakref
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from thruster_env.core.files import is_private
from thruster_env.core.user_functions import OURS, code_text, codes_in, names_read

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


def sources_hash(*packages: str) -> str:
    """Hash of all source files of packages."""
    digest = hashlib.sha256()
    for package in packages:
        for path in sorted(Path(importlib.import_module(package).__path__[0]).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def private_folder() -> str | None:
    """A temporary folder that no other user can write, because the code loaded from it is run."""
    try:
        folder = Path(tempfile.gettempdir()) / f"thruster-env-{os.getuid() if hasattr(os, 'getuid') else 'code'}"
        try:
            folder.mkdir(mode=0o700)
        except FileExistsError:
            if not is_private(folder):
                folder = Path(tempfile.mkdtemp(prefix="thruster-env-"))  # lasts as long as the process
                atexit.register(shutil.rmtree, folder, ignore_errors=True)
        return str(folder)
    except OSError:
        return None
