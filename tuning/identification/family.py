"""Any model as a function of its named parameters: arguments of a function, constants, Q and R.

A factory may write `lambda x, u, c: (gain * u[0],)`, of which each gain is another function, with machine code of
its own. Here the numbers that differ follow the model's constants, and there is one function for all.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import finite, short_repr
from thruster_env.core.derivatives import by_complex_step
from thruster_env.core.equal_functions import bound_call, captured_numbers, differ_in_numbers_alone, with_numbers
from thruster_env.graphs.graphs import Number
from thruster_env.graphs.tracing import traced
from thruster_env.logs.log import AnyStepModel, in_any_steps
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.traced import traced_model
from tuning.problems.problem import Parameter, squared
from tuning.search.parameters import r_name

FACTOR = 10.0  # range of a positive parameter about its start
NOISE_FACTOR = 1e4  # range of a variance about its start
FUNCTIONS = "transition", "observe", "transition_jacobian", "observe_jacobian"


class ModelFamily:
    """The models that a function makes from its arguments, or a model with other constants.

    The parameters are the function's arguments that have a number for a default; the fields of the constants,
    where these are a NamedTuple and no argument has the name; and Q11, Q22, ... and R, or R11, R22, ...

    Args:
        make: a function, or a model.
        free: names of free parameters.
        noise: whether the variances of Q (those that are not zero) and R are free, too.
        dt: sample time [s], passed to the function if it has this argument; covariances do not scale with it.

    Raises:
        ValueError: for an unknown name; the message has the known ones.
    """

    def __init__(
        self, make: Callable | StateSpaceModel, free: Sequence[str], *, noise: bool = True, dt: float | None = None
    ):
        """Find the parameters by name."""
        self._make: Callable[..., StateSpaceModel]
        self._make = partial(_same, make) if isinstance(make, StateSpaceModel) else make
        self._arguments = _numbers_of(self._make)
        if dt is not None and "dt" in inspect.signature(self._make).parameters:
            self._arguments.pop("dt", None)
            self._make = partial(self._make, dt=dt)
        self.base = self._make()
        if not isinstance(self.base, StateSpaceModel):
            raise ValueError(
                f"a model must be a StateSpaceModel, but {short_repr(make)} makes {short_repr(self.base)}"
            )
        constants = self.base.constants
        self._fields = [name for name in getattr(constants, "_fields", ()) if name not in self._arguments]
        self._noise = self._variances()
        names = list(dict.fromkeys([*free, *(self._noise if noise else ())]))
        known = self.known
        wrong = [name for name in names if name not in known]
        if wrong:
            raise ValueError(f"free parameters must be of {', '.join(known)}, but got {short_repr(wrong[0])}")
        self.free = tuple(known[name] for name in names)

    @property
    def known(self) -> dict[str, Parameter]:
        """Every parameter that may be free, with its range about its start."""
        starts = dict(self._arguments) | {name: getattr(self.base.constants, name) for name in self._fields}
        parameters = {name: about(name, float(value)) for name, value in starts.items()}
        units = [quantity.unit for quantity in (*self.base.states, *self.base.measurements)]
        for name, (_, index, variance) in self._noise.items():
            unit = squared(units[index + (0 if name.startswith("Q") else self.base.n)])
            ends = variance / NOISE_FACTOR, variance * NOISE_FACTOR
            parameters.setdefault(name, Parameter(name, *ends, unit, default=variance))
        return parameters

    @property
    def variances_of_q(self) -> tuple[str, ...]:
        """Names of the parameters that are variances in Q."""
        return tuple(name for name, (kind, *_) in self._noise.items() if kind == "process_noise_cov")

    def model(self, **values: float) -> StateSpaceModel:
        """The model for values of some parameters; the others stay."""
        arguments = {name: value for name, value in values.items() if name in self._arguments}
        model = self._make(**arguments) if arguments else self.base
        fields = {name: value for name, value in values.items() if name in self._fields}
        constants: Any = model.constants  # a NamedTuple, if it has fields
        changes: dict[str, Any] = {"constants": constants._replace(**fields)} if fields else {}
        for name in ("process_noise_cov", "measurement_noise_cov"):
            cov = getattr(model, name).copy()
            for key, value in values.items():
                kind, index, _ = self._noise.get(key, (None, 0, 0.0))
                if kind == name and key not in self._arguments:
                    factor = np.sqrt(value / cov[index, index])
                    cov[index] *= factor
                    cov[:, index] *= factor
                    changes[name] = cov
        return model.replace(**changes) if changes else model

    def _variances(self) -> dict[str, tuple[str, int, float]]:
        """The covariance of each variance, its index, and its value."""
        variances = {}
        for i, variance in enumerate(np.diag(self.base.process_noise_cov).tolist()):
            if variance > 0:
                variances[f"Q{i + 1}{i + 1}"] = ("process_noise_cov", i, variance)
        for i, variance in enumerate(np.diag(self.base.measurement_noise_cov).tolist()):
            variances[r_name(i, self.base.m)] = ("measurement_noise_cov", i, variance)
        return variances


def _same(model: StateSpaceModel) -> StateSpaceModel:
    return model


def about(name: str, value: float, unit: str = "") -> Parameter:
    """A parameter within a range about its start: a factor of ten for a positive one."""
    if value > 0:
        return Parameter(name, value / FACTOR, value * FACTOR, unit, default=value)
    reach = FACTOR * abs(value) or 1.0
    return Parameter(name, -reach, reach, unit, log=False, default=value)


def with_ranges(
    free: Sequence[Parameter], ranges: Mapping[str, tuple[float, float]], start: Mapping[str, float]
) -> tuple[Parameter, ...]:
    """Free parameters with other ranges and starts; a range that reaches zero is not logarithmic.

    Raises:
        ValueError: for a name that is not free, an empty range, or a start outside its range.
    """
    names = [parameter.name for parameter in free]
    for name in (*ranges, *start):
        if name not in names:
            raise ValueError(f"ranges and starts must be of free parameters, {', '.join(names)}, but got {name}")
    parameters = []
    for parameter in free:
        low, high = ranges.get(parameter.name, (parameter.low, parameter.high))
        at = finite(f"the start of {parameter.name}", start.get(parameter.name, parameter.start))
        if not low < high:
            raise ValueError(
                f"the range of {parameter.name} must be from low to high, but got {low:g} and {high:g}"
            )
        if not low <= at <= high:
            raise ValueError(f"the start of {parameter.name} must be within {low:g} and {high:g}, but got {at:g}")
        parameters.append(
            replace(
                parameter,
                low=low,
                high=high,
                log=low > 0 and (parameter.log or parameter.name in ranges),
                default=at,
            )
        )
    return tuple(parameters)


def _numbers_of(function: Callable) -> dict[str, float]:
    """The arguments of a function that have a number for a default."""
    arguments = inspect.signature(function).parameters.values()
    return {
        argument.name: float(argument.default)
        for argument in arguments
        if isinstance(argument.default, (int, float)) and not isinstance(argument.default, bool)
    }


# Parameters that a model's functions hold in their closures, as constants: then derivatives along them are exact.


@dataclasses.dataclass(frozen=True)
class WithConstants:
    """A function whose numbers at some places are the last of its constants.

    Attributes:
        function: of x, perhaps u, and constants c, whose other numbers are kept.
        places: of the numbers, in the order of `captured_numbers`.
        first: index of the first of them among the constants.
        form: of the function's own constants, their class, or None for a plain tuple.
        own: number of these.
    """

    function: Callable
    places: tuple[int, ...]
    first: int
    form: type | None
    own: int

    @property
    def __signature__(self) -> inspect.Signature:
        """The function's own: h may take the input."""
        return inspect.signature(self.function)

    def __call__(self, *arguments):
        """What the function returns; constants may be Numbers."""
        *variables, constants = arguments
        numbers: list[Any] = list(captured_numbers(self.function))
        for i, index in enumerate(self.places):
            numbers[index] = constants[self.first + i]
        function = with_numbers(self.function, numbers)
        if any(isinstance(constant, Number) for constant in constants):
            function = traced(function)
        own_constants = tuple(constants[i] for i in range(self.own))
        return function(*variables, own_constants if self.form is None else self.form(*own_constants))


class CapturedConstants(NamedTuple):
    """What models of a factory share, and where the numbers are in which their functions differ."""

    functions: dict[str, Callable | None]  # of one of the models
    places: dict[str, tuple[int, ...]]  # of its numbers, by function

    @classmethod
    def of(cls, models: Sequence[StateSpaceModel]) -> CapturedConstants | None:
        """Those of some models; None if functions are equal, differ in more, or cannot be traced."""
        functions = _functions_of(models[0])
        indices: dict[str, set[int]] = {name: set() for name in FUNCTIONS}
        for model in models[1:]:
            for name, function in _functions_of(model).items():
                numbers = _pairs_of_numbers(functions[name], function)
                if numbers is None:
                    return None
                indices[name] |= {i for i, (a, b) in enumerate(numbers) if a != b}
        captured = cls(functions, {name: tuple(sorted(differing)) for name, differing in indices.items()})
        if not any(captured.places.values()):
            return None
        try:
            lifted = captured.with_constants(models[0])
            traced_model(lifted.functions, lifted.shape)
        except Exception:  # whatever a user's function raises of numbers that it does not know
            return None
        return captured

    def with_constants(self, model: StateSpaceModel) -> StateSpaceModel:
        """The model with the numbers in which functions differ behind its constants.

        Raises:
            ValueError: for a model that differs from the others in more than these.
        """
        if isinstance(model, AnyStepModel):
            return in_any_steps(self.with_constants(model.plain))
        form, count = type(model.constants) if hasattr(model.constants, "_fields") else None, len(model.constants)
        constants, changes = list(model.constants), {}
        for name, function in _functions_of(model).items():
            first, numbers = self.functions[name], _pairs_of_numbers(self.functions[name], function)
            moving = self.places[name]
            if numbers is None or any(a != b for i, (a, b) in enumerate(numbers) if i not in moving):
                raise ValueError(
                    f"{name} must differ between values of parameters in the same numbers everywhere, but holds "
                    "others: pass the parameters to it as constants"
                )
            if first is not None:
                changes[name] = WithConstants(first, moving, len(constants), form, count)
                constants += [numbers[i][1] for i in moving]
        names = getattr(model.constants, "_fields", None)
        values = tuple(constants) if names is None else _form(form, len(constants) - count)(*constants)
        return model.replace(**changes, constants=values)


@functools.lru_cache(maxsize=64)
def _form(form: Any, count: int) -> Any:
    """A class of constants with some more fields."""
    names = [*form._fields, *(f"captured_{i + 1}" for i in range(count))]
    return NamedTuple(form.__name__, [(name, float) for name in names])


def _functions_of(model: StateSpaceModel) -> dict[str, Callable | None]:
    plain = model.plain if isinstance(model, AnyStepModel) else model
    calls = {name: bound_call(getattr(plain, name)) for name in FUNCTIONS}
    return {
        name: None if function is not None and by_complex_step(function) else function
        for name, function in calls.items()
    }


def _pairs_of_numbers(first: Callable | None, other: Callable | None) -> list[tuple[float, float]] | None:
    """The numbers of two functions, in pairs; None if these differ in more."""
    if first is None or other is None:
        return [] if first is other else None
    if not differ_in_numbers_alone(first, other):
        return None
    return list(zip(captured_numbers(first), captured_numbers(other), strict=True))
