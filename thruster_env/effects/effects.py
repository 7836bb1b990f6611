"""Effects that disturb a plant: immutable values, registered by name, that JSON can hold.

An effect is a frozen dataclass of plain numbers with the function that acts on a block of copies,

    act(memory, b, target, rows, number, numbers, at, begin)

where `memory[b, target, j]` is the value that it changes for copy j, `memory[b, rows + i, j]` are its own states,
`numbers[at + i]` its parameters, `number` distinguishes its random draws from those of other effects, and `begin`
is true at the start of an episode. The same function serves a single env, a batch and a vector env. Anyone may
register further effects before the first env is made.

Effects are called, not inlined: each loops over all copies of a block, and a plant's two kernels share them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, ClassVar, TypeVar

import numpy as np

from thruster_env.core.checks import positive, short_repr, within
from thruster_env.core.compiled import inlined, not_inlined
from thruster_env.core.memory import KEY_0, KEY_1, STEP
from thruster_env.core.sources import written_out
from thruster_env.core.streams import CHANCE, DISTURBANCE, normal_block, uniform_block

# An effect in a row of numbers: its length, kind, row that it acts on, first row of its own, number, parameters.
EFFECT_KIND, EFFECT_TARGET, EFFECT_ROWS, EFFECT_NUMBER, EFFECT_PARAMETERS = range(1, 6)
MAGNITUDES = (1e-100, 1e100)  # of an effect's arguments and of what follows from them
LONGEST = 1e9  # [s], and in steps: what an effect may hold
PLANT_ROWS, TRIED_ROW = 4096, 2048  # more rows than a plant has, and one of them: where an effect is tried
SPACING = 64  # effects of each chain have numbers of their own, whatever the other chains hold


@dataclasses.dataclass(frozen=True)
class Context:
    """The context from which an effect computes its parameters; a plant may extend it in a subclass."""

    dt: float  # sample time [s]
    valid_offset: int  # from the row of a measured channel to the one that says whether it is valid


class Effect:
    """Base of all effects; fields of the dataclass are the arguments.

    The `context` of its methods is the plant's: a `Context`, or a class of the plant's own that adds to it.
    """

    __dataclass_fields__: ClassVar[dict[str, dataclasses.Field[Any]]]  # every effect is a dataclass
    act: ClassVar[Callable]  # the function above, a staticmethod
    name: ClassVar[str]
    checks: ClassVar[Mapping[str, Callable]] = {}  # `check(name, value)` of an argument returns its stored value
    row_count: ClassVar[int] = 0  # states that a copy keeps for this effect
    loses: ClassVar[bool] = False  # whether measurements may be missing: then their validity is observed

    def __post_init__(self):
        """Check the arguments."""
        for name, check in self.checks.items():
            set_field(self, name, check(name, getattr(self, name)))

    def parameters(self, context: Any) -> list[float]:
        """Parameters that `act` reads from `numbers[at]` on: the fields in order, unless overridden."""
        return [float(value) for value in dataclasses.astuple(self)]

    def rows(self, context: Any) -> int:
        """Number of states that a copy keeps for this effect: `row_count`, unless overridden."""
        return self.row_count

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


Kind = TypeVar("Kind", bound=Effect)
_tried: set[tuple[type[Effect], int]] = set()  # types of effects, and their rows, that stay within their memory


class Registry:
    """Effects of one kind by name, and how to make them from mappings."""

    def __init__(self, argument: str, effects: Mapping[str, type[Effect]] | None = None):
        """Name the env's argument for which this registry makes effects, and the first of them."""
        self.argument = argument
        self.effects: dict[str, type[Effect]] = {}
        for name, effect in (effects or {}).items():
            self.register(name)(effect)

    def register(self, name: str) -> Callable[[type[Kind]], type[Kind]]:
        """Return a class decorator that makes a frozen dataclass an effect of this name."""

        def decorate(cls: type[Kind]) -> type[Kind]:
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


@inlined
def normals(memory, b, j, number):
    """Four standard normals of one effect, copy and step."""
    return normal_block(number, memory[b, STEP, j], DISTURBANCE, memory[b, KEY_0, j], memory[b, KEY_1, j])


@inlined
def uniforms(memory, b, j, number):
    """Four uniform numbers in (0, 1) of one effect, copy and step."""
    return uniform_block(number, memory[b, STEP, j], CHANCE, memory[b, KEY_0, j], memory[b, KEY_1, j])


def encoded(
    effects,
    kinds: tuple[type[Effect], ...],
    target: int,
    first_row: int,
    first_number: int,
    context: Context,
    lost_with: int | None = None,
):
    """Numbers of some effects on one target row, and the number of rows that they take.

    With `lost_with`, the first number of another channel's effects, measurements are lost when that channel's are.
    """
    numbers: list[float] = []
    rows = 0
    for index, effect in enumerate(effects):
        parameters = _representable(effect, effect.parameters(context))
        _check_reach(effect, parameters, context)
        number = index + (lost_with if effect.loses and lost_with is not None else first_number)
        header = [5 + len(parameters), kinds.index(type(effect)), target, first_row + rows, number]
        numbers += [*header, *parameters]
        rows += effect.rows(context)
    return numbers, rows


def encoded_chains(
    chains: Iterable[tuple[int, Sequence[Effect], int, int, int | None]],
    kinds: tuple[tuple[type[Effect], ...], ...],
    first_row: int,
    context: Context,
) -> tuple[list[float], list[int], int]:
    """Numbers of a plant's effects in the order in which they act, their count by section, and the rows they take.

    Args:
        chains: section, effects, target row, first number and `lost_with` (see `encoded`) of each chain.
        kinds: the known types of effects of each section.
        first_row: the first row of the memory that effects may have.
        context: of the plant.
    """
    program: list[float] = []
    counts, rows = [0] * len(kinds), 0
    for section, effects, target, number, lost_with in chains:
        code, row_count = encoded(effects, kinds[section], target, first_row + rows, number, context, lost_with)
        program += code
        counts[section] += len(effects)
        rows += row_count
    return program, counts, rows


def _representable(effect: Effect, parameters: list[float]) -> list[float]:
    """An effect's parameters as floats; ValueError if an argument or a parameter is too large or too small."""
    smallest, largest = MAGNITUDES
    parts: list[Any] = [*_numbers(dataclasses.astuple(effect)), 0.0]
    magnitudes = [abs(value) for value in np.hstack(parts) if value]
    if min(magnitudes, default=1.0) < smallest or not all(
        abs(value) <= largest for value in (*magnitudes, *parameters)
    ):
        rule = f"arguments of {effect.name!r} must be zero, or from {smallest:g} to {largest:g} in magnitude"
        raise ValueError(f"{rule}, and so must what follows from them, but got {short_repr(effect)}")
    return [float(value) for value in parameters]


def _check_reach(effect: Effect, parameters: list[float], context: Context) -> None:
    """Raise ValueError if `act` goes beyond the effect's rows or parameters, which compiled code would not notice.

    It is tried as Python, once for each type and number of rows, at the end of a memory that NumPy guards.
    """
    rows = effect.rows(context)
    if (type(effect), rows) in _tried:
        return
    memory, numbers = np.zeros((1, PLANT_ROWS + rows, 1)), np.array([0.0] * EFFECT_PARAMETERS + parameters)
    memory[0, [KEY_0, KEY_1], 0] = 1.0, 2.0
    try:
        for step in range(3):
            memory[0, STEP, 0] = step
            effect.act(memory, 0, TRIED_ROW, PLANT_ROWS, 1, numbers, EFFECT_PARAMETERS, step == 0)
    except IndexError as error:
        rule = (
            f"act of {effect.name!r} must stay within its {rows} rows (row_count) and {len(parameters)} parameters"
        )
        raise ValueError(f"{rule}, but goes beyond them: {error}") from None
    _tried.add((type(effect), rows))


def _numbers(values: tuple) -> list:
    """The values that are numbers or tuples of numbers."""
    return [value for value in values if isinstance(value, (int, float, tuple)) and value]


def set_field(effect: object, name: str, value) -> None:
    """Set a checked value on a frozen effect, from its __post_init__."""
    object.__setattr__(effect, name, value)


# Chains of effects in compiled code: packed parameters of effects that act one after the other.


def _dispatch(effects: tuple[type[Effect], ...]) -> Callable:
    """Write out `run(kind, ...)`, which calls the function of one of some effects."""
    arguments = "memory, b, target, rows, number, numbers, at, begin"
    functions: dict[str, Any] = {f"act_{i}": not_inlined(effect.act) for i, effect in enumerate(effects)}
    lines = [line for i, name in enumerate(functions) for line in (f"if kind == {i}:", f"    {name}({arguments})")]
    return written_out("run_effect", f"kind, {arguments}", *lines, "None", **functions)


def chain_of(effects: tuple[type[Effect], ...], count: int) -> Callable:
    """Return `run(memory, b, numbers, at, begin)`: run the effects that `effects.encoded` put at numbers[at].

    It returns the offset behind them.

    Args:
        effects: the known types of effects, as `encoded` had them.
        count: the offset in numbers of the number of effects.
    """
    dispatch = _dispatch(effects)

    @not_inlined
    def run_chain(memory, b, numbers, at, begin):
        for _ in range(int(numbers[count])):
            kind, target = int(numbers[at + EFFECT_KIND]), int(numbers[at + EFFECT_TARGET])
            rows, number = int(numbers[at + EFFECT_ROWS]), int(numbers[at + EFFECT_NUMBER])
            dispatch(kind, memory, b, target, rows, number, numbers, at + EFFECT_PARAMETERS, begin)
            at += int(numbers[at])
        return at

    return run_chain
