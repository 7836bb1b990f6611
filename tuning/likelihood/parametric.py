"""Models as functions of parameters: `ParametricModel` with slopes, `ModelFamily` by name, `Family` of runs.

A factory may write `lambda x, u, c: (gain * u[0],)`, of which each gain is another function, with machine code of
its own. Here the numbers that differ follow the model's constants, and there is one function for all.
"""

from __future__ import annotations

import dataclasses
import functools
import inspect
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from filters.estimators.foreign import is_foreign
from filters.filter import Filter
from filters.registry import filter_type, make_filter
from filters.sensitivity import KINDS, ModelSlopes, has_derivatives
from thruster_env.core.checks import one_of, short_repr
from thruster_env.core.derivatives import by_complex_step
from thruster_env.core.equal_functions import bound_call, captured_numbers, differ_in_numbers_alone, with_numbers
from thruster_env.graphs.graphs import Number
from thruster_env.graphs.tracing import traced
from thruster_env.logs.log import AnyStepModel, in_any_steps
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.traced import traced_model
from thruster_env.model.turns import innovations_of, tangent_of
from tuning.likelihood.objective import Part
from tuning.problems.data import Data
from tuning.problems.problem import STEP, Coordinates, Parameter, Problem, squared
from tuning.search.parameters import (
    CORRELATIONS,
    Correlation,
    MeasurementVariance,
    ProcessVariance,
    Q,
    R,
    correlation_slopes,
    correlations_of,
    full_covariance,
    obeying,
    r_name,
)
from tuning.search.space import Choice, neutral

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
        above, below = self._coordinates.neighbours(at, index)
        return self.at(above), self.at(below)

    def _made(self, at: np.ndarray) -> StateSpaceModel:
        return self._make(**self._coordinates.named(at))

    def _changing_functions(self, at: np.ndarray) -> tuple[int, ...]:
        return tuple(j for j in range(len(at)) if not same_functions(*self.pair(at, j)))

    def _check_factory(self, at: np.ndarray) -> None:
        for j, name in enumerate(self._coordinates.names):
            first, second = self._coordinates.neighbours(at, j)
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
        points = [point for j in range(len(at)) for point in self._coordinates.neighbours(at, j)]
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


FACTOR = 10.0  # range of a positive parameter about its start
NOISE_FACTOR = 1e4  # range of a variance about its start


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
            way = ": a sensor's lag is a state of the model" if wrong[0].startswith("lag_") else ""
            raise ValueError(f"free parameters must be of {', '.join(known)}, but got {short_repr(wrong[0])}{way}")
        self.free = tuple(known[name] for name in names)

    @property
    def known(self) -> dict[str, Parameter]:
        """Every parameter that may be free, with its range about its start."""
        starts = dict(self._arguments) | {name: getattr(self.base.constants, name) for name in self._fields}
        parameters = {name: about(name, float(value)) for name, value in starts.items()}
        units = [quantity.unit for quantity in (*tangent_of(self.base), *innovations_of(self.base))]
        for name, (_, index, variance) in self._noise.items():
            unit = units[index + (0 if name.startswith("Q") else self.base.t)]
            parameters.setdefault(name, variance_about(name, variance, unit))
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


def variance_about(name: str, variance: float, unit: str) -> Parameter:
    """A positive variance of a quantity in this unit, within a range about its start."""
    ends = variance / NOISE_FACTOR, variance * NOISE_FACTOR
    return Parameter(name, *ends, squared(unit), default=variance)


def _numbers_of(function: Callable) -> dict[str, float]:
    """The arguments of a function that have a number for a default."""
    arguments = inspect.signature(function).parameters.values()
    return {
        argument.name: float(argument.default)
        for argument in arguments
        if isinstance(argument.default, (int, float)) and not isinstance(argument.default, bool)
    }


class TunedCovariance:
    """A covariance (n, n), of which some variances and correlations are tuned.

    Where no correlation is tuned, a variance scales its row and column: C = D C_0 D, with D the roots of what the
    variances have grown by. Else C is the `full_covariance` of both.

    Args:
        base: the covariance before.
        name: of the covariance, as places of correlations have it.
        variance: the kind of places that its variances are.
        settings: for each of p parameters the places that it sets, and by which factors.
    """

    def __init__(
        self,
        base: np.ndarray,
        name: str,
        variance: type[ProcessVariance | MeasurementVariance],
        settings: Sequence[Sequence[tuple[Any, float]]],
    ):
        """Find the parameters of this covariance."""
        self._base, self._count = base, len(settings)
        all_places: list[tuple[int, Any, float]] = [
            (i, position, factor) for i, positions in enumerate(settings) for position, factor in positions
        ]
        self._variances = [
            (i, position.index, by) for i, position, by in all_places if isinstance(position, variance)
        ]
        self._correlations = [
            (i, position.index, by)
            for i, position, by in all_places
            if isinstance(position, Correlation) and position.covariance == name
        ]

    def at(self, values: np.ndarray, units: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The covariance and its derivatives (p, n, n) by coordinates, for values and units of all parameters."""
        n = len(self._base)
        variances = np.diag(self._base).copy()
        for i, at, factor in self._variances:
            variances[at] = factor * values[i]
        slopes = np.zeros((self._count, n, n))
        if self._correlations:
            correlations = np.clip(correlations_of(self._base), *CORRELATIONS)
            for i, k, factor in self._correlations:
                correlations[k] = factor * values[i]
            cov = full_covariance(variances.tolist(), correlations.tolist())
            by_correlations = correlation_slopes(variances.tolist(), correlations.tolist())
            for i, k, factor in self._correlations:
                slopes[i] += factor * units[i] * by_correlations[k]
        else:
            grown = np.sqrt(variances / np.where(np.diag(self._base) > 0, np.diag(self._base), 1.0))
            cov = self._base * np.outer(grown, grown)
            cov[range(n), range(n)] = variances
        for i, at, _ in self._variances:  # of logarithms, to which factors do nothing
            slopes[i, at] += 0.5 * cov[at]
            slopes[i, :, at] += 0.5 * cov[at]
        return cov, slopes


DIFFERENTIABLE = tuple(kind.name for kind in KINDS)  # filters, and those of users that `has_gradient` knows


def has_gradient(name: str) -> bool:
    """Whether a filter, or a user's by "module:class", has exact gradients."""
    return name in DIFFERENTIABLE or (is_foreign(name) and has_derivatives(filter_type(name).filter_class))


def check_gradient(name: str, what: str = "filter") -> None:
    """Raise ValueError for a filter without exact gradients."""
    if not has_gradient(name):
        one_of(what, name, DIFFERENTIABLE)


class Family(Part):
    """Runs of a problem, and the models that its filter assumes, by the coordinates (p,) of parameters.

    Args:
        choice: of one of the `DIFFERENTIABLE` filters; its other parameters are held.
        problem: makes the models.
        parameters: the p parameters.
        data: the runs.

    Raises:
        ValueError: if a parameter is a whole number, or changes functions of the model and not its numbers alone.
    """

    def __init__(self, choice: Choice, problem: Problem, parameters: Sequence[Parameter], data: Data):
        """Find out whether all parameters are of Q and R, of which derivatives are known."""
        self.data, self.leads_in, self.scale = data, problem.leads_in, problem.scale
        self.coordinates, self._choice, self._problem = Coordinates(parameters), choice, problem
        values = [(parameter.get(choice), neutral(parameter.name)) for parameter in parameters]
        self.untuned = np.array([other if value is None else value for value, other in values], dtype=np.float64)
        if any(parameter.tied or parameter.held for parameter in parameters):
            self._choice = choice = obeying(choice, parameters)
        self.used = make_filter(choice.name, self.model_of(choice), **choice.numbers)
        self._base, self._noise = self.used.model, None
        self.states, self.turns = self._base.n, self._base.turns
        settings = [((parameter.place, 1.0), *parameter.tied) for parameter in parameters]  # by each parameter
        kinds = ProcessVariance, MeasurementVariance, Correlation
        if all(isinstance(position, kinds) for positions in settings for position, _ in positions):
            q = TunedCovariance(self._base.process_noise_cov, Q, ProcessVariance, settings)
            self._noise = q, TunedCovariance(self._base.measurement_noise_cov, R, MeasurementVariance, settings)
            return
        self._models = ParametricModel(self._made, self.coordinates, lifts=False)
        if self._models.rough:
            name = self.coordinates.names[self._models.rough[0]]
            raise ValueError(
                "parameters of a gradient must change numbers of the model alone, "
                f"but {name} changes its functions"
            )

    def at(self, point: np.ndarray, indices: Sequence[int] | None = None) -> tuple[StateSpaceModel, ModelSlopes]:
        """The model at coordinates, and its derivatives by them: exact of Q and R, else central differences."""
        chosen = list(range(len(point)) if indices is None else indices)
        if self._noise is not None:
            values, units = self.coordinates.values(point), self.coordinates.units
            (q, by_q), (r, by_r) = (noise.at(values, units) for noise in self._noise)
            model = self._base.replace(process_noise_cov=q, measurement_noise_cov=r)
            moves = {"process_noise_cov": by_q[chosen], "measurement_noise_cov": by_r[chosen]}
            return model, ModelSlopes.of(model, len(chosen), **moves)
        return self._models.at(point), self._models.slopes(point, chosen)

    def choice_at(self, point: np.ndarray) -> Choice:
        """The choice at coordinates."""
        return self._with(self.coordinates.values(point).tolist())

    def _made(self, **values: float) -> StateSpaceModel:
        return self.model_of(self._with(values.values()))

    def _with(self, values: Iterable[float]) -> Choice:
        choice = self._choice
        for parameter, value in zip(self.coordinates.free, values, strict=True):
            choice = parameter.set(choice, value)
        return choice

    def filter_at(self, point: np.ndarray) -> Filter:
        """The filter at coordinates."""
        return self.choice_at(point).filter(self._problem)

    def model_of(self, choice: Choice) -> StateSpaceModel:
        """The model of a choice, as the filter runs on it."""
        model = self._problem.started_for(choice.name, self._problem.model(**choice.model))
        return make_filter(choice.name, model).kernel_model
