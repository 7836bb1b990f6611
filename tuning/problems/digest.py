"""A short hash of values and code, by which two hosts check that they have the same problem."""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import types
from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium as gym
import numpy as np

from thruster_env.core.user_functions import Made, as_made
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems import code_digest, network_digest
from tuning.problems.problem import Problem

LENGTH = 12  # of the hexadecimal digits of a SHA-256 that are kept
PLAIN = bool | int | float | complex | str | bytes


def digest_of(*values: Any) -> str:
    """The first part of a SHA-256 of numbers, texts, arrays, collections, objects, functions and classes.

    A model is hashed by its own digest, its noise and its prior. A function is hashed by its source (or its byte
    code where there is no source), its defaults, its closure and the globals that it reads; a class by its members
    and bases; an object by its class and what it holds. Code of this project's packages, of the standard library
    and of other installed packages is hashed by its name: versions are compared separately. A policy or a network
    of torch is hashed by its parameters, a generator of random numbers by its state. Cached properties, addresses,
    and whether a file was run or imported do not count.
    """
    found = hashlib.sha256()
    for text in Texts().of(values):
        found.update(text.encode() + b"\0")
    return found.hexdigest()[:LENGTH]


class Texts:
    """Texts that together identify values; code that occurs again, and an object within itself, is a number."""

    def __init__(self):
        """Nothing occurred yet."""
        self._code: dict[int, tuple[int, Any]] = {}  # with the object, so that no new one gets its id
        self._around: list[int] = []  # ids of the values within which one is

    def of(self, value: Any) -> Iterator[str]:
        """Texts of a value."""
        value = as_made(value)
        if value is None or isinstance(value, PLAIN):
            yield repr(value)
        elif isinstance(value, np.ndarray | np.generic):
            yield f"array {np.shape(value)}"
            listed = np.asarray(value).tolist()
            yield from [repr(listed)] if np.asarray(value).dtype != object else self.of(listed)
        elif isinstance(value, Made):
            yield f"made by {code_digest.name_of(value.maker)}, {value.key}"
            yield from self.of(value.arguments)
        elif isinstance(value, StateSpaceModel):
            noise = value.process_noise_cov, value.measurement_noise_cov
            yield from self.of((value.digest, noise, value.prior_mean, value.prior_cov))
        elif isinstance(value, types.ModuleType | np.ufunc):
            yield code_digest.name_of(value)
        elif isinstance(value, types.BuiltinFunctionType):
            yield code_digest.name_of(value)
            if not isinstance(value.__self__, types.ModuleType | type | None):
                yield from self.of(value.__self__)
        elif isinstance(value, types.MethodType):
            yield from self.of((value.__func__, value.__self__))
        elif isinstance(value, types.FunctionType | type):
            yield from self._of_code(value)
        elif id(value) in self._around:
            yield f"the one around, {self._around.index(id(value))}"
        else:
            self._around.append(id(value))
            yield from self._of_what_holds(value)
            self._around.pop()

    def _of_code(self, value: types.FunctionType | type) -> Iterator[str]:
        if code_digest.is_of_a_library(value.__module__):
            yield code_digest.name_of(value)
        elif id(value) in self._code:
            yield f"again {self._code[id(value)][0]}"
        else:
            self._code[id(value)] = len(self._code), value
            if isinstance(value, type):
                yield from code_digest.of_class(value, self.of)
            else:
                yield from code_digest.of_function(value, self.of)

    def _of_what_holds(self, value: Any) -> Iterator[str]:
        if isinstance(value, functools.partial):
            yield "partial"
            yield from self.of((value.func, value.args, value.keywords))
        elif isinstance(value, Mapping):
            yield from self._of_mapping(value)
        elif isinstance(value, tuple | list | set | frozenset):
            yield f"{len(value)} of {type(value).__name__ if hasattr(value, '_fields') else 'a sequence'}"
            if isinstance(value, set | frozenset):
                yield from sorted(" ".join(Texts().of(part)) for part in value)
            else:
                yield from (text for part in value for text in self.of(part))
        elif code_digest.within(value) is not None:
            yield type(value).__name__
            yield from self.of(code_digest.within(value))
        else:
            yield from self._of_object(value)

    def _of_mapping(self, value: Mapping) -> Iterator[str]:
        if all(isinstance(key, PLAIN | None) for key in value):
            for key in sorted(value, key=str):
                yield from self.of((str(key), value[key]))
        else:
            yield from sorted(" ".join([*Texts().of(key), *Texts().of(held)]) for key, held in value.items())

    def _of_object(self, value: Any) -> Iterator[str]:
        kind = type(value)
        yield kind.__qualname__
        if isinstance(value, Problem):  # a global of the code of which it is made
            return
        if not code_digest.is_of_a_library(kind.__module__):
            yield from self.of(kind)
        if isinstance(value, np.random.Generator):
            yield from self.of(value.bit_generator.state)
        elif isinstance(value, np.random.RandomState):
            yield from self.of(value.get_state())
        elif isinstance(value, gym.Space):
            yield from self.of((repr(value), getattr(value, "low", None), getattr(value, "high", None)))
        elif isinstance(value, gym.Env):
            yield from self.of((value.spec.id if value.spec else None, *map(type, layers(value))))
        elif network_digest.is_network(value):
            yield from network_digest.of_network(value, self.of)
        elif dataclasses.is_dataclass(value):
            yield from self.of({field.name: getattr(value, field.name) for field in dataclasses.fields(value)})
        elif code_digest.keeps_plain_attributes(kind.__module__):
            yield from self.of(held_by(value))
        else:
            yield from self._of_pickled(value)

    def _of_pickled(self, value: Any) -> Iterator[str]:
        """Of an object of another package: what it would be pickled by, for it knows what belongs to it."""
        try:
            parts = value.__reduce_ex__(4)
        except Exception:  # locks, files: nothing that a problem's data follow from
            return
        if isinstance(parts, str):
            yield parts
            return
        make, arguments, *rest = parts
        rest = [list(part) if isinstance(part, Iterator) else part for part in rest]
        yield from self.of((code_digest.name_of(make), arguments, rest))


def layers(env: gym.Env) -> list[gym.Env]:
    """An env, the env within it if it is a wrapper, and so on."""
    found = [env]
    while isinstance(found[-1], gym.Wrapper):
        found.append(found[-1].env)
    return found


def held_by(value: Any) -> dict[str, Any]:
    """What an object holds by name, without values that are cached properties."""
    kinds = type(value).__mro__
    slots = [name for kind in kinds for name in _listed(vars(kind).get("__slots__", ()))]
    held = {name: getattr(value, name) for name in slots if hasattr(value, name)} | getattr(value, "__dict__", {})
    cached = {
        name for kind in kinds for name, one in vars(kind).items() if isinstance(one, functools.cached_property)
    }
    return {name: one for name, one in held.items() if name not in {*cached, "__dict__", "__weakref__"}}


def _listed(slots: Any) -> tuple[str, ...]:
    return (slots,) if isinstance(slots, str) else tuple(slots)
