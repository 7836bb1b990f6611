"""A user's functions as code: what they call and read, copies with other names bound, whether they are compiled.

Code is read where a call would not tell: whether a function catches exceptions, which machine code does not raise,
or asks whether a comparison `is True`, which holds for Python's truth values alone.

`graphs.loops` translates plain Python functions into machine code. Within `interpreted()`, or with the environment
variable NUMBA_DISABLE_JIT=1, the same functions run as Python.
"""

from __future__ import annotations

import builtins
import contextlib
import copy
import dis
import enum
import functools
import hashlib
import inspect
import itertools
import logging
import math
import os
import sys
import threading
import types
import warnings
import weakref
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np


def is_plain(value: Any) -> bool:
    """Whether a value is a number, a text, an array of these, a tuple of such, or None."""
    if isinstance(value, tuple):
        return all(map(is_plain, value))
    plain = bool | int | float | complex | str | bytes | np.generic
    return (
        value is None or isinstance(value, plain) or (isinstance(value, np.ndarray) and not value.dtype.hasobject)
    )


def names_read(code: types.CodeType) -> list[str]:
    """Names of globals and attributes in a function's code and in that of functions within it, sorted."""
    return sorted({name for part in codes_in(code) for name in part.co_names})


def codes_in(code: types.CodeType) -> Iterator[types.CodeType]:
    """Some code, and that of functions within it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from codes_in(constant)


LIBRARIES = {*sys.stdlib_module_names, "numpy", "scipy", "numba", "torch"} - {"__main__"}  # not a user's functions
NO_FUNCTIONS = bool | int | float | complex | str | bytes | np.ndarray | np.generic | None
OURS = "thruster_env", "filters", "tuning"  # packages whose functions do not change
WRITTEN_OUT = "thruster_env.core.sources"  # the module of functions that are made of text
MODULES = math, np, np.linalg  # of whose functions copies find others
CALL = ("__call__",)  # what is read of a value that is called
CATCHING = {"CHECK_EXC_MATCH", "CHECK_EG_MATCH"}  # instructions of `except Kind:`


def functions_in(*values: Any) -> Iterator[types.FunctionType]:
    """A user's functions among some values, and all that these may call: by name, in closures, of objects."""
    waiting: list[tuple[Any, tuple[str, ...]]] = [(value, CALL) for value in values]  # with names read of it
    visited: dict[int, Any] = {}  # the objects, too, so that no new one gets an id
    while waiting:
        value, names = waiting.pop()
        value = stands_for(getattr(value, "py_func", value))  # of a function compiled by numba
        if (id(value), names) in visited or _top(value) in LIBRARIES:
            continue
        visited[id(value), names] = value  # type: ignore[index]
        if isinstance(value, types.FunctionType):
            ours = _top(value) in OURS
            if not ours:
                yield value
            read = (*names_read(value.__code__), *CALL)
            parts = [cell.cell_contents for cell in value.__closure__ or () if not _is_empty(cell)]
            # Other functions of ours have a user's in closures alone.
            if not ours or value.__module__ == WRITTEN_OUT:
                parts += [value.__globals__[name] for name in read if name in value.__globals__]
            waiting += [(part, read) for part in (*parts, *(value.__defaults__ or ()))]
        elif isinstance(value, types.MethodType):
            code = getattr(value.__func__, "__code__", None)
            waiting += [(value.__func__, CALL), (value.__self__, tuple(names_read(code)) if code else ())]
        elif isinstance(value, functools.partial):
            waiting += [(part, names) for part in (value.func, *value.args, *value.keywords.values())]
        elif type(value) in (tuple, list, dict):
            waiting += [(part, names) for part in (value.values() if isinstance(value, dict) else value)]
        elif isinstance(value, staticmethod | classmethod):
            waiting.append((value.__func__, names))
        elif isinstance(value, property):
            waiting.append((value.fget, names))
        elif not isinstance(value, NO_FUNCTIONS):
            attributes = (inspect.getattr_static(value, name, None) for name in names)
            waiting += [(attribute, names) for attribute in attributes if attribute is not None]


def _top(value: Any) -> str:
    """The package of a function, class, module or object."""
    if isinstance(value, types.ModuleType):
        return value.__name__.partition(".")[0]
    if isinstance(value, tuple | list | dict | types.MethodType | functools.partial | staticmethod | classmethod):
        return ""
    module = getattr(value, "__module__", None) or type(value).__module__
    return module.partition(".")[0] if type(module) is str and module != "builtins" else ""


def _is_empty(cell: types.CellType) -> bool:
    try:
        return cell.cell_contents is cell
    except ValueError:
        return True


@functools.lru_cache(maxsize=128)
def caught(code: types.CodeType) -> tuple[tuple[int, int], ...]:
    """Parts (first, end) of code whose exceptions an `except` catches, without mere clean-up."""
    listed = dis.Bytecode(code)
    instructions = list(listed)
    index_at = {instruction.offset: i for i, instruction in enumerate(instructions)}

    def catches(target: int) -> bool:
        for instruction, after in itertools.pairwise(instructions[index_at[target] :]):
            names = instruction.opname, after.opname
            if instruction.opname in CATCHING or names == ("PUSH_EXC_INFO", "POP_TOP"):
                return True
            if instruction.opname == "WITH_EXCEPT_START":
                return "suppress" in code.co_names  # of contextlib
            if instruction.opname == "RERAISE":
                return False
        return False

    entries = listed.exception_entries  # type: ignore[attr-defined]
    return tuple((entry.start, entry.end) for entry in entries if catches(entry.target))


def catches_exceptions(code: types.CodeType) -> bool:
    """Whether some code, or that of a function within it, catches exceptions."""
    return any(map(caught, codes_in(code)))


def _asks_for_truth(code: types.CodeType) -> bool:
    """Whether some code asks if a value `is True`, as `match x > 0: case True` does."""
    return any(
        after.opname == "IS_OP" and before.opname == "LOAD_CONST" and type(before.argval) is bool
        for before, after in _neighbours(code)
    )


def inverts(code: types.CodeType) -> bool:
    """Whether code has a `~`, which means "not" only for NumPy's truth values and in machine code."""
    return any(part.opname == "UNARY_INVERT" for of in codes_in(code) for part in dis.get_instructions(of))


def takes_roots(code: types.CodeType) -> bool:
    """Whether code has powers other than those of whole numbers: with Python's floats they may be complex."""
    pairs = (pair for pair in _neighbours(code) if pair[1].argrepr in ("**", "**="))
    return any(type(before.argval) is not int for before, _ in pairs) or "pow" in names_read(code)


def _neighbours(code: types.CodeType) -> Iterator[tuple[dis.Instruction, dis.Instruction]]:
    for part in codes_in(code):
        yield from itertools.pairwise(dis.get_instructions(part))


def needs_python(*functions: Any) -> str | None:
    """Why functions must run as Python: they catch exceptions; else None."""
    for function in functions_in(*functions):
        if catches_exceptions(function.__code__):
            return f"{function.__name__} catches exceptions, and arithmetic raises some in Python alone"
    return None


def needs_floats(*functions: Any) -> str | None:
    """Why functions need Python's floats or machine code, and cannot be traced or take tensors; else None."""
    for function in functions_in(*functions):
        if _asks_for_truth(function.__code__):
            return f"{function.__name__} asks whether a comparison `is` True or False: == or an if would do"
    return needs_python(*functions)


class Module:
    """A module in which a function's copy finds other functions under some names."""

    def __init__(self, module: types.ModuleType, in_place_of: Callable[[types.ModuleType, str], Any]):
        self._module, self._in_place_of = module, in_place_of

    def __getattr__(self, name: str):
        return self._in_place_of(self._module, name)


class _Silent:
    """A stand-in for a logger or a module whose functions do nothing."""

    def __getattr__(self, name: str):
        return self

    def __call__(self, *arguments, **named):
        return None


WRITTEN = "<string>"  # the file of methods that `dataclass` and `NamedTuple` write
NOT_COPIED = {
    *"__new__ __init_subclass__ __getattribute__ __getattr__ __setattr__ __delattr__ __replace__".split(),
    *"_make _replace _asdict".split(),
}  # methods that say what an object is, and not what it computes


class Copies:
    """Copies of functions and of all that they call: functions, classes and objects of a user's.

    They find others under some names, in all modules of MODULES.
    """

    def __init__(
        self,
        in_place_of: Callable[[types.ModuleType, str], Any],
        names: Mapping[str, Any],
        *,
        silent: bool = False,
        of_function: Callable[[types.FunctionType], Callable] = lambda function: function,
        of_array: Callable[[np.ndarray], np.ndarray] | None = None,
    ):
        """Take what copies find in MODULES, by module and name, and in place of Python's functions.

        Silent copies neither log nor warn. `of_function` and `of_array` are what copies and arrays become.
        """
        self._in_place_of, self._names, self._silent = in_place_of, names, silent
        self._finished, self._of_array = of_function, of_array
        self._copies: dict[int, Any] = {}
        self._originals: list = []  # which live as long, so that no other value gets the id of one

    def of(self, value: Any) -> Any:
        """The copy of a function, class, object or collection; for another value its replacement in copies."""
        value = stands_for(getattr(value, "py_func", value))  # of a function compiled by numba
        if isinstance(value, types.ModuleType) and value in MODULES:
            return Module(value, self._in_place_of)
        if isinstance(value, types.ModuleType) and _top(value) not in LIBRARIES:
            return Module(value, lambda module, name: self.of(getattr(module, name)))
        if self._silent and (value is logging or value is warnings or isinstance(value, logging.Logger)):
            return _Silent()
        name = getattr(value, "__name__", "")
        for module in MODULES:
            if callable(value) and value is vars(module).get(name):  # NumPy warns if asked for its np.object
                return self._in_place_of(module, name)
        if isinstance(value, types.MethodType) and isinstance(value.__func__, types.FunctionType):
            return types.MethodType(self.of(value.__func__), self.of(value.__self__))
        if isinstance(value, functools.partial):
            return functools.partial(
                self.of(value.func), *map(self.of, value.args), **self._of_values(value.keywords)
            )
        if isinstance(value, functools._lru_cache_wrapper):  # numbers that are not known have no hash
            return self.of(value.__wrapped__)
        make = self._maker(value)
        if make is not None and id(value) not in self._copies:
            self._originals.append(value)
            self._copies[id(value)] = value  # for what holds itself
            self._copies[id(value)] = make(value)
        return value if make is None else self._copies[id(value)]

    def _maker(self, value: Any) -> Callable[[Any], Any] | None:
        """What copies a value; None if it stays."""
        if isinstance(value, types.FunctionType):
            return self._of_function
        if type(value) in (list, tuple):
            return lambda value: type(value)(map(self.of, value))
        if type(value) is dict:
            return self._of_values
        if type(value) is np.ndarray:
            return self._of_array
        if isinstance(value, type):
            return self._of_class if _has_methods(value) else None
        return self._of_object if _has_methods(type(value)) else None

    def _of_values(self, value: Mapping) -> dict:
        return {key: self.of(part) for key, part in value.items()}

    def _of_function(self, function: types.FunctionType) -> Callable:
        cells = tuple(types.CellType() for _ in function.__closure__ or ())
        names = vars(builtins) | dict(self._names)
        importing = {"__import__": lambda *which: self.of(builtins.__import__(*which))}
        names["__builtins__"] = vars(builtins) | importing  # also for what NumPy imports late
        defaults = function.__defaults__ and tuple(map(self.of, function.__defaults__))
        other = types.FunctionType(function.__code__, names, function.__name__, defaults, cells)
        other.__kwdefaults__ = function.__kwdefaults__ and self._of_values(function.__kwdefaults__)
        self._copies[id(function)] = finished = self._finished(other)
        read = [name for name in names_read(function.__code__) if name in function.__globals__]
        names |= {name: self.of(function.__globals__[name]) for name in read}
        for name, cell, old in zip(function.__code__.co_freevars, cells, function.__closure__ or (), strict=True):
            # `super()` goes on from the class that has the method.
            cell.cell_contents = old.cell_contents if name == "__class__" else self.of(old.cell_contents)
        return finished

    def _of_class(self, kind: type) -> type:
        """A class derived from a user's, with copies of its methods."""
        derived = type(kind)(kind.__name__, (kind,), {"__slots__": (), "__module__": kind.__module__})
        self._copies[id(kind)] = derived
        for base in reversed(kind.__mro__):
            for name, member in _methods(base):
                setattr(derived, name, self._of_member(member))
        return derived

    def _of_member(self, member: Any) -> Any:
        if isinstance(member, property):
            return property(*(part and self.of(part) for part in (member.fget, member.fset, member.fdel)))
        if isinstance(member, functools.cached_property):  # which may have been computed of other numbers
            return property(self.of(member.func))
        if isinstance(member, staticmethod | classmethod):
            return type(member)(self.of(member.__func__))
        return self.of(member)

    def _of_object(self, value: Any) -> Any:
        """An object of the copied class, with copies of its attributes."""
        kind = self.of(type(value))
        if isinstance(value, tuple):
            return tuple.__new__(kind, map(self.of, value))
        other = copy.copy(value)
        if other is value:  # there is one of it
            return value
        object.__setattr__(other, "__class__", kind)
        self._copies[id(value)] = other
        for name, part in getattr(value, "__dict__", {}).items():
            other.__dict__[name] = self.of(part)
        return other


def _has_methods(kind: type) -> bool:
    """Whether a class has methods of a user's, and others may be derived from it."""
    derivable = not isinstance(kind, enum.EnumType) and not hasattr(kind.__init_subclass__, "__func__")
    return derivable and any(True for base in kind.__mro__ for _ in _methods(base))


def _methods(kind: type) -> Iterator[tuple[str, Any]]:
    """Names and members of a user's class that are functions which the user wrote."""
    if _top(kind) in LIBRARIES or _top(kind) in (*OURS, ""):
        return
    functions = types.FunctionType, property, functools.cached_property, staticmethod, classmethod
    for name, member in vars(kind).items():
        is_written = getattr(getattr(member, "__code__", None), "co_filename", "") == WRITTEN
        if isinstance(member, functions) and name not in NOT_COPIED and not is_written:
            yield name, member


def is_copy(frame: types.FrameType) -> bool:
    """Whether a frame runs the copy of a function."""
    return frame.f_globals.get("__name__") == "builtins"


_stand_ins: weakref.WeakKeyDictionary[Callable, Callable] = weakref.WeakKeyDictionary()


def stand_in(other: Callable, function: Callable) -> Callable:
    """Register a function that filters call in place of another; return it."""
    _stand_ins[other] = function
    return other


def stands_for(value: Any) -> Any:
    """The function that a function stands for; other values as they are."""
    try:
        return _stand_ins.get(value, value)
    except TypeError:  # nothing that a weak reference or a hash can be had of
        return value


_MADE: weakref.WeakKeyDictionary[Callable, Made] = weakref.WeakKeyDictionary()


class Made(NamedTuple):
    """How to make a function: maker(*arguments), or an entry of the tuple or dictionary that this returns."""

    maker: Callable
    arguments: tuple
    key: Any = None


def remember(function: Callable, recipe: Made) -> None:
    """Keep the recipe of a function as long as the function lives; the first one counts."""
    _MADE.setdefault(function, recipe)


def as_made(value: Any) -> Any:
    """The picklable recipe of a generated function; other values as they are."""
    try:
        recipe = _MADE.get(value)
    except TypeError:  # nothing that a weak reference or a hash can be had of
        return value
    return value if recipe is None else recipe._replace(arguments=tuple(map(as_made, recipe.arguments)))


def as_function(value: Any) -> Any:
    """The function that `as_made` stands for; other values as they are."""
    if not isinstance(value, Made):
        return value
    result = value.maker(*map(as_function, value.arguments))
    return result if value.key is None else result[value.key]


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
