"""Recipes of functions that a maker returned: what is compared and pickled in their place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

_MADE: WeakKeyDictionary[Callable, Made] = WeakKeyDictionary()


class Made(NamedTuple):
    """How to make a function: maker(*arguments), or an entry of the tuple or dictionary that this returns."""

    maker: Callable
    arguments: tuple
    key: Any = None


def remember(function: Callable, recipe: Made) -> None:
    """Keep the recipe of a function as long as the function lives; the first one counts."""
    _MADE.setdefault(function, recipe)


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
