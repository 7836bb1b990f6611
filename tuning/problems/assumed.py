"""What problems of any plant share: the model that filters assume, the rule of thumb, and the parameters."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from inspect import signature
from math import isfinite
from types import MappingProxyType
from typing import Any

import numpy as np

from filters.tuned_file import NOISE, PRIOR
from thruster_env.core.angles import on_one_branch
from thruster_env.core.checks import at_least, positive, short_repr
from thruster_env.core.modules import error_line
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.check import check_data
from tuning.problems.data import FIRST_SCORED_STEP, Data, checked_first_scored_step
from tuning.problems.parameter import Parameter
from tuning.problems.problem import GIVEN, SPREAD, Problem

RANGE_SEEDS = range(8)  # seeds whose runs determine each state's range, unless the model has it
RANGE_FRACTION = 0.01  # standard deviation of the rule of thumb's Q, as a fraction of each state's range
MOST_STEPS = 1_000_000


class AssumedProblem(Problem):
    """A problem whose filters assume a `StateSpaceModel`, or a function of parameters that returns one.

    Args:
        assumed: the model, or a function that makes it; its keyword arguments are the names of `parameters`.
        steps: length K of a run.
        first_scored_step: the first step whose error is scored; below 50 the start-up is scored, too, and a study
            then tunes the scale of P_0.
        scale: by which the score divides the error of each state; computed from the truth if None.
        parameters: parameters of the model that a study tunes, in place of the variances of Q and R.
        untuned: arguments of the model before any tuning; by rule of thumb if None.
        true: arguments of the oracle's model, with the plant's own Q and R, if they are known.
        dt: sample time [s], if there is one; covariances are per step and do not scale with it.
        name: its name in messages; replaced by the name under which it is found.
        about: one line for tables.

    Raises:
        ValueError: states the rule and the value.
    """

    def __init__(
        self,
        assumed: StateSpaceModel | Callable[..., StateSpaceModel],
        *,
        steps: int,
        first_scored_step: int,
        scale: Sequence[float] | None,
        parameters: Sequence[Parameter] | None,
        untuned: Mapping | None,
        true: Mapping | None,
        dt: float | None,
        name: str,
        about: str,
    ):
        """Check the arguments; see the class."""
        self.name, self.about = name, about
        self.steps = at_least("steps", steps, 2, MOST_STEPS)
        self.first_scored_step = checked_first_scored_step(first_scored_step, self.steps)
        self._assumed, self._scale = assumed, None if scale is None else tuple(map(float, scale))
        self._untuned, self._true = _mapping("untuned", untuned), _mapping("true", true)
        self._parameters = with_defaults(_checked_parameters(parameters), assumed, self._untuned or {})
        self._dt = None if dt is None else positive("dt", dt)
        if self._parameters is not None and isinstance(assumed, StateSpaceModel):
            raise ValueError(f"a model with parameters must be a function of them, but got {short_repr(assumed)}")
        self.model()

    @abstractmethod
    def make(self, seeds: tuple[int, ...]) -> Data:
        """The data of some seeds, before they are checked."""

    @abstractmethod
    def found_scale(self) -> np.ndarray:
        """The scale where none is given."""

    @property
    def found_scale_about(self) -> str:
        """A description of that scale."""
        return SPREAD

    @property
    def scale_about(self) -> str:
        """A description of the scale."""
        return GIVEN if self._scale is not None else self.found_scale_about

    def model(self, **changes) -> StateSpaceModel:
        """The assumed model with some changes; see `Problem.model`."""
        noise: dict[str, Any] = {key: changes.pop(key) for key in (*NOISE, PRIOR) if key in changes}
        arguments = {parameter.name: parameter.start for parameter in self._parameters or ()} | changes
        if not isinstance(self._assumed, StateSpaceModel):
            model = self._made(self._assumed, arguments)
        elif not arguments:
            model = self._assumed
        else:
            raise ValueError(
                f"arguments of the model of problem {self.name} must be among {', '.join((*NOISE, PRIOR))}, "
                f"but got {', '.join(arguments)}"
            )
        factor = noise.pop(PRIOR, None)
        if factor is not None:
            noise["prior_cov"] = positive(PRIOR, factor) * model.prior_cov
        return model.replace(**noise) if noise else model

    def data(self, seeds: Sequence[int]) -> Data:
        """Inputs, measurements and, where it is known, truth for seeds."""
        return _data(self, tuple(int(seed) for seed in seeds))

    @cached_property  # computed at first use, for it may take many runs
    def scale(self) -> tuple[float, ...] | None:  # type: ignore[override]  # an attribute, as in other problems
        """By which the score divides the error of each state, as given or computed; None without truth."""
        if self._scale is not None:
            return self._scale
        return None if self.data(self.range_seeds).states is None else tuple(self.found_scale().tolist())

    @property
    def parameters(self) -> tuple[Parameter, ...] | None:
        """Parameters of the model that a study tunes; None for the variances of Q and R."""
        return self._parameters

    @property
    def untuned(self) -> dict:
        """Arguments of the model before any tuning: as given, the parameters' defaults, or by rule of thumb."""
        if self._parameters is not None:
            return {parameter.name: parameter.start for parameter in self._parameters} | (self._untuned or {})
        return self._thumb | (self._untuned or {})

    @cached_property
    def given(self) -> dict | None:
        """The given values of the model: its own Q and R, or the defaults of its parameters, and `untuned`.

        None for parameters without a default.
        """
        if self._parameters is not None:
            defaults = {
                parameter.name: parameter.default
                for parameter in self._parameters
                if parameter.default is not None
            }
            values = defaults | (self._untuned or {})
            return values if len(defaults) == len(self._parameters) else None
        model = self.model()
        q, r = rows_argument(model.process_noise_cov), as_argument(model.measurement_noise_cov)
        return {"process_noise_cov": q, "measurement_noise_cov": r} | (self._untuned or {})

    @property
    def lacks_ranges(self) -> bool:
        """Whether the Q of `untuned` is the model's own, because nothing gives a range of states."""
        if self._parameters is not None or "process_noise_cov" in (self._untuned or {}):
            return False
        model = self.model()
        has_limits = model.state_low is not None and model.state_high is not None
        return not has_limits and self.data(self.range_seeds).states is None

    @property
    def true(self) -> dict | None:
        """Arguments of the oracle's model, with the plant's own Q and R; None if they are unknown."""
        return self._true

    @property
    def range_seeds(self) -> range:
        """Seeds whose runs determine each state's range."""
        return RANGE_SEEDS

    @property
    def counts_start_up(self) -> bool:
        """Whether the first steps are scored, on which P_0 has an effect."""
        return self.first_scored_step < FIRST_SCORED_STEP and bool(self.model().prior_cov.any())

    @property
    def dt(self) -> float | None:
        """Sample time [s]."""
        return self._dt

    @property
    def assumptions(self) -> tuple:
        """All arguments but those that the data come from, for the digest."""
        of_runs = self.steps, self.first_scored_step, self._scale, self._dt
        return self._assumed, self._parameters, self._untuned, self._true, *of_runs

    @cached_property
    def _thumb(self) -> dict:
        """R of the assumed model (from the data sheet), and Q = diag((1 % of each state's range)^2)."""
        model = self.model()
        deviations = np.sqrt(np.diag(model.process_noise_cov))
        if model.state_low is not None and model.state_high is not None:
            deviations = RANGE_FRACTION * (model.state_high - model.state_low)
        elif (data := self.data(self.range_seeds)).states is not None:
            states = data.counted_rows(data.states)
            deviations[: states.shape[-1]] = RANGE_FRACTION * np.ptp(rows_of(states, model), axis=0)
        variances = tuple(float(v) for v in deviations**2)
        return {"process_noise_cov": variances, "measurement_noise_cov": as_argument(model.measurement_noise_cov)}

    def _made(self, make: Callable[..., StateSpaceModel], arguments: Mapping) -> StateSpaceModel:
        try:
            model = make(**arguments)
        except Exception as error:
            wanted = ", ".join(arguments) or "no arguments"
            raise ValueError(
                f"the model of problem {self.name} must be made of {wanted}, but raised {error_line(error)}"
            ) from error
        if not isinstance(model, StateSpaceModel):
            raise ValueError(
                f"the model of problem {self.name} must be a StateSpaceModel, but it is {short_repr(model)}"
            )
        return model


@lru_cache(maxsize=8)
def _data(problem: AssumedProblem, seeds: tuple[int, ...]) -> Data:
    data = problem.make(seeds)
    check_data(data, problem.model(), problem.name)
    return data.read_only()


def rows_of(states: np.ndarray, model: StateSpaceModel) -> np.ndarray:
    """True states of all runs and steps, one a row, angles on the branch of their circular mean."""
    rows = states.reshape(-1, states.shape[-1])
    return on_one_branch(rows, model.shape.state_angles[: rows.shape[1]])


def as_argument(cov: np.ndarray):
    """A covariance as a choice stores it: one variance, several, or the rows of a matrix."""
    if np.count_nonzero(cov - np.diag(np.diag(cov))):
        return tuple(map(tuple, cov.tolist()))
    variances = tuple(np.diag(cov).tolist())
    return variances[0] if len(variances) == 1 else variances


def rows_argument(cov: np.ndarray):
    """As `as_argument`, but a tuple for a single state, too, as a choice stores Q."""
    argument = as_argument(cov)
    return argument if isinstance(argument, tuple) else (argument,)


def _checked_parameters(parameters) -> tuple[Parameter, ...] | None:
    if parameters is None:
        return None
    checked = (
        tuple(parameters)
        if isinstance(parameters, Sequence) and not isinstance(parameters, str)
        else (parameters,)
    )
    if not checked or not all(isinstance(parameter, Parameter) for parameter in checked):
        raise ValueError(
            f"parameters must be some of tuning.problems.parameter.Parameter, but got {short_repr(parameters)}"
        )
    names = [parameter.name for parameter in checked]
    if len(set(names)) < len(names):
        raise ValueError(f"names of parameters must differ from one another, but got {', '.join(names)}")
    return checked


def with_defaults(
    parameters: tuple[Parameter, ...] | None, make: Any, untuned: Mapping
) -> tuple[Parameter, ...] | None:
    """Parameters with the given values as defaults: those in `untuned`, else those of the user's function.

    A parameter's own default is kept. A range is widened to hold the default.
    """
    if parameters is None:
        return None
    try:
        known = signature(make).parameters
    except (TypeError, ValueError):  # of a callable without one
        known = MappingProxyType({})
    completed = []
    for parameter in parameters:
        of_function = getattr(known.get(parameter.name), "default", None)
        value = untuned.get(parameter.name, parameter.default if parameter.default is not None else of_function)
        is_number = isinstance(value, int | float) and not isinstance(value, bool) and isfinite(value)
        if not is_number or (parameter.log and value <= 0):
            completed.append(parameter)
            continue
        value = round(value) if parameter.integer else value
        ends = {"low": min(parameter.low, value), "high": max(parameter.high, value)}
        completed.append(replace(parameter, default=value, **ends))
    return tuple(completed)


def _mapping(name: str, mapping) -> dict | None:
    if mapping is not None and not isinstance(mapping, Mapping):
        raise ValueError(f"{name} must map arguments of the model to values, but got {short_repr(mapping)}")
    return None if mapping is None else dict(mapping)
