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


def is_trained(given) -> bool:
    """Whether something is the name of a file of `thruster train-estimator`."""
    return isinstance(given, str | Path) and str(given).endswith(TRAINED)


def is_foreign(given) -> bool:
    """Whether something stands for an estimator of another package, and is not the name of a filter."""
    return (
        is_trained(given)
        or is_code(given)
        or (not isinstance(given, str) and (is_estimator(given) or callable(given)))
    )


def label_of(given) -> str:
    """The label of a user's estimator: "module:object", its own name, that of its factory, or of its file."""
    if is_trained(given):
        return Path(given).stem
    if isinstance(given, str):
        return given
    for name in (getattr(given, "name", None), getattr(given, "__name__", None)):
        if isinstance(name, str) and name:
            return name
    return type(given).__name__


def is_filter_class(given) -> bool:
    """Whether something is a user's class of filters."""
    return isinstance(given, type) and issubclass(given, Filter)


def estimator_named(given) -> Any:
    """A user's estimator argument: what a trained one's file makes, the object of "module:object", or itself."""
    if is_trained(given):
        from filters.learned import read_estimator

        return read_estimator(given)
    return object_named(given, "estimator") if isinstance(given, str) else given


def as_filter(found: Any, label: str, model: StateSpaceModel, numbers: dict) -> Filter:
    """An estimator in the place of a filter.

    Args:
        found: an estimator; or a function, or class, of a model (and of `numbers`) that makes one, or a `Filter`.
        label: its name in tables, if it does not name itself.
        model: of states, inputs and measurements: what a function gets, and where names and angles come from.
        numbers: further arguments of the function.

    Raises:
        ValueError: if it neither is an estimator nor makes one.
    """
    if not is_estimator(found):
        found = _made(found, label, model, numbers)
    elif numbers:
        raise ValueError(
            f"numbers must come with a function that makes an estimator, but {label!r} is one already, and got "
            f"{', '.join(numbers)}"
        )
    return found if isinstance(found, Filter) else ForeignFilter(model=model, estimator=found, label=label)


def _made(make, label: str, model: StateSpaceModel, numbers: dict) -> Any:
    what = f"estimator {label!r}"
    if not callable(make):
        raise ValueError(f"{what} must be an estimator, or make one of a model, but it is {short_repr(make)}")
    try:
        found = make(model=model, **numbers) if is_filter_class(make) else make(model, **numbers)
    except Exception as error:
        wanted = ", ".join(["a model", *numbers])
        raise ValueError(f"{what} must be made of {wanted}, but raised {error_line(error)}") from error
    if not isinstance(found, Filter) and not is_estimator(found):
        raise ValueError(
            f"{what} must make an object with reset(key, z) and step(u, z), or run(keys, inputs, "
            f"measurements), but made {short_repr(found)}"
        )
    return found
