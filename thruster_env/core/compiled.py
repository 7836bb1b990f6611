"""Compilation: plain Python functions in, cached machine code out, one source for both.

Functions marked `inlined` stay ordinary Python and may be called by any function given to `compiled`. numba is
imported at the first compilation only, which keeps imports light. With the environment variable
NUMBA_DISABLE_JIT=1 everything runs as Python.

Machine code is stored beside the sources, except beside those that pip installed: pip would leave it there, and to
Python a folder of machine code alone is a package that hides the one of a checkout. Where numba cannot write,
existing code is read, and new code goes to a private temporary folder or lasts as long as the process; one warning
says so. `direct` calls machine code without numba's dispatch on the types of arguments.
"""

from __future__ import annotations

import atexit
import contextlib
import dis
import functools
import hashlib
import importlib.util
import inspect
import os
import shutil
import tempfile
import threading
import types
import warnings
import weakref
from collections.abc import Callable, Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.files import is_private
from thruster_env.core.modules import INLINED, when_imported
from thruster_env.core.optimising import Which, optimise_once
from thruster_env.core.user_functions import OURS, code_text, codes_in, names_read

RULE = "machine code must be kept where it can be written: set NUMBA_CACHE_DIR to a folder of yours; "
INSTALLED = {"site-packages", "dist-packages"}  # folders of what pip installs
_changing_config = threading.Lock()


# The storage of machine code: beside the sources, in the user's cache, or else in a private folder.


def keep_code(dispatcher):
    """Give a dispatcher of numba's a cache that bears folders and disks which take nothing; return it."""
    from numba.core.caching import FunctionCache

    function = dispatcher.py_func
    try:
        dispatcher._cache = Stores(
            [], _elsewhere(function) if _is_installed(function) else FunctionCache(function)
        )
    except RuntimeError:  # "no locator available"
        folder = _told_folder()
        dispatcher._cache = Stores(_readable(function), folder and _in_folder(function, folder))
    return dispatcher


class Stores:
    """Several of numba's caches: all are read, at most the last is written."""

    def __init__(self, readable: list, writable):
        self._readable, self._writable = [*readable, *([] if writable is None else [writable])], writable

    @property
    def cache_path(self) -> str | None:
        """Folder into which new code goes."""
        return None if self._writable is None else self._writable.cache_path

    def load_overload(self, signature, target):
        """The code for a signature, or None."""
        for store in self._readable:
            try:
                code = store.load_overload(signature, target)
            except Exception:  # another user's, or damaged in whatever way: as if it were not there
                continue
            if code is not None:
                return code
        return None

    def save_overload(self, signature, code) -> None:
        """Keep the code for a signature if that is possible."""
        if self._writable is None:
            return
        try:
            try:
                self._writable.save_overload(signature, code)
            except OSError:
                raise
            except Exception:  # the list of what there is is damaged
                self._writable.flush()
                self._writable.save_overload(signature, code)
        except OSError as error:
            _tell(f"{self.cache_path} does not take it ({error.strerror})")

    def enable(self) -> None:
        """As numba's caches have it."""

    disable = flush = enable


@cache
def _tell(where: str) -> None:
    warnings.warn(f"{RULE}{where}", stacklevel=2)


@cache
def _told_folder() -> str | None:
    """The private folder, after a line that says so; None where there is none."""
    folder = private_folder()
    neither = "neither the package's folder nor the user's cache is such"
    _tell(f"{neither}; it is in {folder}" if folder else f"{neither}; each process compiles anew")
    return folder


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


def _is_installed(function) -> bool:
    """Whether pip has installed the function's file, and may remove it."""
    return not INSTALLED.isdisjoint(Path(function.__code__.co_filename).parts)


def _elsewhere(function):
    """The cache of a function in a folder that is set, or in the user's own; RuntimeError if neither works."""
    return _cache_by(function, [locator for locator in _locators() if not locator.__name__.startswith("InTree")])


def _locators() -> list:
    from numba.core.caching import FunctionCache

    return list(FunctionCache._impl_class._locator_classes)


def _cache_by(function, locators: list):
    from numba.core.caching import FunctionCache

    implementation = type("Placed", (FunctionCache._impl_class,), {"_locator_classes": locators})
    return type("PlacedCache", (FunctionCache,), {"_impl_class": implementation})(function)


def _in_folder(function, folder: str):
    import numba
    from numba.core.caching import FunctionCache

    config: Any = numba.config  # a module that makes its settings when it is imported
    with _changing_config:
        before, config.CACHE_DIR = config.CACHE_DIR, folder
        try:
            return FunctionCache(function)
        except RuntimeError:  # the disk is full
            return None
        finally:
            config.CACHE_DIR = before


def _readable(function) -> list:
    """All existing caches of a function, writable or not."""
    caches = []
    for locator in _locators():
        reading = type(locator.__name__, (locator,), {"ensure_cache_path": _must_be_there})
        try:
            caches.append(_cache_by(function, [reading]))
        except (RuntimeError, OSError, ImportError):  # not in such a place
            continue
    return caches


def _must_be_there(locator) -> None:
    if not os.path.isdir(locator.get_cache_path()):
        raise FileNotFoundError


# No "nnan" and "ninf": with them isfinite and isnan are compiled away, and failures would pass unseen.
FASTMATH = frozenset({"contract", "reassoc", "arcp", "nsz", "afn"})

JUMPS = frozenset("floor ceil trunc fix rint round fmod mod remainder floor_divide divmod".split())

IN_PYTHON = "the model runs as Python, some hundred times slower"
MOST_WAITING = 10_000  # functions, above which those that nobody has any more are forgotten

# Weak references: a model's functions live as long as somebody has them.
_waiting: list[Callable[[], Callable | None]] = []
_marked: weakref.WeakSet[Callable] = weakref.WeakSet()
_called: weakref.WeakSet[Callable] = weakref.WeakSet()  # of these, functions that are called and not inlined
_apart: weakref.WeakSet[Callable] = weakref.WeakSet()  # of these, functions of which there is one copy
_asked: weakref.WeakSet[Callable] = weakref.WeakSet()  # functions that `compiled` has been given
_instead: weakref.WeakKeyDictionary[Callable, Callable[[], Instead]] = weakref.WeakKeyDictionary()
_lessons: list[Callable[[], None]] = [lambda: optimise_once(Which(_asked, _marked, _called, _apart))]
_untaught: weakref.WeakKeyDictionary[Callable, Callable[[Callable], None]] = weakref.WeakKeyDictionary()
_taught: weakref.WeakSet[Callable] = weakref.WeakSet()  # those of `_instead` that numba knows
_calls: weakref.WeakKeyDictionary[Callable, tuple[Callable, ...]] = weakref.WeakKeyDictionary()  # `overloaded`
_teaching = threading.RLock()  # numba must know all that a function calls before another thread compiles it
_interpreting = os.environ.get("NUMBA_DISABLE_JIT", "").strip() not in ("", "0")


def inlined(function: Callable, *, into_callers: bool = True) -> Callable:
    """Mark a plain function so that compiled functions may call it; it is inlined into all of them.

    So are functions that it calls by name. A loop over members or copies is vectorised only if it contains no
    call. With into_callers=False the function is called instead of inlined, and so are the functions that call it:
    loops over large arrays gain nothing from inlining, and would be optimised again in each caller.
    """
    if function not in _marked:
        _marked.add(function)
        callees = _callees(function)
        for callee in callees:  # a user's model may call helpers of its own
            inlined(callee)
        if not into_callers or any(callee in _called for callee in callees):
            _called.add(function)
        _waiting.append(weakref.ref(function))
        if len(_waiting) > MOST_WAITING:  # nothing may ever be compiled
            _waiting[:] = [reference for reference in _waiting if reference() is not None]
    return function


def not_inlined(function: Callable) -> Callable:
    """Mark a plain function that is never inlined: there is one copy of it, however many functions call it.

    It is meant for long loops, where the cost of a call does not matter. LLVM may still inline other functions.
    """
    _apart.add(function)
    return inlined(function, into_callers=False)


def overloaded(
    function: Callable, teach: Callable[[Callable], None] | None = None, calls: Iterable[Callable] = ()
) -> Callable:
    """Mark a plain function in whose place compiled functions have machine code, by `numba.extending.overload`.

    `teach(function)`, if there is one, says which; it is called before the next compilation, unless nobody has the
    function any more. The machine code may call other functions, `calls`.
    """
    _marked.add(function)
    _calls[function] = tuple(calls)
    if teach is not None:
        _untaught[function] = teach
    return function


class Instead(NamedTuple):
    """What compiled functions have in place of a function.

    Attributes:
        function: another one, which they call; None if the function runs as Python.
        key: what else than the code of both determines the machine code.
        fastmath: what machine code may reorder and contract of it.
        reason: why the function is not traced, with its name and line; empty if it is.
    """

    function: Callable | None
    key: str = ""
    fastmath: frozenset[str] = FASTMATH
    reason: str = ""


def compiled_in_place_of(function: Callable, find: Callable[[], Instead]) -> Callable:
    """Mark a function in whose place compiled functions have another one: `find()`, asked once, when it is needed.

    `find` must not hold the function itself, which lives as long as somebody has it.
    """
    _marked.add(function)
    _instead[function] = functools.cache(find)
    return function


def instead_of(function: Callable) -> Instead | None:
    """What compiled functions have in place of a function, without a reason if traced; None if nothing else."""
    return _instead[function]() if function in _instead else None


def _teach_other(function: Callable) -> None:
    from numba.extending import overload

    other, _, fastmath, _ = _instead[function]()
    if other is None:  # whatever calls it runs as Python
        return
    plain = other if isinstance(other, types.FunctionType) else lambda *arguments: other(*arguments)
    options: Any = {"forceinline": other not in _called, "no_cfunc_wrapper": True, "fastmath": set(fastmath)}
    overload(function, jit_options=options, strict=False)(lambda *arguments: plain)


def _teach_callees(function: Callable) -> None:
    """Have numba know the machine code that stands in the place of functions."""
    for part in _with_callees([function]):
        if part in _instead and part not in _taught:
            _teach_other(part)
            _taught.add(part)
    while _lessons or _untaught:  # a lesson may bring others
        if _lessons:
            _lessons.pop()()
            continue
        with contextlib.suppress(KeyError):  # the last one has just gone
            untaught, teach = _untaught.popitem()
            teach(untaught)


def when_compiling(teach: Callable[[], None]) -> Callable[[], None]:
    """Mark a function that registers something with numba; it is called once, before the first compilation."""
    _lessons.append(teach)
    return teach


def _callees(function: Callable) -> list[Callable]:
    """Plain functions that a function or its machine code calls by a global name, or has in its closure."""
    values = (*_values_in(function), *_calls.get(function, ()))
    return [part for part in values if isinstance(part, types.FunctionType)]


def _values_in(function: Callable) -> list:
    """What a function has in its closure or reads by a global name."""
    if not isinstance(function, types.FunctionType):
        return []
    cells = [cell.cell_contents for cell in function.__closure__ or ()]
    return [*cells, *(function.__globals__.get(name) for name in function.__code__.co_names)]


def _with_callees(functions: Iterable[Callable]) -> Iterator[Callable]:
    """Functions and all plain functions that they call, without repetition."""
    visited: set[Callable] = set()
    waiting = list(functions)
    while waiting:
        function = waiting.pop()
        if function not in visited:
            visited.add(function)
            yield function
            waiting += _callees(function)


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

    with _teaching:
        _teach_callees(function)
        while _waiting:
            inner = _waiting.pop()()
            if inner is not None:  # by itself LLVM inlines small ones only
                options: Any = {"forceinline": inner not in _called, "no_cfunc_wrapper": True}
                register_jitable(**options, fastmath=fastmath_of(inner))(inner)
        _asked.add(function)
    return keep_code(numba.njit(nogil=True, fastmath=set(FASTMATH), error_model="numpy")(function))


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


def tell_when_compiling(tell: Callable[[], None]) -> None:
    """Call `tell` once, at the first real compilation; loading from the cache does not count."""
    when_imported("numba", functools.partial(_listen, tell))


def _listen(tell: Callable[[], None]) -> None:
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
def _package_hash(package: str) -> str:
    digest = hashlib.sha256(package.encode())
    for below in INLINED.get(package, ()):
        digest.update(_package_hash(below).encode())
    spec = importlib.util.find_spec(package)
    for folder in (spec.submodule_search_locations or []) if spec else []:
        for path in sorted(Path(folder).rglob("*.py")):
            digest.update(path.read_bytes())
    return digest.hexdigest()


def function_fingerprint(*functions: Callable | None, within: str) -> str:
    """Hash of what a compiled function inlines; numba's cache itself looks at the outermost function only.

    It covers the byte code of `functions` and of all that they call by name, the values that these read by name
    (from other files, too), and the source files of their packages, of this package, and of the package of the
    module `within` which the compiled function is written.
    """
    digest = hashlib.sha256()
    packages = {package_of(__name__), package_of(within)}
    for function in _with_callees(function for function in functions if function is not None):
        digest.update(code_text(function).encode())
        if function in _instead:
            digest.update(_instead[function]().key.encode())
        package = package_of(function.__module__ or "")
        if package in INLINED:
            packages.add(package)
            continue
        with contextlib.suppress(OSError, TypeError):  # from a prompt: the byte code tells changes apart
            digest.update(Path(inspect.getsourcefile(function) or "").read_bytes())
    for package in sorted(packages):
        digest.update(_package_hash(package).encode())
    return digest.hexdigest()


def package_of(module: str) -> str:
    """The package that a module belongs to: the first part of its name, or one of thruster_env's packages."""
    return ".".join(module.split(".")[: 2 if module.startswith("thruster_env.") else 1])


class CompiledOrPython:
    """A function compiled at its first call, or run as Python, with one warning, if numba refuses it."""

    def __init__(self, function: Callable):
        self._python, self._run = function, compiled(function)
        self._proven = self._run is function
        self._first = threading.Lock()  # one thread compiles, or finds out that numba refuses

    def __call__(self, *arguments):
        """Call the function."""
        if not self._proven:
            with self._first:
                return self._call_first(*arguments)
        if self._run is self._python:
            with np.errstate(all="ignore"):  # compiled code does not warn of overflow either
                return self._run(*arguments)
        return self._run(*arguments)

    @property
    def in_python(self) -> bool:
        """Whether calls run as Python, as far as is known before the first."""
        return self._run is self._python

    @property
    def folder(self) -> str | None:
        """Where its machine code is kept; None where none is."""
        return getattr(getattr(self._run, "_cache", None), "cache_path", None)

    @property
    def direct(self) -> Callable:
        """The compiled function itself once it has run, so that calls avoid this object; else this object."""
        return self._run if self._proven and self._run is not self._python else self

    def _call_first(self, *arguments):
        if not self._proven:
            of_model = [_instead[called]() for called in _with_callees([self._python]) if called in _instead]
            if refused := [instead for instead in of_model if instead.function is None]:
                warnings.warn(f"{IN_PYTHON}: {refused[0].reason}", stacklevel=3)
                self._run, self._proven = self._python, True
                return self(*arguments)
            try:
                return self._run(*arguments)
            except Exception as error:  # numba's, of many classes: compiled code itself raises nothing
                reasons = [instead.reason for instead in of_model if instead.reason]
                warnings.warn(_refusal(self._python, error, *reasons), stacklevel=3)
                self._run = self._python
            finally:
                self._proven = True
        return self(*arguments)


def _refusal(function: Callable, error: Exception, *reasons: str) -> str:
    """The warning that a function runs as Python, and why: the user's model, this package or the machine.

    `reasons` say why functions of the model are not traced.
    """
    text, ours = str(error), []
    if isinstance(error, (OSError, MemoryError)):
        return f"{IN_PYTHON}: machine code of it could not be made: {text}"
    for called in _with_callees([function]):
        where = text.find(hex(id(called)))
        if (called.__module__ or "").partition(".")[0] in OURS:
            ours.append((where, called))
            if any(name in text for name in _objects_called(called)):
                break
        elif where >= 0 or getattr(getattr(called, "__code__", None), "co_filename", text) in text:
            break
    else:
        _, broken = max(ours, key=lambda pair: pair[0], default=(0, function))  # the innermost comes last
        return (
            f"{IN_PYTHON}: numba refuses {_described(broken)}: {_reason(error)}; "
            "this is a fault of the package and not of the model: please report it"
        )
    return f"{IN_PYTHON}: {'; '.join([*reasons, 'numba refuses it'])}: {_reason(error)}"


def _objects_called(function: Callable) -> list[str]:
    """Numba's names of the types of callable objects in a function that are no plain functions."""
    kinds = {type(callee) for callee in _values_in(function) if callable(callee)} - {types.FunctionType}
    return [f"{kind.__module__}.{kind.__qualname__}" for kind in kinds]


def _described(function: Callable) -> str:
    file = function.__code__.co_filename
    return file.strip("<>") if file.startswith("<") else f"{function.__name__} of {function.__module__}"


def _reason(error: Exception) -> str:
    # numba frames its reason with lines on where it was; the first that is none of those says what is wrong.
    frames = *"TypingError During Overload Rejected File >>>".split(), "Failed in", "There are", "- Of which"
    frames += "With argument", "No impl"
    lines = [line.strip() for line in str(error).splitlines()]
    telling = [line for line in lines if len(line) > 3 and not line.startswith(frames)]
    reason = telling[0] if telling else type(error).__name__
    calls = [line.removeprefix(">>>").strip() for line in lines if line.startswith(">>>")]
    unmatched = reason.lower().startswith(("no match", "raised from"))  # where only the call itself is telling
    return f"it has no {calls[0]}" if unmatched and calls else reason


def direct(function: Callable, *arguments) -> Callable:
    """The machine code of a compiled function for the types of these arguments; call it with such arguments only.

    At every call numba determines the type of each argument, which takes 0.2 us for three arrays, and then calls
    this machine code. Arrays must stay of the same number of dimensions, dtype, layout and writability, so
    it is meant for a memory of one's own.

    Args:
        function: compiled by `thruster_env.core.compiled`, and called before with arguments of these types;
            one that was not, or that runs as Python, is returned as it is.
        arguments: those of the calls to come, or others of their types.
    """
    compiled = function.direct if isinstance(function, CompiledOrPython) else function
    overloads = getattr(compiled, "overloads", None)
    if not overloads:
        return compiled
    from numba import typeof

    overload = overloads.get(tuple(typeof(argument) for argument in arguments))
    return compiled if overload is None else overload.entry_point
