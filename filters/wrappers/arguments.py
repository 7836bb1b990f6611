"""From a wrapper's plain arguments to a filter and the model that it assumes."""

from __future__ import annotations

from collections.abc import Mapping
from os import PathLike, fspath

import gymnasium as gym
import numpy as np

from filters.estimators.find import is_foreign
from filters.filter import Filter
from filters.registry import filter_type
from filters.wrappers.models import made, maker_of
from filters.wrappers.tuned import tuned_filter
from thruster_env.core.checks import short_repr
from thruster_env.model.state_space import StateSpaceModel

OBSERVATIONS = ("estimate", "measurement+estimate", "belief")
APPENDED = "appended_entries"  # attribute of an env: entries of its observation after the measurement


def given_filter(filter, tuned) -> tuple:
    """The arguments `filter` and `tuned` as a wrapper keeps them; a study becomes its filter.

    Raises ValueError if either does not have the type that the wrapper documents, or both are given.
    """
    if isinstance(tuned, PathLike):
        tuned = fspath(tuned)
    if tuned is not None and not isinstance(tuned, str):
        offered = getattr(tuned, "filter", None)
        if not isinstance(offered, Filter):
            rule = "tuned must be the path of a tuned file, or what tuning.tune returns"
            raise ValueError(f"{rule} (pass a filter object as filter=...), but got {short_repr(tuned)}")
        if filter is not None:
            raise ValueError(f"tuned must come without filter: it has its own, but got {short_repr(filter)}")
        filter, tuned = offered, None
    if not (filter is None or isinstance(filter, str | Filter) or is_foreign(filter)):
        rule = "filter must be a name, a filter that is made (as study.filter) or an estimator"
        raise ValueError(f"{rule}; a study is tuned=study; but got {short_repr(filter)}")
    return filter, tuned


def filter_for(env, filter, model, tuned: str | None, model_arguments, numbers: dict) -> Filter:
    """The filter for a wrapper around env; the wrapper's class documents the arguments.

    A tuned file is data: nothing in it becomes a model or another argument of the wrapper.

    Raises ValueError if an argument is unknown or wrong.
    """
    if tuned is not None:
        if filter is not None or numbers or model_arguments is not None:
            raise ValueError("tuned must come without filter, numbers and model_arguments: its file holds them")
        return tuned_filter(env, model, tuned)
    if isinstance(filter, Filter):
        if model is not None or model_arguments is not None or numbers:
            rule = "a filter that is made must come without model, model_arguments and numbers: it has its own"
            raise ValueError(f"{rule}, but got {short_repr(filter)} with some")
        return filter
    filter = "ekf" if filter is None else filter
    kind = filter_type(filter)
    for name in numbers:
        if name not in kind.numbers and not kind.is_foreign:
            rule = f"a number of filter {filter!r} must be one of {', '.join(kind.numbers) or 'none'}"
            raise ValueError(f"{rule} (arguments of the model go into model_arguments), but got {name!r}")
    arguments = {} if model_arguments is None else model_arguments
    if not isinstance(arguments, Mapping):
        raise ValueError(f"model_arguments must be a mapping, but got {short_repr(arguments)}")
    return kind.make(model_for(env, model, arguments), **numbers)


def model_for(env, model: str | StateSpaceModel | None, arguments: Mapping) -> StateSpaceModel:
    """The given model, one made by "module:factory", or the env's own; see `EstimateState`."""
    what, make = maker_of(env, model)
    if not isinstance(make, StateSpaceModel):
        return made(what, make, arguments)
    if arguments:
        raise ValueError(f"a StateSpaceModel must come without arguments of its own, but got {arguments!r}")
    return make


class ModelInSpec:
    """A model as an env's spec stores it. JSON refuses it with its class's name, which says what to do."""

    def __init__(self, content):
        self.content = content


class EstimatorInSpec(ModelInSpec):
    """A filter object, or an estimator, as an env's spec stores it, likewise."""


EstimatorInSpec.__name__ = "Filter or Estimator (give its name or 'module:object' instead)"
ModelInSpec.__name__ = "StateSpaceModel (give model='module:factory' instead)"


def check_spaces(
    action_space: gym.Space, observation_space: gym.Space, model: StateSpaceModel, measured_inputs: int = 0
) -> gym.spaces.Box:
    """Return the action space; raise ValueError unless both spaces are Box, and actions fit the model.

    Actions are the model's inputs without the last `measured_inputs`.
    """
    actions, size = _box("action", action_space), model.inputs - measured_inputs
    if int(np.prod(actions.shape)) != size:
        raise ValueError(f"the action space must have the model's {size} entries, but got {actions}")
    _box("observation", observation_space)
    return actions


def _box(name: str, space: gym.Space) -> gym.spaces.Box:
    if not isinstance(space, gym.spaces.Box):
        raise ValueError(f"the {name} space must be a Box, but got {space}")
    return space
