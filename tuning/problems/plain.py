"""Plain data: mappings and lists as immutable values, and as values for JSON."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from thruster_env.core.checks import short_repr

DEEPEST = 10  # levels of mappings and lists


def frozen(value, depth: int = 0):
    """Mappings and lists as an immutable value; ValueError if they are nested too deep."""
    if depth > DEEPEST:
        raise ValueError(f"mappings and lists must be nested at most {DEEPEST} deep, but got {short_repr(value)}")
    if isinstance(value, Mapping):
        return MappingProxyType({key: frozen(part, depth + 1) for key, part in value.items()})
    return tuple(frozen(part, depth + 1) for part in value) if isinstance(value, list | tuple) else value


def plain(value):
    """The inverse of `frozen`: dictionaries and lists, for JSON and deep copies."""
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, list | tuple) else value
