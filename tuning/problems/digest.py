"""A short hash of values and code, so that two hosts can tell whether they mean the same."""

from __future__ import annotations

import builtins
import dataclasses
import functools
import hashlib
import inspect
import sys
import textwrap
import types
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from numerics.compiled import registered_packages
from numerics.pickling import Made, as_made
from plants.state_space import StateSpaceModel

LENGTH = 12  # of the hexadecimal digits of a SHA-256 that are kept


def digest_of(*values: Any) -> str:
    """The first part of a SHA-256 of numbers, texts, arrays, collections, dataclasses and functions.

    A model is its own digest, its noise and its prior. A function is its source, or its byte code where there is
    none, its defaults, what it closes over, and all of that of the functions of its own package that it calls by
    name. Functions of this project's packages, of the standard library and of other packages are their names:
    another version of them is told by their versions.
    """
    found = hashlib.sha256()
    for text in _texts(values, set()):
        found.update(text.encode() + b"\0")
    return found.hexdigest()[:LENGTH]


def _texts(value: Any, seen: set[int]) -> Iterator[str]:
    """Texts that together say what a value is; a function that was met before says no more."""
    value = as_made(value)
    if value is None or isinstance(value, bool | int | float | complex | str | bytes):
        yield repr(value)
    elif isinstance(value, np.ndarray | np.generic):
        yield f"array {np.shape(value)}"
        yield repr(np.asarray(value).tolist())
    elif isinstance(value, Made):
        yield f"made by {_name(value.maker)}, {value.key}"
        yield from _texts(value.arguments, seen)
    elif isinstance(value, StateSpaceModel):
        noise = value.process_noise_cov, value.measurement_noise_cov
        yield from _texts((value.digest, noise, value.prior_mean, value.prior_cov), seen)
    elif isinstance(value, functools.partial):
        yield "partial"
        yield from _texts((value.func, value.args, value.keywords), seen)
    elif isinstance(value, Mapping):
        for key in sorted(value, key=str):
            yield from _texts((str(key), value[key]), seen)
    elif isinstance(value, tuple | list | set | frozenset):
        yield f"{len(value)} of {type(value).__name__ if hasattr(value, '_fields') else 'a sequence'}"
        for part in sorted(value, key=repr) if isinstance(value, set | frozenset) else value:
            yield from _texts(part, seen)
    elif isinstance(value, types.MethodType):
        yield from _texts((value.__func__, value.__self__), seen)
    elif isinstance(value, types.FunctionType):
        yield from _of_function(value, seen)
    elif isinstance(value, type | types.ModuleType | types.BuiltinFunctionType | np.ufunc):
        yield _name(value)
    elif id(value) not in seen:
        seen.add(id(value))
        yield type(value).__qualname__
        names = [field.name for field in dataclasses.fields(value)] if dataclasses.is_dataclass(value) else None
        held = vars(value) if names is None and hasattr(value, "__dict__") else {}
        yield from _texts(held if names is None else {name: getattr(value, name) for name in names}, seen)


def _of_function(function: types.FunctionType, seen: set[int]) -> Iterator[str]:
    if id(function) in seen:
        return
    seen.add(id(function))
    if _is_of_a_library(function.__module__):
        yield _name(function)
        return
    yield function.__qualname__  # without the module: the same file may be run and be imported
    try:
        yield textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError):  # from a prompt, or written out by a program
        yield _code(function.__code__)
    yield from _texts((function.__defaults__, function.__kwdefaults__), seen)
    for cell in function.__closure__ or ():
        yield from _texts(cell.cell_contents, seen)
    for name in sorted(_names(function.__code__)):
        if name in function.__globals__ and not hasattr(builtins, name):
            other = function.__globals__[name]
            package = (getattr(other, "__module__", None) or "").partition(".")[0]
            same = package == (function.__module__ or "").partition(".")[0]
            plain = isinstance(other, bool | int | float | complex | str | bytes | tuple | np.ndarray)
            yield name
            yield from _texts(other, seen) if same or plain else [_name(other)]


def _is_of_a_library(module: str | None) -> bool:
    package = (module or "").partition(".")[0]
    if package in registered_packages() or package in sys.stdlib_module_names:
        return package != "__main__"
    file = getattr(sys.modules.get(package), "__file__", None) or ""
    return "site-packages" in file


def _name(value: Any) -> str:
    name = getattr(value, "__qualname__", None) or getattr(value, "__name__", None) or type(value).__qualname__
    return f"{getattr(value, '__module__', None)}.{name}"


def _names(code: types.CodeType) -> set[str]:
    inner = [_names(one) for one in code.co_consts if isinstance(one, types.CodeType)]
    return set(code.co_names).union(*inner)


def _code(code: types.CodeType) -> str:
    constants = [_code(one) if isinstance(one, types.CodeType) else repr(one) for one in code.co_consts]
    return " ".join([code.co_name, code.co_code.hex(), *constants, *code.co_names])
