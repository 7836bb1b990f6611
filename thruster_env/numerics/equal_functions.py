"""Functions with equal code and equal values stand for one another, as those that a factory writes at each call.

A function within a function is a new object whenever the outer one runs, and what is traced, compiled or compared
is found by the function. So in all these places the first of all equal functions stands for the others.
"""

from __future__ import annotations

import dis
import functools
import hashlib
import struct
import sys
import threading
import types
import weakref
from collections.abc import Callable, Hashable, Iterable
from typing import Any, NamedTuple

import numpy as np

from thruster_env.numerics.code_text import is_plain, names_read
from thruster_env.numerics.recipes import Made, as_made

EXACT = bool | int | str | bytes | None  # compared by type and value
CHANGES_OTHERS = {"STORE_GLOBAL", "DELETE_GLOBAL"}
CHANGES_PARTS = {"STORE_SUBSCR", "DELETE_SUBSCR", "STORE_ATTR", "DELETE_ATTR", "STORE_SLICE"}
CHANGING = {
    *("append", "appendleft", "extend", "insert", "pop", "popleft", "popitem", "remove", "clear", "sort"),
    *(
        "reverse",
        "add",
        "discard",
        "update",
        "setdefault",
        "setattr",
        "__setitem__",
        "__setattr__",
        "send",
        "write",
    ),
}  # methods after which a list, dictionary, set or object is another

OF_EVERY_TUPLE = {
    *vars(NamedTuple("Empty", [])),
    *(
        "__annotations__",
        "__annotate__",
        "__annotate_func__",
        "__annotations_cache__",
        "__orig_bases__",
        "__doc__",
    ),
    *(
        "__doc__",
        "__firstlineno__",
        "__static_attributes__",
        "__classdictcell__",
        "__qualname__",
        "__module__",
        "__dict__",
    ),
}  # members that tell nothing of a class beside its fields
MOST = 20_000  # values that a function may hold, to be compared
LARGEST = 1024  # bytes of an array that are kept to be compared: of more there is a hash

_first: weakref.WeakValueDictionary[Hashable, Any] = weakref.WeakValueDictionary()
_known: weakref.WeakKeyDictionary[Any, weakref.ref] = weakref.WeakKeyDictionary()
_finding = threading.Lock()


def first_equal(value: Any) -> Any:
    """The first living function that computes the same, for the same reasons, as a function; others as they are.

    Equal are byte code, constants, defaults, the values in the closure and those of globals that are read, of the
    function and of all that it calls; numbers to the last bit, and of the same type. Of an object of a user's
    class its type and attributes count, of all else that is no number, text, array or collection its identity. A
    function that changes what it holds, such as a counter, is equal to none. Classes of named tuples that are
    written within a function stand for one another in the same way, and so do parts of a tuple.
    """
    if type(value) is tuple:
        return tuple(map(first_equal, value))
    if not _is_written_within(value):
        return value
    try:
        with _finding:
            known = _known.get(value)
            found = None if known is None else known()
            if found is None:
                found = _found(value)
                _known[value] = weakref.ref(found)
            return found
    except TypeError:  # nothing that a weak reference can be had of
        return value


def _found(value: Any) -> Any:
    key = _key_of(value)
    first = None if key is None else _first.get(key)
    if first is not None and _key_of(first) == key:  # it may hold an array that was written to since
        return first
    if key is not None:
        _first[key] = value
    return value


def _key_of(value: Any) -> Hashable | None:
    """What functions that are equal share; None for a function that changes what it holds."""
    keys = _Keys()
    try:
        key = keys.of(value)
    except (TooMany, RecursionError):
        return None
    return None if keys.changes_others or (keys.changes_parts and keys.has_parts) else key


def _is_written_within(value: Any) -> bool:
    """Whether a value is a function that its module does not have by name, or a class of tuples of this kind."""
    if isinstance(value, types.MethodType | functools.partial):
        return True
    if isinstance(value, types.FunctionType):
        return not has_by_name(value)
    return isinstance(value, type) and issubclass(value, tuple) and not has_by_name(value)


def has_by_name(value: Any) -> bool:
    """Whether a function or class is what its module has under its name."""
    name, here = value.__qualname__, sys.modules.get(value.__module__ or "")
    if here is None or "<" in name:
        return False
    for part in name.split("."):
        here = getattr(here, part, None)
    return here is value


class TooMany(Exception):
    """A function holds more than is compared."""


class _Same:
    """Equal only to itself: what is compared by identity, without keeping it alive."""

    def __init__(self, value: Any):
        self._id = id(value)
        try:
            self._get: Callable[[], Any] = weakref.ref(value)
        except TypeError:
            self._get = lambda: value

    def __hash__(self) -> int:
        return self._id

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Same) or self._id != other._id:
            return False
        value = self._get()
        return value is not None and value is other._get()


class _Keys:
    """Keys of values, and what the code among them does with values that can be changed."""

    def __init__(self):
        self.has_parts = self.changes_parts = self.changes_others = False
        self._number: dict[int, tuple[int, Any]] = {}  # with the object, so that no new one gets its id

    def of(self, value: Any) -> Hashable:
        """The key of a value."""
        if isinstance(value, np.generic) or (type(value) is np.ndarray and not value.dtype.hasobject):
            content = value.tobytes()
            kept = content if len(content) <= LARGEST else hashlib.sha256(content).digest()
            return type(value), value.dtype.str, value.shape, kept
        if isinstance(value, EXACT):
            return type(value), value
        if isinstance(value, float):
            return float, struct.pack("d", value)
        if isinstance(value, complex):
            return complex, struct.pack("dd", value.real, value.imag)
        if isinstance(value, types.CodeType):
            return self._of_code(value)
        if isinstance(value, types.BuiltinFunctionType | np.ufunc):
            return _Same(value)
        if id(value) in self._number:
            return "again", self._number[id(value)][0]
        self._number[id(value)] = len(self._number), value
        if len(self._number) > MOST:
            raise TooMany
        return self._of_what_holds(value)

    def _of_what_holds(self, value: Any) -> Hashable:
        recipe = as_made(value)
        if isinstance(recipe, Made):
            return "made", *self._of_all((recipe.maker, recipe.arguments, recipe.key))
        if isinstance(value, types.FunctionType):
            return _Same(value) if has_by_name(value) else self._of_function(value)
        if isinstance(value, types.MethodType):
            return "method", *self._of_all((value.__func__, value.__self__))
        if isinstance(value, functools.partial):
            return "partial", *self._of_all((value.func, value.args, value.keywords))
        if isinstance(value, type):
            return self._of_class(value)
        if isinstance(value, tuple | frozenset):
            parts = value if isinstance(value, tuple) else sorted(value, key=repr)
            return self.of(type(value)), *self._of_all(parts)
        if type(value) in (list, dict, set):
            self.has_parts = True
            parts = value if isinstance(value, list) else sorted(value, key=repr)
            held = [value[key] for key in parts] if isinstance(value, dict) else []
            return type(value), *self._of_all(parts), *self._of_all(held)
        return self._of_object(value)

    def _of_all(self, values: Iterable) -> tuple:
        return tuple([self.of(one) for one in values])

    def _of_function(self, function: types.FunctionType) -> Hashable:
        cells = [_content(cell) for cell in function.__closure__ or ()]
        names = [name for name in names_read(function.__code__) if name in function.__globals__]
        read = [function.__globals__[name] for name in names]
        modules = [one for one in (*cells, *read) if isinstance(one, types.ModuleType | type)]
        return (
            "function",
            *(function.__module__, function.__qualname__),
            self.of(function.__code__),
            self.of(function.__defaults__),
            self.of(function.__kwdefaults__),
            *self._of_all(cells),
            *self._of_all(names),
            *self._of_all(read),
            *self._of_all(vars(function)),
            *self._of_all(vars(function).values()),
            *(self._of_attributes(one, function.__code__) for one in modules),
        )

    def _of_attributes(self, holder: types.ModuleType | type, code: types.CodeType) -> Hashable:
        """Numbers, texts, tuples and arrays of a module or class that the code may read."""
        held = vars(holder)
        return tuple(
            (name, self.of(held[name])) for name in names_read(code) if name in held and is_plain(held[name])
        )

    def _of_code(self, code: types.CodeType) -> Hashable:
        for one in dis.get_instructions(code):
            outer = one.opname in ("STORE_DEREF", "DELETE_DEREF") and one.argval in code.co_freevars
            self.changes_others |= outer or one.opname in CHANGES_OTHERS
            self.changes_parts |= one.opname in CHANGES_PARTS
        self.changes_parts |= not CHANGING.isdisjoint(code.co_names)
        sizes = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
        names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
        constants = self._of_all(code.co_consts)
        return code.co_filename, code.co_name, code.co_code, sizes, names, code.co_exceptiontable, constants

    def _of_class(self, value: type) -> Hashable:
        if has_by_name(value) or not issubclass(value, tuple):
            return _Same(value)
        own = {name: one for name, one in vars(value).items() if name not in OF_EVERY_TUPLE}
        own = {name: one for name, one in own.items() if name not in getattr(value, "_fields", ())}
        bases = [base for base in value.__bases__ if base is not tuple]
        names = value.__module__, value.__qualname__, getattr(value, "_fields", ())
        return *names, *self._of_all((*bases, getattr(value, "_field_defaults", None), *own, *own.values()))

    def _of_object(self, value: Any) -> Hashable:
        kind = type(value)
        if isinstance(value, property):
            return "property", *self._of_all((value.fget, value.fset, value.fdel))
        if isinstance(value, types.SimpleNamespace) or is_of_a_user(kind):
            self.has_parts = True
            return self.of(kind), *self._of_all(vars(value)), *self._of_all(vars(value).values())
        return _Same(value)


def is_of_a_user(kind: type) -> bool:
    """Whether objects of a class hold nothing but attributes, and the class is not one of Python's library."""
    bases = [base for base in kind.__mro__ if base is not object]
    known = kind.__module__.partition(".")[0] in sys.stdlib_module_names - {"__main__"}
    return not known and all(base.__dictoffset__ != 0 for base in bases)


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # a function that is still being written
        return _content
