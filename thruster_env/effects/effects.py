"""Effects that disturb a plant: immutable values, registered by name, that JSON can hold.

An effect is a frozen dataclass of plain numbers with the function by which it acts in each step,

    act(e, value, memory, t) -> value, memory

of its parameters e, the value that it changes, the memory of the last step and the moment t. At the start of an
episode `t.begin` is true and the memory None. The function is pure; it is traced once and runs for any number of
copies (`thruster_env.env.copies`). Anyone may register further effects.
"""

from __future__ import annotations

import csv
import dataclasses
import math
from collections import ChainMap, namedtuple
from collections.abc import Callable, Mapping, MutableMapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np

from thruster_env.core.checks import finite, positive, short_repr, vector, within
from thruster_env.core.streams import CHANCE, DISTURBANCE
from thruster_env.graphs.draws import Draws
from thruster_env.graphs.graphs import where
from thruster_env.graphs.values import shape_of, traceable

MAGNITUDES = (1e-100, 1e100)  # of an effect's arguments and of what follows from them
LONGEST = 1e9  # [s], and in steps: what an effect may hold
SPACING = 64  # effects of each chain have numbers of their own, whatever the other chains hold


@dataclasses.dataclass(frozen=True)
class Context:
    """The context from which an effect computes its parameters; a plant may extend it in a subclass."""

    dt: float  # sample time [s]


class WithoutStep(Context):
    """The context of an env that does not know its sample time."""

    def __getattribute__(self, name: str) -> Any:
        """ValueError for the sample time, on which an effect depends."""
        if name == "dt":
            raise ValueError("dt must be given, the sample time [s], where effects depend on it, but it is None")
        return super().__getattribute__(name)


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
    loses: ClassVar[bool | None] = False  # whether measurements may be missing; None if it only moves missing ones

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

    def __init__(self, argument: str, effects: MutableMapping[str, type[Effect]] | None = None):
        """Name the env's argument for which this registry makes effects, and another one's that it has, too."""
        self.argument = argument
        self.effects: ChainMap[str, type[Effect]] = ChainMap({}, effects if effects is not None else {})
        for name, effect in self.effects.items():
            effect.name = name

    def register(self, name: str) -> Callable[[type[Registered]], type[Registered]]:
        """Return a class decorator that makes a frozen dataclass an effect of this name."""

        def decorate(cls: type[Registered]) -> type[Registered]:
            known = self.effects.get(name, cls)
            if known.__module__ != cls.__module__:  # else it is defined anew, as in a notebook
                of_other = f"{known.__qualname__} of {known.__module__}"
                raise ValueError(f"an effect must have a name of its own, but {name!r} is {of_other}")
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
            results = traceable(kind.effect.act, may_raise=False)(
                kind.arguments(numbers), value, memory, t._replace(number=kind.number)
            )
            if not isinstance(results, tuple) or len(results) != 2 or shape_of(results[0]) != shape_of(value):
                rule = f"act of {name!r} must return the value, here {_form(value)}, and the memory"
                raise ValueError(f"{rule}, but got {results!r}")
            if kind.effect.loses is False and not _same(*(getattr(v, "valid", 1.0) for v in (value, results[0]))):
                raise ValueError(f"{name!r} must have `loses = True` to lose measurements, but it changes `valid`")
            value, after = results
        except AttributeError as error:
            raise ValueError(f"act of {name!r} must take what its arguments have, but {error}") from error
        except TypeError as error:
            rule = f"act of {name!r} must be a function of numbers, and where(condition, a, b) choose between them"
            hint = " (memory is None where t.begin is true)" if t.begin and "None" in str(error) else ""
            raise ValueError(f"{rule}, but {error}{hint}") from error
        if not t.begin and shape_of(after) != shape_of(memory):
            rule = "must have a memory of the same shape in each step as at the start of an episode"
            raise ValueError(f"act of {name!r} {rule}, but got {after!r}")
        memories_after.append(after)
    return value, tuple(memories_after)


def _same(a: Any, b: Any) -> bool:
    """Whether two numbers of a graph are one, or both known and equal."""
    return a is b or getattr(a, "value", a) == getattr(b, "value", b) is not None


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


# Signals that add to a disturbance of a plant, such as a flow or a wind, in the unit of that quantity.
#
# A signal is held over a sample time; a function of time is evaluated in its middle. A plant registers the
# signals that it has (`Registry.register`).


def recorded_value(e, time):
    """The value at a time [s] of a series e with its sample time, linear between its values."""
    position, count = max(time / e.sample_time, 0.0), e.series.count
    position = position % count if e.repeat else min(position, count - 1.0)
    before = min(np.floor(position), count - 1.0)
    after = where(before + 1.0 < count, before + 1.0, 0.0 if e.repeat else before)
    share = position - before
    return (1.0 - share) * e.series[before] + share * e.series[after]


@dataclass(frozen=True)
class ConstantSignal(Effect):
    """A constant `value`."""

    value: float
    checks = {"value": finite}

    def largest(self) -> float:
        """Its magnitude."""
        return abs(self.value)

    @staticmethod
    def act(e, value, memory, t):
        """Add a constant."""
        return value + e.value, memory


@dataclass(frozen=True)
class Sinusoid(Effect):
    """`amplitude` sin(2 pi t/`period` [s] + `phase` [rad]), as waves make it."""

    amplitude: float
    period: float = 4.0
    phase: float = 0.0
    checks = {"amplitude": finite, "period": positive, "phase": finite}

    def largest(self) -> float:
        """The amplitude."""
        return abs(self.amplitude)

    @staticmethod
    def act(e, value, memory, t):
        """Add amplitude sin(2 pi t/period + phase)."""
        time = (t.step - 0.5) * t.dt
        return value + e.amplitude * math.sin(2.0 * math.pi * time / e.period + e.phase), memory


@dataclass(frozen=True)
class GaussMarkov(Effect):
    """A process of zero mean, standard deviation `std` and correlation exp(-t/`time_constant` [s])."""

    std: float
    time_constant: float = 1.0
    checks = {"std": not_negative, "time_constant": positive}

    def largest(self) -> float:
        """Four standard deviations."""
        return 4.0 * self.std

    def parameters(self, context: Context) -> dict[str, Any]:
        """Standard deviation and the correlation of neighbouring steps."""
        return {"std": self.std, "decay": math.exp(-context.dt / self.time_constant)}

    @staticmethod
    def act(e, value, x, t):
        """Add a first-order Gauss-Markov process, x' = a x + s sqrt(1 - a^2) n, stationary from the start."""
        n = t.normals()[0]
        x = e.std * n if t.begin else e.decay * x + e.std * (1.0 - e.decay * e.decay) ** 0.5 * n
        return value + x, x


@dataclass(frozen=True)
class Gusts(Effect):
    """One-minus-cosine gusts that begin at random while none is under way.

    Args:
        std: standard deviation of a gust's height.
        rate: gusts that begin per second of calm [1/s].
        duration: of a gust [s].
    """

    std: float
    rate: float = 0.5
    duration: float = 0.5
    checks = {"std": not_negative, "rate": not_negative, "duration": positive}

    def largest(self) -> float:
        """Four standard deviations of the height [m/s]."""
        return 4.0 * self.std

    def parameters(self, context: Context) -> dict[str, Any]:
        """Probability that one begins in a calm step, standard deviation, duration [s]."""
        chance = 1.0 - math.exp(-self.rate * context.dt)
        return {"chance": chance, "std": self.std, "duration": self.duration}

    @staticmethod
    def act(e, value, memory, t):
        """Add gusts that begin at random; each is height/2 (1 - cos(2 pi t/duration)), with a normal height."""
        since, height = (e.duration, 0.0) if t.begin else memory
        since = since + t.dt
        begins = (since >= e.duration) & (t.uniforms()[0] < e.chance)
        since, height = where(begins, 0.5 * t.dt, since), where(begins, e.std * t.normals()[0], height)
        gust = 0.5 * height * (1.0 - math.cos(2.0 * math.pi * since / e.duration))
        return value + where(since < e.duration, gust, 0.0), (since, height)


@dataclass(frozen=True)
class RecordedSeries(Effect):
    """A series given by its `values`, or by a `file` that holds them in a column, one every `sample_time`.

    Args:
        values: numbers in SI units.
        sample_time: between two values [s].
        repeat: start again after the last value; otherwise the last one stays.
        file: a CSV file with a header line, read when the effect is made; instead of `values`.
        column: name of the column in it.
    """

    values: tuple[float, ...] | None = None
    sample_time: float = 0.01
    repeat: bool = False
    file: str | None = None
    column: str | None = None

    def __post_init__(self):
        """Read the file, if there is one, and check the arguments."""
        if (self.values is None) == (self.file is None):
            raise ValueError(f"either values or file must be given, but got {self.values!r} and {self.file!r}")
        values = self.values if self.file is None else _column(self.file, self.column)
        set_field(self, "values", tuple(vector("values", values).tolist()))
        set_field(self, "sample_time", positive("sample_time", self.sample_time))
        set_field(self, "repeat", bool(self.repeat))

    @property
    def _series(self) -> tuple[float, ...]:
        return self.values or ()  # never None once it is made

    def as_mapping(self) -> dict:
        """Name and arguments; a file stays a file."""
        mapping = super().as_mapping()
        mapping["values"] = None if self.file is not None else list(self._series)
        return mapping

    def largest(self) -> float:
        """Largest magnitude in the series."""
        return max(map(abs, self._series))

    def parameters(self, context: Context) -> dict[str, Any]:
        """The parameters of `recorded_value`."""
        return {"sample_time": self.sample_time, "repeat": int(self.repeat), "series": np.array(self._series)}


def _column(file: str, column: str | None) -> np.ndarray:
    path = Path(file)
    if not path.is_file() or not path.stat().st_size:
        raise ValueError(f"file must be a CSV file that exists and is not empty, but got {short_repr(file)}")
    with path.open(newline="", encoding="utf-8-sig") as lines:
        names, *rows = ([entry.strip() for entry in row] for row in csv.reader(lines) if row)
    names[0] = names[0].removeprefix("#").strip()  # headers are comments to some programs
    if column not in names:
        raise ValueError(f"column must be one of {', '.join(names)}, but got {column!r}")
    if any(len(row) != len(names) for row in rows):
        raise ValueError(f"file must be a CSV file with a header line over equally long rows, but {file!r} is not")
    entries = [row[names.index(column)] for row in rows]
    try:
        return np.array(entries, dtype=np.float64)
    except ValueError:
        raise ValueError(f"values must be some finite numbers, but got {short_repr(entries)}") from None


@dataclass(frozen=True)
class RecordedSignal(RecordedSeries):
    """A recorded signal."""

    @staticmethod
    def act(e, value, memory, t):
        """Add a recorded series."""
        return value + recorded_value(e, (t.step - 0.5) * t.dt), memory
