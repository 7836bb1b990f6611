"""Models by name as text: "constant-velocity:axes=2", "pendulum:length=0.4", for wrappers, logs and commands.

A name is one of `filters.models`, or a sum of such, or one of `filters.plants`; behind a colon stand values of its
numbers. What it gives is a function of numbers that makes a model, as other sources of models are.
"""

from __future__ import annotations

import inspect
import math
import re
from collections import namedtuple
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any

import numpy as np

from filters.models import NAMES, WITH_SETTINGS, named_model, parts_of
from filters.plants import FINE, PLANTS
from thruster_env.core.checks import at_least, finite, one_of, positive, short_repr
from thruster_env.model.affine import AffineModel, affine_functions
from thruster_env.model.continuous import ContinuousModel
from thruster_env.model.quantities import Quantity

AUTO = "auto"  # in place of a name: the simplest model that predicts unseen data as well as the best
R, AXES, DT, MEAN = "R", "axes", "dt", "mean"  # settings of every model of `filters.models` beside its numbers
PERIOD = "period"
FORM = PERIOD, "seasons", "harmonics"  # settings that make another model, with other free numbers
MOST_AXES = 64


@dataclass(frozen=True)
class NamedMaker:
    """A model of `filters.models` as a function of its numbers, R and dt.

        model_named("constant-velocity:axes=2,acceleration=0.04,R=0.25")(dt=0.1)

    Attributes:
        name: of the model, or a sum.
        quantities: name, symbol and unit of the measurement on each axis.
        values: of its numbers and R by name; those that it lacks must be given when it is called.
        mean: of the data on each axis, or one for all, about which a model without a level varies.
        first: the first measurement of each axis, where a filter begins; the mean, if there is one, or 0 if None.
        spread: of the data.
        dt: sample time [s], if the text gives it.
    """

    name: str
    quantities: tuple[Quantity, ...] = (Quantity("measurement", "z"),)
    values: Mapping[str, float] = field(default_factory=dict)
    mean: tuple[float, ...] | None = None
    first: tuple[float, ...] | None = None
    spread: float = 1.0
    dt: float | None = None

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the numbers, R last."""
        return (*(number.name for number in named_model(self.name).free), R)

    @property
    def is_complete(self) -> bool:
        """Whether all numbers have a value."""
        return set(self.names) <= set(self.values)

    @property
    def __signature__(self) -> inspect.Signature:
        """Dt and the numbers, with their values as defaults."""
        nothing, kind = inspect.Parameter.empty, inspect.Parameter.KEYWORD_ONLY
        defaults = {name: self.values.get(name, nothing) for name in self.names}
        defaults[DT] = nothing if self.dt is None else self.dt
        return inspect.Signature([inspect.Parameter(name, kind, default=defaults[name]) for name in defaults])

    def __call__(self, *, dt: float | None = None, **numbers: float) -> AffineModel:
        """The model; ValueError if a number has no value."""
        dt, values = self.dt if dt is None else dt, {**self.values, **numbers}
        missing = [name for name in self.names if name not in values] + [DT] * (dt is None)
        if dt is None or missing:
            settings = ",".join(f"{name}=..." for name in missing)
            raise ValueError(
                f"{self.name} must come with {', '.join(missing)}, as {self.name}:{settings}, but got none: "
                "thruster fit (tuning.fit) finds these numbers in data"
            )
        offset = 0.0 if self.mean is None else self.mean
        return named_model(self.name).model(
            {name: value for name, value in values.items() if name != R},
            positive(R, values[R]),
            dt,
            first=offset if self.first is None else self.first,
            spread=self.spread,
            offset=offset,
            quantities=self.quantities,
        )

    def continuous(self, *, dt: float | None = None, **numbers: float) -> ContinuousModel:
        """The same model in continuous time, for steps of any length: dx/dt = A x + w, z = C x + offset + v.

            plant = model_named("constant-velocity:acceleration=0.04,R=0.25").continuous(dt=0.1)
            filters.run(make_filter("ekf", plant.at(0.1)), z, dt=steps, noise=plant.noise)

        Args:
            dt: typical sample time [s], by which the prior is wide.
            **numbers: values that the text does not give.
        """
        plain, axes = self(dt=dt, **numbers), np.eye(len(self.quantities))
        values = {name: value for name, value in {**self.values, **numbers}.items() if name != R}
        signal = named_model(self.name).signal(values)
        slope, output = np.kron(axes, signal.slope), np.kron(axes, signal.output[None])
        offset = plain.matrices()[4]
        parts = slope, np.zeros(plain.n), output, offset
        functions = affine_functions(plain.n, plain.m, 0)
        fastest = float(np.abs(np.linalg.eigvals(signal.slope)).max())
        return ContinuousModel(
            rates=functions["transition"],
            observe=functions["observe"],
            densities=np.kron(axes, signal.densities),
            constants=_form(sum(part.size for part in parts))(*np.concatenate([np.ravel(p) for p in parts]), 1.0),
            longest=FINE / fastest if fastest > 0.0 else math.inf,
            arguments={
                "prior_mean": plain.prior_mean,
                "prior_cov": plain.prior_cov,
                "measurement_noise_cov": plain.measurement_noise_cov,
                "inputs": 0,
                "states": plain.states,
                "measurements": plain.measurements,
            },
        )


@lru_cache(maxsize=64)
def _form(size: int) -> Any:
    """A class of so many constants and `substep`, whose values can be pickled."""
    make: Any = namedtuple  # whose names are no literals
    form = make("Constants", [*(f"c_{i}" for i in range(size)), "substep"])
    form.__reduce__ = lambda self: (_constants, tuple(self))
    return form


def _constants(*values: float) -> Any:
    return _form(len(values) - 1)(*values)


def model_named(text: Any) -> NamedMaker | Callable[..., Any] | None:
    """What makes the model of NAME[:KEY=VALUE,...]; None for a text that is no such name.

    Args:
        text: a model of `filters.models`, or a sum of such, with values of its numbers, R, axes, dt, mean (of axes
            that differ mean_1, mean_2, ...); or one of `filters.plants` with values of its arguments. A level
            begins at the mean, or at 0, with a deviation of 100: far from 0 a filter without data needs the mean.

    Raises:
        ValueError: for an unknown setting, or a value that is no number.
    """
    if not is_model_name(text):
        return None
    name, _, settings = text.partition(":")
    return _plant(name.strip(), settings) if name.strip() in PLANTS else _maker(text)


def is_named(name: str) -> bool:
    """Whether a text is the name of a model, or a sum of such names."""
    return all(part.partition(":")[0].strip().lower() in NAMES for part in parts_of(name))


def is_model_name(text: Any) -> bool:
    """Whether something is the name of a model, perhaps with settings, and no "module:object"."""
    if not isinstance(text, str) or re.fullmatch(r"[\w.]+:[A-Za-z_][\w.]*", text):
        return False
    return text.partition(":")[0].strip() in PLANTS or is_named(text)


def _plant(name: str, settings: str) -> Callable[..., Any]:
    """A function of `filters.plants`, with some of its arguments."""
    make = PLANTS[name]
    known = {
        key: parameter.default
        for key, parameter in inspect.signature(make).parameters.items()
        if isinstance(parameter.default, float | str)
    }
    values: dict[str, Any] = {}
    for key, value in _pairs(name, settings).items():
        default = known[one_of(f"a setting of {name}", key, known)]
        values[key] = value if isinstance(default, str) else finite(f"{key} of {name}", value)
    return partial(make, **values) if values else make


def _maker(text: str) -> NamedMaker:
    parts, values = [], {}
    for part in parts_of(text):
        name, _, settings = (piece.strip() for piece in part.partition(":"))
        retained = []
        for setting in settings.split(",") if settings else []:
            key, equals, value = (piece.strip() for piece in setting.partition("="))
            if not equals or name.lower() in WITH_SETTINGS and key in FORM:
                retained.append(setting)
            else:
                _check_once(name, setting, (name.lower().replace("-", "_"), key) in values)
                values[name.lower().replace("-", "_"), key] = value
        parts.append(name + ":" * bool(retained) + ",".join(retained))
    maker = NamedMaker(named_model(" + ".join(parts)).name)
    of_axes = [key for _, key in values if re.fullmatch(rf"{MEAN}_\d+", key)]
    known, numbers = (*maker.names, AXES, DT, MEAN, *sorted(set(of_axes))), {}
    signed = {MEAN, *of_axes, *(number.name for number in named_model(maker.name).free if not number.log)}
    for (part, key), value in values.items():
        key = f"{part}_{key}" if f"{part}_{key}" in known else key
        check = finite if key in signed else positive
        _check_once(maker.name, f"{key}={value}", key in numbers)
        numbers[one_of(f"a setting of {maker.name}", key, known)] = check(f"{key} of {maker.name}", value)
    count, dt, mean = numbers.pop(AXES, 1.0), numbers.pop(DT, None), numbers.pop(MEAN, None)
    axes = at_least(AXES, int(count) if count == int(count) else count, 1, MOST_AXES)
    means: tuple[float, ...] | None = None if mean is None else (mean,)
    if of_axes:
        names = _names_of_means(axes)
        if mean is not None or set(names) != set(of_axes):
            rule = f"means of {maker.name} must be one for each axis, {', '.join(names)}, or one for all, mean"
            raise ValueError(f"{rule}, but got {', '.join(of_axes)}")
        means = tuple(numbers.pop(name) for name in names)
    maker = replace(maker, values=numbers, dt=dt, mean=means)
    return replace(maker, quantities=axes_named("z", axes))


def _check_once(name: str, setting: str, is_known: bool) -> None:
    """Raise ValueError for a setting that comes twice."""
    if is_known:
        raise ValueError(f"settings of {name} must be KEY=VALUE, each once, but got {short_repr(setting)} again")


def _names_of_means(axes: int) -> list[str]:
    return [f"{MEAN}_{i + 1}" for i in range(axes)]


def text_of(
    name: str, values: Mapping[str, float], axes: int = 1, mean: float | Sequence[float] | None = None
) -> str:
    """The text from which `model_named` makes a model with these numbers, to seven digits.

    Numbers stand behind the last part of a sum: "constant + harmonic:period=24,constant_drift=1,R=2"; a free
    period stands behind its harmonic, as a fixed one does.
    """
    numbers = dict(values)
    parts = [part.strip() for part in parts_of(name)]
    for i, part in enumerate(parts):
        if part.partition(":")[0] == "harmonic" and PERIOD in numbers:
            parts[i] = _with(part, [f"{PERIOD}={_digits(numbers.pop(PERIOD))}"])
    settings = [f"{AXES}={axes}"] * (axes > 1) + [f"{key}={_digits(value)}" for key, value in numbers.items()]
    means = np.ravel([] if mean is None else mean).tolist()
    names = [MEAN] if len(set(means)) == 1 else _names_of_means(len(means))
    settings += [f"{key}={value:.12g}".replace("e+", "e") for key, value in zip(names, means, strict=False)]
    return _with(" + ".join(parts), settings)


def _with(text: str, settings: list[str]) -> str:
    """A name with further settings of its last part."""
    return f"{text}{',' if ':' in parts_of(text)[-1] else ':'}{','.join(settings)}"


def _digits(value: float) -> str:
    return f"{value:.7g}".replace("e+", "e")


def axes_named(symbol: str, axes: int) -> tuple[Quantity, ...]:
    """The measurements of so many axes: z, or z_1, z_2, ..."""
    symbols = [symbol] if axes == 1 else [f"{symbol}_{i + 1}" for i in range(axes)]
    return tuple(Quantity("measurement", each) for each in symbols)


def _pairs(name: str, settings: str) -> dict[str, str]:
    pairs: dict[str, str] = {}
    for setting in settings.split(",") if settings else []:
        key, equals, value = (piece.strip() for piece in setting.partition("="))
        if not equals or key in pairs:
            raise ValueError(f"settings of {name} must be KEY=VALUE, each once, but got {short_repr(setting)}")
        pairs[key] = value
    return pairs
