"""Generated functions remember what made them, so that models that hold them can be pickled."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, wraps
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

from thruster_env.numerics.written import made_here

_MADE: WeakKeyDictionary[Callable, Made] = WeakKeyDictionary()


class Made(NamedTuple):
    """How to make a function: maker(*arguments), or an entry of the tuple or dictionary that this returns."""

    maker: Callable
    arguments: tuple
    key: Any = None


def makes_functions(maker: Callable) -> Callable:
    """Decorate what returns a function, or a tuple or dictionary of functions, as `functools.cache` does."""

    @cache
    @wraps(maker)
    def make(*arguments):
        result = maker(*arguments)
        if isinstance(result, dict):
            entries = result
        else:
            entries = dict(enumerate(result)) if isinstance(result, tuple) else {None: result}
        for key, function in entries.items():
            nested = "<locals>" in getattr(function, "__qualname__", "")  # others are found by their names
            if made_here(function) or (nested and all(function is not one for one in arguments)):
                _MADE.setdefault(function, Made(make, arguments, key))
        return result

    return make


def as_made(value: Any) -> Any:
    """What pickle can hold in place of a function that was written out; other values as they are."""
    try:
        made = _MADE.get(value)
    except TypeError:  # nothing that a weak reference or a hash can be had of
        return value
    return value if made is None else made._replace(arguments=tuple(map(as_made, made.arguments)))


def as_function(value: Any) -> Any:
    """The function that `as_made` stands for; other values as they are."""
    if not isinstance(value, Made):
        return value
    result = value.maker(*map(as_function, value.arguments))
    return result if value.key is None else result[value.key]
