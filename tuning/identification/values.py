"""Identified values of a user's model, in a file that commands take as the preset of `--model`.

[values]            the model's arguments, named constants, Q11, Q22, ... and R11, ...
[identified]        how they were found, for readers
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path

from thruster_env.core.checks import finite, positive, short_repr
from thruster_env.core.files import as_toml, read_toml, write_whole
from thruster_env.logs.write import check_not_among
from thruster_env.model.continuous import noise_for_dt, same_dt
from thruster_env.model.state_space import StateSpaceModel
from tuning.identification.family import ModelFamily
from tuning.identification.result import Identification

TABLES = ("values", "identified")


def write_values(
    path: str | Path, identification: Identification, logs: Sequence[str], dt: float | None = None
) -> None:
    """Write the identified values of a model, and the sample time of its logs [s], if that is known.

    Raises:
        ValueError: unless the path ends in .toml, lies beside no log of its name and can be written.
    """
    if not str(path).endswith(".toml"):
        raise ValueError(f"a file of values must end in .toml, but got {str(path)!r}")
    check_not_among(path)
    identified = {
        "logs": [Path(log).name for log in logs],
        "log_likelihood": identification.log_likelihood,
        "standard_errors": identification.standard_errors,
        "determined": identification.determined,
        **({} if dt is None else {"dt": float(dt)}),
    }
    tables: dict[str, Mapping] = {"values": identification.values, "identified": identified}
    write_whole(path, as_toml(tables, "Numbers of a model as `thruster identify` found them."))


def read_values(path: str | Path) -> dict[str, float]:
    """The values in such a file by name.

    Raises:
        ValueError: states the rule and the value, with the path.
    """
    content = read_toml(path, "a file of values")
    values = content.get("values")
    if not isinstance(values, dict) or not values or set(content) - set(TABLES):
        raise ValueError(
            f"a file of values must have the table [values], but {path} has {short_repr(sorted(content))}"
        )
    return {name: finite(f"{name} in {path}", value) for name, value in values.items()}


def with_values(make: Callable | StateSpaceModel, path: str | Path) -> Callable[[float], StateSpaceModel]:
    """A function of the sample time that makes a model with the values in a file.

    Values belong to the sample time that the file says they were found at. At another one a function of `dt` makes
    the model, with variances in Q as `noise_for_dt` has them; any other model is refused.

    Args:
        make: the model, or a function that makes it, as for `ModelFamily`.
        path: path of the file.

    Raises:
        ValueError: if the file is damaged, or names a parameter that the model does not have; the function raises
            it for another sample time of a model that does not take one.
    """
    values, of = read_values(path), _dt_of(path)
    model_at = partial(_at_dt, make, values, of, str(path))
    try:
        model_at(1.0 if of is None else of)
    except ValueError as error:
        raise ValueError(f"{error} (in {path})") from None
    return model_at


def _dt_of(path: str | Path) -> float | None:
    """The sample time of the logs that values were found on [s]; None in a file that does not say."""
    table = read_toml(path, "a file of values").get("identified")
    dt = table.get("dt") if isinstance(table, dict) else None
    return None if dt is None else positive(f"dt in {path}", dt)


def _at_dt(
    make: Callable | StateSpaceModel, values: Mapping[str, float], of: float | None, path: str, dt: float
) -> StateSpaceModel:
    """The model with values of one sample time at another."""
    if of is not None and not same_dt(of, dt):
        takes = not isinstance(make, StateSpaceModel) and "dt" in inspect.signature(make).parameters
        if not takes:
            raise ValueError(
                f"the dt of a log must be that of {path}, {of:g} s, for a model that takes no dt, but is {dt:g} s"
            )
        q_variances = ModelFamily(make, (), noise=False, dt=dt).variances_of_q
        values = {n: float(noise_for_dt(v, of, dt)) if n in q_variances else v for n, v in values.items()}
    return valued(make, values, dt)


def valued(
    make: Callable | StateSpaceModel, values: Mapping[str, float], dt: float | None = None
) -> StateSpaceModel:
    """A model with other values of some parameters, by name; see `ModelFamily` for the names and errors."""
    return ModelFamily(make, tuple(values), noise=False, dt=dt).model(**values)
