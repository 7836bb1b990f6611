"""Functions made of source text, which tracebacks and debuggers show under names that say their sizes."""

from __future__ import annotations

import linecache
import sys
import weakref
import zlib
from collections import Counter
from collections.abc import Callable, Iterable

from thruster_env.core.compiled import inlined

_shown: Counter[str] = Counter()  # files of texts, with the number of functions made of each
_MAKERS = (__name__, "thruster_env.core.sources")  # of which the names do not tell anything


def tuple_of(expressions: Iterable[str]) -> str:
    """Source of a tuple with the given expressions."""
    return "(" + "".join(f"{expression}, " for expression in expressions) + ")"


def matrix_of(rows: int, columns: int, entry: Callable[[int, int], str]) -> str:
    """Source of a matrix, a tuple of rows, whose entries have the sources entry(i, j)."""
    return tuple_of(tuple_of(entry(i, j) for j in range(columns)) for i in range(rows))


def written_out(name: str, arguments: str, *lines: str, _loops: bool = False, **names) -> Callable:
    """Make a function from source lines, whose last is the expression it returns; `names` are its globals.

    Tracebacks and debuggers show the source, under a name that says who made it, and for which sizes.
    """
    names["__name__"] = __name__  # without a module, pickling for numba's cache searches all of them
    body = "".join(f"    {line}\n" for line in (*lines[:-1], f"return {lines[-1]}"))
    text = f"def {name}({arguments}):\n{body}"
    file = _name_in_tracebacks(name, text)
    exec(compile(text, file, "exec"), names)
    made = inlined(names[name], into_callers=not _loops)
    _shown[file] += 1
    weakref.finalize(made, _forget, file).atexit = False
    return made


def _forget(file: str) -> None:
    """Drop a text of which there is no function any more."""
    _shown[file] -= 1
    if not _shown[file]:
        del _shown[file]
        linecache.cache.pop(file, None)


def _name_in_tracebacks(name: str, text: str) -> str:
    """A file name for a text, under which `linecache` finds it.

    Numba finds machine code again by the function's code, of which the name is a part: so it holds a digest of the
    text, and no number, which would depend on what the process has made before.
    """
    frame = sys._getframe(2)
    while frame.f_globals.get("__name__") in _MAKERS and frame.f_back is not None:
        frame = frame.f_back
    code, values = frame.f_code, frame.f_locals
    sizes = (values.get(argument) for argument in code.co_varnames[: code.co_argcount])
    shown = ", ".join(str(size) for size in sizes if type(size) is int)
    maker, digest = f"{frame.f_globals.get('__name__')}.{code.co_name}({shown})", zlib.crc32(text.encode())
    file = f"<{name}, written out by {maker}, {digest:08x}>"
    linecache.cache[file] = (len(text), None, text.splitlines(keepends=True), file)
    return file


def made_here(function: Callable) -> bool:
    """Whether a function was written out, and so returns what is large as an array."""
    return getattr(function, "__module__", None) == __name__
