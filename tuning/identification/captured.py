"""Parameters that a model's functions hold in their closures, as constants: then derivatives along them are exact.

A factory may write `lambda x, u, c: (gain * u[0],)`, of which each gain is another function, with machine code of
its own. Here the numbers that differ follow the model's constants, and there is one function for all.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from filters.pages.traced import traced_model
from thruster_env.core.derivatives import by_complex_step
from thruster_env.core.equal_functions import bound_call, captured_numbers, differ_in_numbers_alone, with_numbers
from thruster_env.graphs.graphs import Number
from thruster_env.graphs.tracing import traced
from thruster_env.logs.steps import AnyStepModel, in_any_steps
from thruster_env.model.state_space import StateSpaceModel

FUNCTIONS = "transition", "observe", "transition_jacobian", "observe_jacobian"


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

    def __call__(self, *arguments):
        """What the function returns; constants may be Numbers."""
        *given, constants = arguments
        numbers: list[Any] = list(captured_numbers(self.function))
        for i, place in enumerate(self.places):
            numbers[place] = constants[self.first + i]
        function = with_numbers(self.function, numbers)
        if any(isinstance(one, Number) for one in constants):
            function = traced(function)
        own = tuple(constants[i] for i in range(self.own))
        return function(*given, own if self.form is None else self.form(*own))


class CapturedConstants(NamedTuple):
    """What models of a factory share, and where the numbers are in which their functions differ."""

    functions: dict[str, Callable | None]  # of one of the models
    places: dict[str, tuple[int, ...]]  # of its numbers, by function

    @classmethod
    def of(cls, models: Sequence[StateSpaceModel]) -> CapturedConstants | None:
        """Those of some models; None if functions are equal, differ in more, or cannot be traced."""
        functions = _functions_of(models[0])
        places: dict[str, set[int]] = {name: set() for name in FUNCTIONS}
        for model in models[1:]:
            for name, function in _functions_of(model).items():
                numbers = _pairs_of_numbers(functions[name], function)
                if numbers is None:
                    return None
                places[name] |= {i for i, (a, b) in enumerate(numbers) if a != b}
        found = cls(functions, {name: tuple(sorted(some)) for name, some in places.items()})
        if not any(found.places.values()):
            return None
        try:
            lifted = found.with_constants(models[0])
            traced_model(lifted.functions, lifted.shape)
        except Exception:  # whatever a user's function raises of numbers that it does not know
            return None
        return found

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
        given = tuple(constants) if names is None else _form(form, len(constants) - count)(*constants)
        return model.replace(**changes, constants=given)


@functools.lru_cache(maxsize=64)
def _form(form: Any, count: int) -> Any:
    """A class of constants with some more fields."""
    names = [*form._fields, *(f"captured_{i + 1}" for i in range(count))]
    return NamedTuple(form.__name__, [(name, float) for name in names])


def _functions_of(model: StateSpaceModel) -> dict[str, Callable | None]:
    plain = model.plain if isinstance(model, AnyStepModel) else model
    found = {name: bound_call(getattr(plain, name)) for name in FUNCTIONS}
    return {name: None if one is not None and by_complex_step(one) else one for name, one in found.items()}


def _pairs_of_numbers(one: Callable | None, other: Callable | None) -> list[tuple[float, float]] | None:
    """The numbers of two functions, in pairs; None if these differ in more."""
    if one is None or other is None:
        return [] if one is other else None
    if not differ_in_numbers_alone(one, other):
        return None
    return list(zip(captured_numbers(one), captured_numbers(other), strict=True))
