"""Any model as a function of its named parameters: arguments of a function, constants, Q and R."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np

from thruster_env.core.checks import short_repr
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import error_quantities
from tuning.problems.problem import Parameter, squared
from tuning.search.parameters import r_name

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
        errors = error_quantities(self.base.states, self.base.turns)
        units = [quantity.unit for quantity in (*errors, *self.base.measurements)]
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
