"""Effects that disturb a plant: immutable values, registered by name, that JSON can hold.

An effect is a frozen dataclass of plain numbers with the function by which it acts in each step,

    act(e, value, memory, t) -> value, memory

of its parameters e, the value that it changes, the memory of the last step and the moment t. At the start of an
episode `t.begin` is true and the memory None. The function is pure; it is traced once and runs for any number of
copies (`thruster_env.env.page`). Anyone may register further effects.
"""

from __future__ import annotations

import dataclasses
from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from thruster_env.core.checks import positive, short_repr, within
from thruster_env.core.streams import CHANCE, DISTURBANCE
from thruster_env.graphs.draws import Draws
from thruster_env.graphs.values import shape_of, traceable

MAGNITUDES = (1e-100, 1e100)  # of an effect's arguments and of what follows from them
LONGEST = 1e9  # [s], and in steps: what an effect may hold
SPACING = 64  # effects of each chain have numbers of their own, whatever the other chains hold


@dataclasses.dataclass(frozen=True)
class Context:
    """The context from which an effect computes its parameters; a plant may extend it in a subclass."""

    dt: float  # sample time [s]


def unrolled(count: int, body: Callable, x: tuple, inputs: Any) -> tuple:
    """X after `count` calls x = body(x, inputs)."""
    for _ in range(count):
        x = body(x, inputs)
    return x


class Moment(NamedTuple):
    """A step of a plant, and what an effect may ask of it.

    Attributes:
        begin: whether an episode starts, known when the function is traced.
        step: the number of the step.
        dt: the sample time [s].
        draws: the random numbers of the step.
        state: the plant's state: sensors know that of the step, the amplifier that before it.
        number: distinguishes the effect's random numbers from those of other effects.
        repeat: repeat(count, body, x, inputs) is x after `count` calls x = body(x, inputs).
    """

    begin: bool
    step: Any
    dt: Any
    draws: Draws
    state: tuple = ()
    number: int = 0
    repeat: Callable = unrolled

    def uniforms(self, stream: int = CHANCE, step: Any = None) -> tuple:
        """Four uniform numbers in (0, 1), independent of other effects and steps."""
        return self.draws.uniforms(stream, self.number, self.step if step is None else step)

    def normals(self, stream: int = DISTURBANCE, step: Any = None) -> tuple:
        """Four standard normals, independent of other effects and steps."""
        return self.draws.normals(stream, 4, self.number, self.step if step is None else step)


class Effect:
    """Base of all effects; fields of the dataclass are the arguments.

    The `context` of its methods is the plant's: a `Context`, or a class of the plant's own that adds to it.
    """

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]  # every effect is a dataclass
    act: ClassVar[Callable]  # the function above, a staticmethod
    name: ClassVar[str]
    checks: ClassVar[Mapping[str, Callable]] = {}  # `check(name, value)` of an argument returns its stored value
    loses: ClassVar[bool] = False  # whether measurements may be missing: then their validity is observed

    def __post_init__(self):
        """Check the arguments."""
        for name, check in self.checks.items():
            set_field(self, name, check(name, getattr(self, name)))

    def parameters(self, context: Any) -> dict[str, Any]:
        """The parameters e by name: the arguments, unless overridden.

        A float or a tuple of floats is a number at run time, an array a table (`graphs.values.Table`). An integer
        is known when `act` is traced, and another one makes another program.
        """
        return {name: float(getattr(self, name)) for name in self.__dataclass_fields__}

    def largest(self) -> float:
        """Largest magnitude of a signal, at four standard deviations of its random part."""
        return 0.0

    def as_mapping(self) -> dict:
        """The effect as JSON can hold it: its name and its arguments."""
        return {"name": self.name, **dataclasses.asdict(self)}


def dropping_channels(sensors: Mapping[str, tuple[Effect, ...]]) -> tuple[int, ...]:
    """Numbers of the channels whose measurements may be missing, of effects by channel."""
    return tuple(i for i, chain in enumerate(sensors.values()) if any(effect.loses for effect in chain))


not_negative = partial(positive, zero_allowed=True)


def checked_probability(name: str, value) -> float:
    """Return value as a float; raise ValueError unless it lies within 0 and 1."""
    if within(name, value, 1.0) < 0:
        raise ValueError(f"{name} must be at least 0 and at most 1, but got {value!r}")
    return float(value)


Registered = TypeVar("Registered", bound=Effect)


class Registry:
    """Effects of one kind by name, and how to make them from mappings."""

    def __init__(self, argument: str, effects: Mapping[str, type[Effect]] | None = None):
        """Name the env's argument for which this registry makes effects, and the first of them."""
        self.argument = argument
        self.effects: dict[str, type[Effect]] = {}
        for name, effect in (effects or {}).items():
            self.register(name)(effect)

    def register(self, name: str) -> Callable[[type[Registered]], type[Registered]]:
        """Return a class decorator that makes a frozen dataclass an effect of this name."""

        def decorate(cls: type[Registered]) -> type[Registered]:
            cls.name = name
            self.effects[name] = cls
            return cls

        return decorate

    def make(self, effects) -> tuple[Effect, ...]:
        """Effects from None, one effect or a sequence of them, each an object or a mapping with its `name`.

        Raises ValueError if an argument is wrong; the message states the rule and the value.
        """
        if effects is None:
            return ()
        if isinstance(effects, (Mapping, Effect)):
            effects = [effects]
        if isinstance(effects, str) or not hasattr(effects, "__iter__"):
            raise ValueError(
                f"{self.argument} must be a list of mappings with a name, but got {short_repr(effects)}"
            )
        return tuple(self._make_effect(entry) for entry in effects)

    def _make_effect(self, entry) -> Effect:
        known: tuple[type[Effect], ...] = tuple(self.effects.values())
        if isinstance(entry, known):
            return entry
        names = ", ".join(self.effects)
        if not isinstance(entry, Mapping) or entry.get("name") not in tuple(self.effects):
            rule = f"each entry of {self.argument} must be a mapping whose name is one of {names}"
            raise ValueError(f"{rule}, but got {short_repr(entry)}")
        cls = self.effects[entry["name"]]
        arguments = {key: value for key, value in entry.items() if key != "name"}
        fields = [field.name for field in dataclasses.fields(cls)]
        unknown = sorted(set(arguments) - set(fields), key=str)
        if unknown:
            rule = f"arguments of {entry['name']!r} must be among {', '.join(fields)}"
            raise ValueError(f"{rule}, but got {unknown}")
        try:
            return cls(**arguments)
        except TypeError:  # a field without a default is missing
            rule = f"{entry['name']!r} must be given {', '.join(fields)}"
            raise ValueError(f"{rule}, but got {short_repr(arguments)}") from None


# Chains of effects that act one after the other: kinds, for which a plant's step is traced, and parameters.


class Kind(NamedTuple):
    """What a program is made for: the type of an effect, its parameters known now, and the names of the others."""

    effect: type[Effect]
    known: tuple[tuple[str, int], ...]
    names: tuple[str, ...]
    number: int

    def arguments(self, values: Sequence) -> tuple:
        """The parameters e of `act`, of the values of those that are not known now."""
        known = tuple(value for _, value in self.known)
        return _record((*self.names, *(name for name, _ in self.known)))(*values, *known)


@cache
def _record(names: tuple[str, ...]) -> Callable[..., tuple]:
    return namedtuple("Parameters", names)


def chain_of(
    effects: Sequence[Effect], context: Context, first: int = 0, lost_with: int | None = None
) -> tuple[tuple[Kind, ...], tuple[tuple, ...]]:
    """The kinds of some effects and their parameters.

    Args:
        effects: that act one after the other.
        context: of the plant.
        first: the number of the first of them.
        lost_with: the first number of another chain: measurements are lost when those of that one are.
    """
    kinds, parameters = [], []
    for index, effect in enumerate(effects):
        values = _representable(effect, effect.parameters(context))
        number = index + (lost_with if effect.loses and lost_with is not None else first)
        known = tuple((name, value) for name, value in values.items() if isinstance(value, int))
        names = tuple(name for name, value in values.items() if not isinstance(value, int))
        kinds.append(Kind(type(effect), known, names, number))
        parameters.append(tuple(values[name] for name in names))
    return tuple(kinds), tuple(parameters)


def run_chain(
    kinds: Sequence[Kind], parameters: Sequence, value: Any, memories: Sequence | None, t: Moment
) -> tuple[Any, tuple]:
    """The value after some effects, and their memories, from those of the last step.

    Raises:
        ValueError: if `act` of an effect cannot be traced, or keeps another number of values than at the start.
    """
    memories_after = []
    for kind, numbers, memory in zip(kinds, parameters, memories or (None,) * len(kinds), strict=True):
        name = kind.effect.name
        try:
            results = traceable(kind.effect.act)(
                kind.arguments(numbers), value, memory, t._replace(number=kind.number)
            )
            if not isinstance(results, tuple) or len(results) != 2 or shape_of(results[0]) != shape_of(value):
                rule = f"act of {name!r} must return the value, here {_form(value)}, and the memory"
                raise ValueError(f"{rule}, but got {results!r}")
            value, after = results
        except AttributeError as error:
            raise ValueError(f"act of {name!r} must take what its arguments have, but {error}") from error
        except TypeError as error:
            rule = f"act of {name!r} must be a function of numbers, and where(condition, a, b) choose between them"
            raise ValueError(f"{rule}, but {error}") from error
        if not t.begin and shape_of(after) != shape_of(memory):
            rule = "must have a memory of the same shape in each step as at the start of an episode"
            raise ValueError(f"act of {name!r} {rule}, but got {after!r}")
        memories_after.append(after)
    return value, tuple(memories_after)


def _form(value: Any) -> str:
    return f"a {type(value).__name__}" if hasattr(value, "_fields") else "a number"


def chain_runner(kinds_of: Mapping[str, Sequence[Kind]]) -> Callable:
    """Return `act(name, p, value, effects, t)` of a page: the value after a chain by name, and {name: memories}.

    `effects` are the memories of all chains after the last step, None at the start of an episode.
    """

    def act(name: str, p: Any, value: Any, effects: Mapping[str, Any] | None, t: Moment) -> tuple[Any, dict]:
        last = None if effects is None else effects[name]
        value, memories = run_chain(kinds_of[name], p.effects[name], value, last, t)
        return value, {name: memories}

    return act


def _representable(effect: Effect, parameters: Mapping[str, Any]) -> Mapping[str, Any]:
    """An effect's parameters; ValueError if an argument or a parameter is too large or too small."""
    smallest, largest = MAGNITUDES
    parts: list[Any] = [*_numbers(dataclasses.astuple(effect)), 0.0]
    magnitudes = [abs(value) for value in np.hstack(parts) if value]
    following = np.abs(np.hstack([0.0, *map(np.ravel, parameters.values())]))
    if min(magnitudes, default=1.0) < smallest or not max(*magnitudes, 0.0, following.max()) <= largest:
        rule = f"arguments of {effect.name!r} must be zero, or from {smallest:g} to {largest:g} in magnitude"
        raise ValueError(f"{rule}, and so must what follows from them, but got {short_repr(effect)}")
    return parameters


def _numbers(values: tuple) -> list:
    """The values that are numbers or tuples of numbers."""
    return [value for value in values if isinstance(value, (int, float, tuple)) and value]


def set_field(effect: object, name: str, value) -> None:
    """Set a checked value on a frozen effect, from its __post_init__."""
    object.__setattr__(effect, name, value)
