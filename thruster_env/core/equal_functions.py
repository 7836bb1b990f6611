"""Functions with equal code and equal values are replaced by the first of them, as those that a factory returns.

A nested function is a new object whenever the outer function runs, and results of tracing, compilation and
comparison are stored by function object. So all of these use the first of several equal functions.
"""

from __future__ import annotations

import collections
import dis
import functools
import hashlib
import struct
import sys
import sysconfig
import threading
import types
import weakref
from collections.abc import Callable, Hashable, Iterable, Iterator, Sequence
from functools import lru_cache, wraps
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.compiled import OURS, Made, as_function, as_made, is_plain, names_read, remember
from thruster_env.core.sources import made_here

EXACT = bool | int | str | bytes | None  # compared by type and value
CHANGES_OTHERS = {"STORE_GLOBAL", "DELETE_GLOBAL"}
CHANGES_PARTS = {"STORE_SUBSCR", "DELETE_SUBSCR", "STORE_ATTR", "DELETE_ATTR", "STORE_SLICE"}
CHANGING = {
    *"append appendleft extend insert pop popleft popitem remove clear sort reverse add discard update".split(),
    *"setdefault setattr __setitem__ __setattr__ send write".split(),
}  # methods after which a list, dictionary, set or object is another

OF_EVERY_CLASS = {
    *vars(NamedTuple("Empty", [])),
    *("__annotations__", "__annotate__", "__annotate_func__", "__annotations_cache__", "__orig_bases__"),
    *("__doc__", "__firstlineno__", "__static_attributes__", "__classdictcell__", "__qualname__", "__module__"),
    *("__dict__", "__weakref__", "__slots__", "__dataclass_fields__", "__dataclass_params__"),
    *("__init__", "__post_init__", "__setattr__", "__delattr__", "__repr__", "__str__", "__eq__", "__hash__"),
    *("__getstate__", "__setstate__", "__reduce__", "__reduce_ex__", "__replace__", "__init_subclass__"),
    "__abstractmethods__",
}  # members that tell nothing of what a function computes, beside a tuple's fields
COLLECTIONS = list, dict, set, collections.OrderedDict, collections.defaultdict, types.MappingProxyType
STANDARD = sys.stdlib_module_names - {"__main__"}
INSTALLED = sysconfig.get_paths()["purelib"], sysconfig.get_paths()["platlib"], sysconfig.get_paths()["stdlib"]
MOST = 20_000  # values that a function may hold, to be compared
LARGEST = 1024  # bytes of an array that are kept to be compared: of more there is a hash
SELDOM = 65_536  # bytes of an array of which the hash is taken once

_first: weakref.WeakValueDictionary[Hashable, Any] = weakref.WeakValueDictionary()
_used: weakref.WeakKeyDictionary[Any, Hashable] = weakref.WeakKeyDictionary()  # the key that each of these had
_copied: weakref.WeakKeyDictionary[Any, Any] = weakref.WeakKeyDictionary()  # of copies: the function
_hashes: dict[int, tuple[weakref.ref, bytes]] = {}  # of arrays by their ids
_finding = threading.RLock()
MAPPINGS = dict, collections.OrderedDict, collections.defaultdict, types.MappingProxyType
LARGEST_CAPTURED = 64  # entries of an array that are numbers of their own
MOST_RESULTS = 128  # results that are kept for a maker, beyond those that something else holds


def first_equal(value: Any) -> Any:
    """The first living function that computes the same, for the same reasons, as a function; others as they are.

    Equal are byte code, constants, defaults, the values in the closure and those of globals that are read, of the
    function and of all that it calls; numbers to the last bit, and of the same type. Of an object of a user's
    class its attributes count, and the members of the class that the code reads; of all else that is no number,
    text, array or collection its identity. A function that changes what it holds, such as a counter, is equal to
    none. Classes of named tuples that are written within a function stand for one another in the same way, and so
    do parts of a tuple.

    A function that reads other values than before, as of a global that was set, is another: a copy stands for it.
    """
    if type(value) is tuple:
        return tuple(map(first_equal, value))
    if not _may_differ(value):
        return value
    value = bound_call(value)
    try:
        with _finding:
            return _first_of(value)
    except TypeError:  # nothing that a weak reference can be had of
        return value


def bound_call(value: Any) -> Any:
    """The method that is called in place of an object without a hash or weak references; others as they are."""
    try:
        hash(value), weakref.ref(value)
    except TypeError:
        return value.__call__ if callable(value) and _may_differ(value) else value
    return value


def original_of(value: Any) -> Any:
    """The function from which a copy with other values was made; other values as they are."""
    try:
        return _copied.get(value, value)
    except TypeError:
        return value


def _first_of(value: Any) -> Any:
    key = _key_of(value)
    first = None if key is None else _first.get(key)
    if first is not None and (first is value or _key_of(first) == key):  # it may read other values since
        return first
    if key is not None:
        value = value if _used.setdefault(value, key) == key else _copy_of(original_of(value))
        _first[key] = value
        _used[value] = key
    return value


def _copy_of(value: Any) -> Any:
    """A copy of a function that calls the first equal function in place of each helper."""
    if isinstance(value, types.MethodType):
        result: Any = types.MethodType(_copy_of(value.__func__), value.__self__)
    elif isinstance(value, types.FunctionType):
        scope = {name: part for name in names_read(value.__code__) if (part := value.__globals__.get(name))}
        parts = {name: first_equal(part) for name, part in scope.items() if isinstance(part, types.FunctionType)}
        replaced = {name: part for name, part in parts.items() if part is not scope[name]}
        names = {**value.__globals__, **replaced} if replaced else value.__globals__
        result = types.FunctionType(value.__code__, names, value.__name__, value.__defaults__, value.__closure__)
        result.__kwdefaults__, result.__qualname__ = value.__kwdefaults__, value.__qualname__
        result.__module__ = value.__module__
        vars(result).update(vars(value))
    elif isinstance(value, functools.partial):
        result = functools.partial(_copy_of(value.func), *value.args, **value.keywords)
    else:
        result = _copy_of(value.__call__)
    _copied[result] = value
    return result


def _key_of(value: Any) -> Hashable | None:
    """A key that equal functions share; None for a function that changes the values it holds."""
    keys = _Keys()
    try:
        key = keys.of(original_of(value)), keys.of_members()
    except (TooMany, RecursionError):
        return None
    return None if keys.changes_others or (keys.changes_parts and keys.has_parts) else key


def _may_differ(value: Any) -> bool:
    """Whether a value is a user's function or callable object, or a class of tuples that no module has by name."""
    if isinstance(value, types.MethodType | functools.partial):
        return True
    if isinstance(value, types.FunctionType):
        return not has_by_name(value) or _is_of_a_user(value)
    if isinstance(value, type):
        return issubclass(value, tuple) and not has_by_name(value)
    return callable(value) and is_of_a_user(type(value)) and _is_of_a_user(type(value))


def _is_of_a_user(value: Any) -> bool:
    """Whether a function or class is written in no package that is installed."""
    package = (value.__module__ or "").partition(".")[0]
    if package in OURS or package in STANDARD:
        return False
    return not (getattr(sys.modules.get(package), "__file__", None) or "").startswith(INSTALLED)


def has_by_name(value: Any) -> bool:
    """Whether a function or class is what its module has under its name."""
    name, here = value.__qualname__, sys.modules.get(value.__module__ or "")
    if here is None or "<" in name:
        return False
    for part in name.split("."):
        here = getattr(here, part, None)
    return here is value


class TooMany(Exception):
    """A function holds more values than are compared."""


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
    """Keys of values, and whether the code among them changes mutable values."""

    def __init__(self):
        self.has_parts = self.changes_parts = self.changes_others = False
        self._number: dict[int, tuple[int, Any]] = {}  # with the object, so that no new one gets its id
        self._classes: dict[type, None] = {}  # of a user's
        self._names: dict[str, None] = {}  # that the code reads

    def of(self, value: Any) -> Hashable:
        """The key of a value."""
        if isinstance(value, np.generic) or (type(value) in (np.ndarray, np.matrix) and not value.dtype.hasobject):
            return type(value), value.dtype.str, value.shape, _content_of(value)
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
            by_name = has_by_name(value)
            known = () if by_name and not _is_of_a_user(value) else self._of_function(value)
            return (_Same(value), known) if by_name else known
        if isinstance(value, types.MethodType):
            return "method", *self._of_all((value.__func__, value.__self__))
        if isinstance(value, functools.partial):
            return "partial", *self._of_all((value.func, value.args, value.keywords))
        if isinstance(value, type):
            return self._of_class(value)
        if isinstance(value, tuple | frozenset):
            parts = value if isinstance(value, tuple) else sorted(value, key=repr)
            return self.of(type(value)), *self._of_all(parts)
        if type(value) in COLLECTIONS:
            self.has_parts = True
            parts = value if isinstance(value, list) else sorted(value, key=repr)
            contents = [value[key] for key in parts] if hasattr(value, "keys") else []
            missing = getattr(value, "default_factory", None)
            return type(value), *self._of_all((*parts, *contents, missing))
        if isinstance(value, range | slice):
            return type(value), *self._of_all((value.start, value.stop, value.step))
        return self._of_object(value)

    def _of_all(self, values: Iterable) -> tuple:
        return tuple([self.of(value) for value in values])

    def _of_function(self, function: types.FunctionType) -> Hashable:
        cells = [_content(cell) for cell in function.__closure__ or ()]
        self._names |= dict.fromkeys(_names_of(function.__code__))
        names = [name for name in _names_of(function.__code__) if name in function.__globals__]
        read = [function.__globals__[name] for name in names]
        modules = [content for content in (*cells, *read) if isinstance(content, types.ModuleType)]
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
            *(self._of_attributes(module, function.__code__) for module in modules),
        )

    def _of_attributes(self, module: types.ModuleType, code: types.CodeType) -> Hashable:
        """The attributes of a module that the code may read; of an installed module only plain values."""
        attributes = vars(module)
        by_user = not (getattr(module, "__file__", None) or "").startswith(INSTALLED) and (
            module.__name__.partition(".")[0] not in {*OURS, *sys.builtin_module_names}
        )
        names = [
            name for name in _names_of(code) if name in attributes and (by_user or is_plain(attributes[name]))
        ]
        return tuple((name, self.of(attributes[name])) for name in names)

    def of_members(self) -> Hashable:
        """Members of users' classes among the values that the code reads, and operators."""
        members: dict[tuple[type, str], Hashable] = {}
        count = -1
        while count < len(members):  # a member may read others
            count = len(members)
            for kind in list(self._classes):
                for base in kind.__mro__:
                    for name, member in vars(base).items() if base is not object and _is_of_a_user(base) else ():
                        plain = isinstance(member, types.FunctionType) and name not in OF_EVERY_CLASS
                        operator = plain and name.startswith("__")
                        known = (kind, name) in members or name in getattr(base, "_fields", ())
                        if (operator or name in self._names) and not known:
                            members[kind, name] = None  # of derived classes the member of the first counts
                            members[kind, name] = self.of(getattr(member, "__func__", member))
        return tuple((name, member) for (_, name), member in members.items())

    def _of_code(self, code: types.CodeType) -> Hashable:
        changes_others, parts = _changes_of(code)
        self.changes_others |= changes_others
        self.changes_parts |= parts
        sizes = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
        names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
        constants = self._of_all(code.co_consts)
        return code.co_filename, code.co_name, code.co_code, sizes, names, code.co_exceptiontable, constants

    def _of_class(self, value: type) -> Hashable:
        if not _is_of_a_user(value):
            return _Same(value)
        self._classes[value] = None
        if has_by_name(value):
            return _Same(value)
        bases = [base for base in value.__bases__ if base is not tuple]
        names = value.__module__, value.__qualname__, getattr(value, "_fields", ())
        return *names, *self._of_all((*bases, getattr(value, "_field_defaults", None)))

    def _of_object(self, value: Any) -> Hashable:
        kind = type(value)
        if isinstance(value, property):
            return "property", *self._of_all((value.fget, value.fset, value.fdel))
        if isinstance(value, types.MemberDescriptorType | types.GetSetDescriptorType):
            return kind, value.__name__  # of a class's slots
        wrapped = getattr(value, "py_func", None) or getattr(value, "__wrapped__", None)
        if isinstance(wrapped, types.FunctionType) and not is_of_a_user(kind):  # of numba, or with a cache
            return kind, self.of(wrapped), repr(getattr(value, "targetoptions", None))
        if isinstance(value, types.SimpleNamespace) or is_of_a_user(kind):
            self.has_parts = True
            attributes = attributes_of(value)
            return self.of(kind), *self._of_all(attributes), *self._of_all(attributes.values())
        return _Same(value)


def is_of_a_user(kind: type) -> bool:
    """Whether objects of a class hold nothing but attributes, and the class is not one of Python's library."""
    bases = [base for base in kind.__mro__ if base is not object]
    known = kind.__module__.partition(".")[0] in STANDARD
    if any(name in vars(base) for base in bases for name in ("__getattr__", "__getattribute__")):
        return False
    return not known and all(base.__dictoffset__ != 0 or "__slots__" in vars(base) for base in bases)


def attributes_of(value: Any) -> dict[str, Any]:
    """An object's attributes, from its dictionary and its slots."""
    kinds = [vars(base) for base in type(value).__mro__ if "__slots__" in vars(base)]
    slots = [name for kind in kinds for name in kind if isinstance(kind[name], types.MemberDescriptorType)]
    slot_values = {name: getattr(value, name) for name in slots if hasattr(value, name)}
    return {**getattr(value, "__dict__", {}), **slot_values}


@functools.lru_cache(maxsize=4096)
def _changes_of(code: types.CodeType) -> tuple[bool, bool]:
    """Whether code sets outside variables, and whether it may change parts of the values it holds."""
    steps = list(dis.get_instructions(code))
    free = {"STORE_DEREF", "DELETE_DEREF"}
    changes_others = any(
        step.opname in CHANGES_OTHERS or (step.opname in free and step.argval in code.co_freevars)
        for step in steps
    )
    parts = any(step.opname in CHANGES_PARTS for step in steps) or not CHANGING.isdisjoint(code.co_names)
    return changes_others, parts


_names_of = functools.lru_cache(maxsize=4096)(names_read)


def _content_of(value: Any) -> bytes:
    if value.nbytes <= LARGEST:
        return value.tobytes()
    known = _hashes.get(id(value))
    if value.nbytes > SELDOM and known is not None and known[0]() is value:
        return known[1]
    digest = hashlib.sha256(value.tobytes()).digest()
    if value.nbytes > SELDOM:
        key = id(value)
        _hashes[key] = weakref.ref(value, lambda _: _hashes.pop(key, None)), digest
    return digest


def _content(cell: types.CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # a function that is still being written
        return _content


def captured_numbers(function: Any) -> list[float]:
    """The floats that a function holds, in a fixed order, without those of its module and its code."""
    numbers: list[float] = []

    def note(value: float) -> float:
        numbers.append(float(value))
        return value

    _Copy(note).of(function)
    return numbers


def with_numbers(function: Any, numbers: Sequence[Any]) -> Any:
    """A copy of a function that holds other numbers, in the order of `captured_numbers`."""
    following: Iterator[Any] = iter(numbers)
    return _Copy(lambda _: next(following)).of(function)


def differ_in_numbers_alone(first: Any, other: Any) -> bool:
    """Whether two functions would be equal (`first_equal`) if they held the same floats."""
    numbers = captured_numbers(first)
    if len(numbers) != len(captured_numbers(other)):
        return False
    following = iter(numbers)
    return first_equal(_Copy(lambda _: next(following), remembered=True).of(other)) == first_equal(first)


class _Copy:
    """Copies of values with other floats in them."""

    def __init__(self, other: Callable[[float], Any], remembered: bool = False):
        self._other, self._remembered = other, remembered  # whether what makers return may be kept
        self._copies: dict[int, tuple[Any, Any]] = {}  # with the object, so that no new one gets its id

    def of(self, value: Any) -> Any:
        """The copy of a value; a value without floats, or of an unknown type, is returned as it is."""
        if isinstance(value, float):
            other = self._other(value)
            return type(value)(other) if isinstance(other, float) else other  # of NumPy a number of NumPy
        if id(value) not in self._copies:
            self._copies[id(value)] = value, value
            self._copies[id(value)] = value, self._of_what_holds(value)
        return self._copies[id(value)][1]

    def _of_what_holds(self, value: Any) -> Any:
        recipe = as_made(value)
        if isinstance(recipe, Made):
            make = recipe.maker if self._remembered else getattr(recipe.maker, "__wrapped__", recipe.maker)
            result = make(*map(self.of, map(as_function, recipe.arguments)))
            return result if recipe.key is None else result[recipe.key]
        if isinstance(value, types.FunctionType):
            return value if has_by_name(value) else self._of_function(value)
        if isinstance(value, types.MethodType):
            return types.MethodType(self.of(value.__func__), self.of(value.__self__))
        if isinstance(value, functools.partial):
            keywords = {name: self.of(argument) for name, argument in value.keywords.items()}
            return functools.partial(self.of(value.func), *map(self.of, value.args), **keywords)
        if isinstance(value, tuple):
            parts = list(map(self.of, value))
            return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
        if type(value) is list:
            return list(map(self.of, value))
        if type(value) in MAPPINGS:
            entries = {key: self.of(entry) for key, entry in value.items()}
            kind = type(value)
            return kind(value.default_factory, entries) if kind is collections.defaultdict else kind(entries)
        if type(value) is np.ndarray and value.dtype == np.float64 and value.size <= LARGEST_CAPTURED:
            numbers = [self._other(number) for number in value.ravel().tolist()]
            plain = all(isinstance(number, float) for number in numbers)
            return np.array(numbers, dtype=np.float64 if plain else object).reshape(value.shape)
        if isinstance(value, types.SimpleNamespace) or (not isinstance(value, type) and is_of_a_user(type(value))):
            return self._of_object(value)
        return value

    def _of_function(self, function: types.FunctionType) -> types.FunctionType:
        cells = tuple(types.CellType() for _ in function.__closure__ or ())
        copy = types.FunctionType(
            function.__code__, function.__globals__, function.__name__, self.of(function.__defaults__), cells
        )
        self._copies[id(function)] = function, copy  # which its own cells may hold
        copy.__qualname__, copy.__module__ = function.__qualname__, function.__module__
        copy.__kwdefaults__ = self.of(function.__kwdefaults__)
        vars(copy).update(vars(function))
        for cell, original in zip(cells, function.__closure__ or (), strict=True):
            cell.cell_contents = self.of(original.cell_contents)
        return copy

    def _of_object(self, value: Any) -> Any:
        base = types.SimpleNamespace if isinstance(value, types.SimpleNamespace) else object
        copy = base.__new__(type(value))
        self._copies[id(value)] = value, copy
        for name, attribute in attributes_of(value).items():
            object.__setattr__(copy, name, self.of(attribute))
        return copy


def makes_functions(maker: Callable) -> Callable:
    """Decorate what returns a function, or a tuple or dictionary of functions.

    Equal arguments give the same result object, as with `functools.cache`; arguments that are functions count as
    equal by `first_equal`. Old results without other references are dropped.
    """

    @lru_cache(maxsize=MOST_RESULTS)
    def of_first(*arguments):
        result = maker(*arguments)
        if isinstance(result, dict):
            entries = result
        else:
            entries = dict(enumerate(result)) if isinstance(result, tuple) else {None: result}
        for key, function in entries.items():
            nested = "<locals>" in getattr(function, "__qualname__", "")  # others are found by their names
            if made_here(function) or (nested and all(function is not argument for argument in arguments)):
                remember(function, Made(make, tuple(map(original_of, arguments)), key))
        if isinstance(result, dict):
            return {key: first_equal(function) for key, function in result.items()}
        return first_equal(result)

    @wraps(maker)
    def make(*arguments):
        return of_first(*map(first_equal, arguments))

    make.cache_clear = of_first.cache_clear  # type: ignore[attr-defined]
    return make
