"""Estimators that a user gives: an object, what makes one for a model, "module:object", or a trained file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from filters.estimators.estimator import is_estimator
from filters.estimators.foreign import ForeignFilter
from filters.filter import Filter
from thruster_env.core.checks import short_repr
from thruster_env.core.modules import error_line, is_code, object_named
from thruster_env.model.state_space import StateSpaceModel

TRAINED = ".safetensors"  # the end of the name of a trained estimator's file


READER = "filters.learned:read_estimator"  # of trained estimators' files; it needs torch, and knows this package


def is_trained(argument) -> bool:
    """Whether something is the name of a file of `thruster train-estimator`."""
    return isinstance(argument, str | Path) and str(argument).endswith(TRAINED)


def is_foreign(argument) -> bool:
    """Whether something stands for an estimator of another package, and is not the name of a filter."""
    return (
        is_trained(argument)
        or is_code(argument)
        or (not isinstance(argument, str) and (is_estimator(argument) or callable(argument)))
    )


def label_of(argument) -> str:
    """The label of a user's estimator: "module:object", its own name, that of its factory, or of its file."""
    if is_trained(argument):
        return Path(argument).stem
    if isinstance(argument, str):
        return argument
    for name in (getattr(argument, "name", None), getattr(argument, "__name__", None)):
        if isinstance(name, str) and name:
            return name
    return type(argument).__name__


def is_filter_class(argument) -> bool:
    """Whether something is a user's class of filters."""
    return isinstance(argument, type) and issubclass(argument, Filter)


def estimator_named(argument) -> Any:
    """A user's estimator argument: what a trained one's file makes, the object of "module:object", or itself."""
    if is_trained(argument):
        return object_named(READER, "reader")(argument)
    return object_named(argument, "estimator") if isinstance(argument, str) else argument


def as_filter(estimator: Any, label: str, model: StateSpaceModel, numbers: dict) -> Filter:
    """An estimator in the place of a filter.

    Args:
        estimator: an estimator; or a function or class that makes one, or a `Filter`, from a model and `numbers`.
        label: its name in tables, if it does not name itself.
        model: passed to the function; it names states, inputs and measurements and says which are angles.
        numbers: further arguments of the function.

    Raises:
        ValueError: if it neither is an estimator nor makes one.
    """
    if not is_estimator(estimator):
        estimator = _made(estimator, label, model, numbers)
    elif numbers:
        rule = "numbers must come with a function that makes an estimator"
        raise ValueError(f"{rule}, but {label!r} is one already, and got {', '.join(numbers)}")
    if isinstance(estimator, Filter):
        return estimator
    return ForeignFilter(model=model, estimator=estimator, label=label)


def _made(make, label: str, model: StateSpaceModel, numbers: dict) -> Any:
    what = f"{'filter' if is_filter_class(make) else 'estimator'} {label!r}"
    if not callable(make):
        raise ValueError(f"{what} must be an estimator, or make one of a model, but it is {short_repr(make)}")
    try:
        result = make(model=model, **numbers) if is_filter_class(make) else make(model, **numbers)
    except Exception as error:
        wanted = ", ".join(["a model", *numbers])
        raise ValueError(f"{what} must be made of {wanted}, but raised {error_line(error)}") from error
    if not isinstance(result, Filter) and not is_estimator(result):
        rule = f"{what} must make an object with reset(key, z) and step(u, z), or run(keys, inputs, measurements)"
        raise ValueError(f"{rule}, but made {short_repr(result)}")
    return result
