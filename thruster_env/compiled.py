"""Compilation: plain Python functions in, cached machine code out, one source for both.

Functions marked `inlined` stay ordinary Python and may be called by any function given to `compiled`.
numba is imported at the first compilation only, which keeps `import thruster_env` light. With the
environment variable NUMBA_DISABLE_JIT=1 everything runs as Python.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import importlib.util
import inspect
from collections.abc import Callable
from pathlib import Path

# No "nnan" and "ninf": with them isfinite and isnan are compiled away, and failures would pass unseen.
FASTMATH = frozenset({"contract", "reassoc", "arcp", "nsz", "afn"})

_waiting: list[tuple[Callable, bool]] = []
_marked: set[Callable] = set()
_interpreting = False


def inlined(function: Callable) -> Callable:
    """Mark a plain function so that compiled functions may call it; it is inlined into all of them.

    Right for what stands in a loop over members or copies, which then becomes vector code.
    """
    return _mark(function, inline=True)


def compilable(function: Callable) -> Callable:
    """Mark a plain function so that compiled functions may call it, inlined or not as the compiler likes.

    Right for whatever does not stand in a loop over members: it compiles several times faster.
    """
    return _mark(function, inline=False)


def _mark(function: Callable, *, inline: bool) -> Callable:
    if function not in _marked:
        _marked.add(function)
        _waiting.append((function, inline))
    return function


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
    """Whether `compiled` leaves functions as they are."""
    return _interpreting


def compiled(function: Callable) -> Callable:
    """Compile a function with numba, cached on disk, releasing the interpreter lock while it runs."""
    if _interpreting:
        return function
    import numba
    from numba.extending import register_jitable

    while _waiting:
        waiting, inline = _waiting.pop()
        # LLVM inlines small functions only, and vectorises no loop with a call left in it.
        register_jitable(forceinline=inline)(waiting)
    return numba.njit(cache=True, nogil=True, fastmath=set(FASTMATH), error_model="numpy")(function)


def tell_when_compiling(tell: Callable[[], None]) -> None:
    """Call `tell` once, at the first real compilation; loading from the cache does not count."""
    from numba.core import event

    class Once(event.Listener):
        waiting = True

        def on_start(self, event):
            if self.waiting:
                self.waiting = False
                tell()

        def on_end(self, event):
            pass

    event.register("numba:compile", Once())


@functools.cache
def source_fingerprint() -> str:
    """Hash of the sources that compiled functions may inline; numba's cache looks at the outermost only."""
    digest = hashlib.sha256()
    for package in ("thruster_env", "filters"):
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or []) if spec else []:
            for path in sorted(Path(folder).glob("*.py")):
                digest.update(path.read_bytes())
    return digest.hexdigest()


def function_fingerprint(*functions: Callable | None) -> str:
    """Hash of what the given functions do: the text of their modules, else their byte code."""
    digest = hashlib.sha256(source_fingerprint().encode())
    for function in functions:
        if function is None:
            continue
        code = function.__code__
        digest.update(repr((code.co_name, code.co_code, code.co_consts, code.co_names)).encode())
        try:
            digest.update(Path(inspect.getsourcefile(function) or "").read_bytes())
        except (OSError, TypeError):
            pass  # defined in a notebook or a prompt: the byte code above tells changes apart
    return digest.hexdigest()
