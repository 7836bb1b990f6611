"""Numbers that functions hold in their closures, defaults and objects: listed, and replaced by others."""

from __future__ import annotations

import collections
import functools
import types
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from thruster_env.core.equal_functions import attributes_of, first_equal, has_by_name, is_of_a_user
from thruster_env.core.recipes import Made, as_function, as_made

MAPPINGS = dict, collections.OrderedDict, collections.defaultdict, types.MappingProxyType
LARGEST = 64  # entries of an array that are numbers of their own


def captured_numbers(function: Any) -> list[float]:
    """The floats that a function holds, always in the same order; those of its module and its code are not."""
    found: list[float] = []

    def note(value: float) -> float:
        found.append(float(value))
        return value

    _Copy(note).of(function)
    return found


def with_numbers(function: Any, numbers: Sequence[Any]) -> Any:
    """A copy of a function that holds other numbers, in the order of `captured_numbers`."""
    following: Iterator[Any] = iter(numbers)
    return _Copy(lambda _: next(following)).of(function)


def differ_in_numbers_alone(one: Any, other: Any) -> bool:
    """Whether two functions would be equal (`first_equal`) if they held the same floats."""
    numbers = captured_numbers(one)
    if len(numbers) != len(captured_numbers(other)):
        return False
    following = iter(numbers)
    return first_equal(_Copy(lambda _: next(following), remembered=True).of(other)) == first_equal(one)


class _Copy:
    """Copies of values with other floats in them."""

    def __init__(self, other: Callable[[float], Any], remembered: bool = False):
        self._other, self._remembered = other, remembered  # whether what makers return may be kept
        self._copies: dict[int, tuple[Any, Any]] = {}  # with the object, so that no new one gets its id

    def of(self, value: Any) -> Any:
        """The copy of a value; what holds no floats, or nothing known, is returned as it is."""
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
            keywords = {name: self.of(one) for name, one in value.keywords.items()}
            return functools.partial(self.of(value.func), *map(self.of, value.args), **keywords)
        if isinstance(value, tuple):
            parts = list(map(self.of, value))
            return type(value)(*parts) if hasattr(value, "_fields") else tuple(parts)
        if type(value) is list:
            return list(map(self.of, value))
        if type(value) in MAPPINGS:
            held = {key: self.of(one) for key, one in value.items()}
            kind = type(value)
            return kind(value.default_factory, held) if kind is collections.defaultdict else kind(held)
        if type(value) is np.ndarray and value.dtype == np.float64 and value.size <= LARGEST:
            numbers = [self._other(one) for one in value.ravel().tolist()]
            plain = all(isinstance(one, float) for one in numbers)
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
        for cell, given in zip(cells, function.__closure__ or (), strict=True):
            cell.cell_contents = self.of(given.cell_contents)
        return copy

    def _of_object(self, value: Any) -> Any:
        base = types.SimpleNamespace if isinstance(value, types.SimpleNamespace) else object
        copy = base.__new__(type(value))
        self._copies[id(value)] = value, copy
        for name, one in attributes_of(value).items():
            object.__setattr__(copy, name, self.of(one))
        return copy
