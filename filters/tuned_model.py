"""The model of a tuned file, as data, and its comparison with another one."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from thruster_env.core.checks import short_repr
from thruster_env.logs.steps import of_one_step
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel

VECTORS = {"states": "states", "inputs": "input_quantities", "measurements": "measurements"}
KEYS = ("digest", "dt", *VECTORS)


def model_data(model: StateSpaceModel, dt: float | None) -> dict:
    """A model's digest, sample time [s] and quantities, as JSON can hold them; of any steps, of one of dt."""
    model = of_one_step(model)
    named = {key: [list(one) for one in getattr(model, name)] for key, name in VECTORS.items()}
    return {"digest": model.digest, "dt": dt, **named}


def check_same_quantities(tuned_for: Mapping, model: StateSpaceModel, dt: float | None, file: str | Path) -> None:
    """Raise ValueError, with what differs, unless a model has the states, inputs, sensors and dt of a tuned file.

    Args:
        tuned_for: the file's `model_data`.
        model: on which it is to be used.
        dt: its sample time [s]; None if unknown, which is not compared.
        file: its path.
    """
    model = of_one_step(model)
    here = {key: [list(one) for one in getattr(model, name)] for key, name in VECTORS.items()}
    differing = [
        f"{key} {_listed(tuned_for[key])} (here {_listed(here[key])})"
        for key in VECTORS
        if [one[1:] for one in tuned_for[key]] != [one[1:] for one in here[key]]  # whatever they are called
    ]
    then = tuned_for["dt"]
    if then is not None and dt is not None and abs(then - dt) > 1e-9 * then:
        differing.append(f"dt {then:g} (here {dt:g})")
    if differing:
        raise ValueError(
            f"a tuned file must be for the model it is used with, but {file} was tuned for {', '.join(differing)}"
        )


def check_same_model(tuned_for: Mapping, model: StateSpaceModel, dt: float | None, file: str | Path) -> None:
    """Raise ValueError, with what differs, unless a model is the very one that a tuned file is for.

    Arguments are those of `check_same_quantities`; the model has the file's Q and R.
    """
    check_same_quantities(tuned_for, model, dt, file)
    model = of_one_step(model)
    if model.digest != tuned_for["digest"]:
        raise ValueError(
            f"a tuned file must be for the model it is used with, but {file} was tuned for a model of digest "
            f"{tuned_for['digest']} (here {model.digest})"
        )


def check_model_data(given) -> None:
    """Raise ValueError unless data are such as `model_data` makes."""
    sound = isinstance(given, dict) and set(given) == set(KEYS) and isinstance(given["digest"], str)
    sound = sound and (given["dt"] is None or (isinstance(given["dt"], float | int) and given["dt"] > 0))
    if not sound or not all(
        isinstance(given[key], list) and all(map(_is_quantity, given[key])) for key in VECTORS
    ):
        raise ValueError(f"the model of a tuned file must have {', '.join(KEYS)}, but got {short_repr(given)}")


def _is_quantity(given) -> bool:
    return isinstance(given, list) and [type(part) for part in given] == [str, str, str, bool]


def _listed(quantities: list) -> str:
    ones = [Quantity(*one) for one in quantities]
    return ", ".join(f"{one.symbol} [{one.unit}]" if one.unit else one.symbol for one in ones) or "none"
