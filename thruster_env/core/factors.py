"""Parameters multiplied by factors, for a filter that assumes another plant than the true one."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import NamedTuple, TypeVar

from thruster_env.core.checks import positive, short_repr

Parameters = TypeVar("Parameters", bound=NamedTuple)


def scaled(parameters: Parameters, factors: Mapping[str, float], names: Iterable[str]) -> Parameters:
    """Parameters with some fields multiplied by positive factors; ValueError unless these are among the names."""
    if not isinstance(factors, Mapping):
        raise ValueError(f"parameter_factors must map names to factors, but got {short_repr(factors)}")
    unknown = [name for name in factors if name not in names]
    if unknown:
        raise ValueError(f"parameter_factors must name fields of {', '.join(names)}, but got {unknown}")
    changed = {name: getattr(parameters, name) * positive(name, factor) for name, factor in factors.items()}
    return parameters._replace(**changed)
