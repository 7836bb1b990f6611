"""`ParametricModel`: a model and its slopes as functions of the coordinates (p,) of its parameters.

A factory may write `lambda x, u, c: (gain * u[0],)`, of which each gain is another function, with machine code of
its own. Here the numbers that differ follow the model's constants, and there is one function for all.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from filters.sensitivity import ModelSlopes
from thruster_env.core.derivatives import by_complex_step
from thruster_env.core.equal_functions import bound_call, captured_numbers, differ_in_numbers_alone, with_numbers
from thruster_env.graphs.graphs import Number
from thruster_env.graphs.tracing import traced
from thruster_env.logs.log import AnyStepModel, in_any_steps
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.traced import traced_model
from tuning.problems.problem import Coordinates

STEP = 1e-4  # of differences of the model, in coordinates
FUNCTIONS = "transition", "observe", "transition_jacobian", "observe_jacobian"


def same_functions(first: StateSpaceModel, other: StateSpaceModel) -> bool:
    """Whether models differ in numbers alone, for which there are slopes."""
    return (first.functions, first.any_shape, first.substeps) == (other.functions, other.any_shape, other.substeps)


class ParametricModel:
    """A model as a function of coordinates, with slopes by central differences of all its numbers.

    Args:
        make: the model for values of the parameters by name.
        coordinates: of the parameters.
        finish: what a filter runs on instead of a model, at coordinates: with other noise, or an affine form.
        lifts: whether numbers that functions hold in their closures become constants, so that slopes along them
            are known, too.

    Attributes:
        rough: indices of the parameters that change functions of the model, along which there are no slopes.

    Raises:
        ValueError: if functions of a model read what the factory changes for the next one.
    """

    def __init__(
        self,
        make: Callable[..., StateSpaceModel],
        coordinates: Coordinates,
        finish: Callable[[StateSpaceModel, np.ndarray], StateSpaceModel] = lambda model, at: model,
        *,
        lifts: bool = True,
    ):
        """Find the parameters that change functions."""
        self._make, self._coordinates, self._finish = make, coordinates, finish
        self._captured: CapturedConstants | None = None
        start = coordinates.start()
        self._check_factory(start)
        self.rough = self._changing_functions(start)
        if self.rough and lifts:
            self._captured = CapturedConstants.of(self._models_about(start))
            self.rough = self._changing_functions(start)

    def at(self, at: np.ndarray) -> StateSpaceModel:
        """The model at coordinates (p,)."""
        plain = self._made(at)
        return self._finish(plain if self._captured is None else self._captured.with_constants(plain), at)

    def slopes(self, at: np.ndarray, indices: Sequence[int]) -> ModelSlopes:
        """The derivatives of the model's numbers by some of the coordinates."""
        pairs = [self.pair(at, index) for index in indices]
        return ModelSlopes.between(pairs, 2 * STEP) if pairs else ModelSlopes.of(self.at(at), 0)

    def pair(self, at: np.ndarray, index: int) -> tuple[StateSpaceModel, StateSpaceModel]:
        """Models one step above and below."""
        above, below = self._coordinates.neighbours(at, index, STEP)
        return self.at(above), self.at(below)

    def _made(self, at: np.ndarray) -> StateSpaceModel:
        return self._make(**self._coordinates.named(at))

    def _changing_functions(self, at: np.ndarray) -> tuple[int, ...]:
        return tuple(j for j in range(len(at)) if not same_functions(*self.pair(at, j)))

    def _check_factory(self, at: np.ndarray) -> None:
        for j, name in enumerate(self._coordinates.names):
            first, second = self._coordinates.neighbours(at, j, STEP)
            model = self._made(first)
            functions = model.functions
            self._made(second)
            if model.functions != functions:
                raise ValueError(
                    f"functions of a model must not read values that its factory sets, but {name!r} changes those "
                    "of a model that was made before: pass it to them in `constants`, or write them in the factory"
                )

    def _models_about(self, at: np.ndarray) -> list[StateSpaceModel]:
        """Models in which all parameters differ: near a point, and elsewhere within the ranges."""
        low, high = self._coordinates.low, self._coordinates.high
        points = [point for j in range(len(at)) for point in self._coordinates.neighbours(at, j, STEP)]
        shares = np.mod(np.arange(1, 4)[:, None] * (np.sqrt(2.0) + np.arange(len(at))) / np.sqrt(5.0), 1.0)
        models = list(map(self._made, points))
        for share in shares:
            try:
                models.append(self._made(low + share * (high - low)))
            except Exception:  # a user's function need not have a model there
                continue
        return models


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
            traced_model(lifted.functions, lifted.any_shape)
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
