"""Identified values of a user's model, in a file that commands take as the preset of `--model`.

[values]            the model's arguments, named constants, Q11, Q22, ... and R11, ...
[identified]        how they were found, for readers
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from numerics.checks import finite, shown
from numerics.files import write_whole
from numerics.toml import as_toml, read_toml
from plants.state_space import StateSpaceModel
from tuning.identification.family import ModelFamily
from tuning.identification.result import Identification

TABLES = ("values", "identified")


def write_values(path: str | Path, found: Identification, logs: Sequence[str]) -> None:
    """Write the identified values of a model; ValueError unless the path ends in .toml and can be written."""
    if not str(path).endswith(".toml"):
        raise ValueError(f"a file of values must end in .toml, but got {str(path)!r}")
    identified = {
        "logs": [Path(log).name for log in logs],
        "log_likelihood": found.log_likelihood,
        "standard_errors": found.standard_errors,
        "determined": found.determined,
    }
    tables: dict[str, Mapping] = {"values": found.values, "identified": identified}
    write_whole(path, as_toml(tables, "Numbers of a model as `thruster identify` found them."))


def read_values(path: str | Path) -> dict[str, float]:
    """The values in such a file by name.

    Raises:
        ValueError: states the rule and the value, with the path.
    """
    content = read_toml(path, "a file of values")
    values = content.get("values")
    if not isinstance(values, dict) or not values or set(content) - set(TABLES):
        raise ValueError(f"a file of values must have the table [values], but {path} has {shown(sorted(content))}")
    return {name: finite(f"{name} in {path}", value) for name, value in values.items()}


def with_values(make: Callable | StateSpaceModel, path: str | Path) -> Callable[[float], StateSpaceModel]:
    """A function of the sample time that makes a model with the values in a file.

    Args:
        make: the model, or a function that makes it, as for `ModelFamily`.
        path: path of the file.

    Raises:
        ValueError: if the file is damaged, or names a parameter that the model does not have.
    """
    values = read_values(path)
    made = partial(valued, make, values)
    try:
        made(1.0)
    except ValueError as error:
        raise ValueError(f"{error} (in {path})") from None
    return made


def valued(
    make: Callable | StateSpaceModel, values: Mapping[str, float], dt: float | None = None
) -> StateSpaceModel:
    """A model with other values of some parameters, by name; see `ModelFamily` for the names and errors."""
    return ModelFamily(make, tuple(values), noise=False, dt=dt).model(**values)
