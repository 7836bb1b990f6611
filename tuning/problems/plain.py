"""Values of plain data: mappings and lists that cannot be changed, and as JSON takes them."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

from numerics.checks import shown

DEEPEST = 10  # levels of mappings and lists


def frozen(value, depth: int = 0):
    """A value of mappings and lists as one that cannot be changed; ValueError if it is nested without end."""
    if depth > DEEPEST:
        raise ValueError(f"mappings and lists must be nested at most {DEEPEST} deep, but got {shown(value)}")
    if isinstance(value, Mapping):
        return MappingProxyType({key: frozen(part, depth + 1) for key, part in value.items()})
    return tuple(frozen(part, depth + 1) for part in value) if isinstance(value, list | tuple) else value


def plain(value):
    """The inverse of `frozen`: dictionaries and lists, which JSON and deep copies take."""
    if isinstance(value, Mapping):
        return {key: plain(part) for key, part in value.items()}
    return [plain(part) for part in value] if isinstance(value, list | tuple) else value
