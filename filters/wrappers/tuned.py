"""The filter of a tuned file, with the model of the env or of the caller."""

from __future__ import annotations

import inspect
import warnings
from collections.abc import Callable, Mapping

from filters.augmented import Unknown, augmented_model
from filters.filter import Filter
from filters.registry import make_filter
from filters.tuned_file import AUGMENTED, FACTORS, NOISE, PRIOR, compared, read_tuned_file
from filters.tuned_model import check_same_model, check_same_quantities
from filters.wrappers.models import made, maker_of
from thruster_env.model.state_space import StateSpaceModel


def tuned_filter(env, model: str | StateSpaceModel | None, file: str) -> Filter:
    """Make the filter of a tuned file, for a model that takes the tuned Q, R and parameters.

    Names in the file are never imported: the model is the env's own, or given by the caller, and must be
    the file's. A file that contains its plant as data is compared with the env's plant, if no model is
    given, and by states, inputs and sensors; others by these, dt and the model's digest. Files older than version
    4 are compared only by the plant.

    Args:
        env: the wrapped env.
        model: as `EstimateState` takes it.
        file: the path.

    Raises:
        ValueError: with the differences, if the model is another one; or if the file is invalid.
    """
    content = read_tuned_file(file)
    plant, check = content.get("plant"), getattr(env.unwrapped, "check_tuned_for", None)
    if model is None and check is not None:
        with compared(content, file):
            check(plant, file)
    entry, tuned_for = content["filter"], content.get("model")
    dt = None if plant is not None else sample_time(env)
    factors = [f"{name} {value:g}" for name, value in entry["model"].get(FACTORS, {}).items() if value != 1.0]
    if factors:
        said = f"{file} was tuned on a model that is wrong on purpose: here, too, its filter assumes"
        warnings.warn(f"{said} {', '.join(factors)} times the plant's own", stacklevel=4)

    def fits(found: StateSpaceModel) -> None:
        if tuned_for is not None:
            with compared(content, file):
                check_same_quantities(tuned_for, found, dt, file)

    by_digest = tuned_for is not None and plant is None
    found = _with_numbers(*maker_of(env, model), entry["model"], fits, by_digest)
    if tuned_for is not None and by_digest:
        with compared(content, file):
            check_same_model(tuned_for, found, dt, file)
    return make_filter(entry["name"], found, **entry["numbers"])


def sample_time(env) -> float | None:
    """An env's `dt` [s], None if it has none."""
    dt = getattr(env.unwrapped, "dt", None)
    return float(dt) if isinstance(dt, float | int) and not isinstance(dt, bool) and dt > 0 else None


def _with_numbers(
    what: str,
    make: Callable | StateSpaceModel,
    numbers: Mapping,
    fits: Callable[[StateSpaceModel], None],
    by_digest: bool,
) -> StateSpaceModel:
    """A model with the numbers of a tuned file: Q and R, the factor on P_0, and what else the maker takes by name.

    Constants that the file has as states become states. Other parameters are left out only where the model's
    digest then shows whether that makes another model.
    """
    unknown = {name: Unknown.of_numbers(*one) for name, one in numbers.get(AUGMENTED, {}).items()}

    def augmented(found: StateSpaceModel) -> StateSpaceModel:
        return augmented_model(found, unknown) if unknown else found

    if isinstance(make, StateSpaceModel):
        found = augmented(make)
        fits(found)
        return _with_noise(found, numbers)
    own = {name: value for name, value in numbers.items() if name not in (*NOISE, PRIOR, AUGMENTED)}
    if by_digest:
        own = {name: value for name, value in own.items() if name in _arguments_of(make)}
    plain = augmented(made(what, make, own))
    fits(plain)  # before Q and R of other sizes are
    return _with_noise(plain, numbers) if by_digest or unknown else made(what, make, numbers)


def _with_noise(model: StateSpaceModel, numbers: Mapping) -> StateSpaceModel:
    changes = {name: numbers[name] for name in NOISE}
    if PRIOR in numbers:
        changes["prior_cov"] = numbers[PRIOR] * model.prior_cov
    return model.replace(**changes)


def _arguments_of(make: Callable) -> set[str]:
    """Names of the arguments that a function takes, none if it does not tell."""
    try:
        return set(inspect.signature(make).parameters)
    except (TypeError, ValueError):  # some are written in C
        return set()
