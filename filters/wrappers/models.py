"""Where a wrapper's model comes from: the env, a factory that the caller names, or the caller."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium as gym

from thruster_env.core.checks import short_repr
from thruster_env.model.state_space import StateSpaceModel


def maker_of(env, model: str | StateSpaceModel | None) -> tuple[str, Callable | StateSpaceModel]:
    """A model's name in messages, and its source: the env, the "module:factory" named, or itself.

    Raises ValueError if there is none.
    """
    if model is None:
        make = offered(env, "state_space_model")
        if make is None:
            rule = "an env that offers no state_space_model must come with a model"
            raise ValueError(f"{rule}, but got {env} alone: pass model=...")
        return f"the model of {env.unwrapped}", make
    if isinstance(model, StateSpaceModel):
        return "the model", model
    module, _, name = str(model).partition(":")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError, ValueError):
        raise ValueError(
            f"model must be 'module:factory' that can be imported, or a StateSpaceModel, but got {model!r}"
        ) from None
    return f"model {model!r}", found


def offered(env, name: str) -> Any:
    """The attribute of an env, or of a wrapper around it; None if none has it."""
    if isinstance(env, gym.Env) and env.has_wrapper_attr(name):
        return env.get_wrapper_attr(name)
    return getattr(env.unwrapped, name, None)


def made(what: str, make: Callable, arguments: Mapping) -> StateSpaceModel:
    """The model made with some arguments; ValueError if there is none."""
    try:
        found = make(**arguments)
    except TypeError as error:
        raise ValueError(f"{what} must take the given arguments: {error}") from None
    if not isinstance(found, StateSpaceModel):
        raise ValueError(f"{what} must be a StateSpaceModel, but it is {short_repr(found)}")
    return found
