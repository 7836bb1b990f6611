"""Objects by "module:object": code, which only a user's own command line or call may have imported."""

from __future__ import annotations

import importlib
import os
import sys
from types import ModuleType


def is_code(name) -> bool:
    """Whether a name is that of an object in a module, "module:object", which only a user may have imported."""
    return isinstance(name, str) and ":" in name and not name.endswith(".toml")


def object_named(name: str, what: str):
    """The object of "module:object", whose module lies where Python looks or in the working folder.

    Args:
        name: of the object.
        what: it is, for messages, such as "problem".

    Raises:
        ValueError: if the module cannot be imported, or lacks the object.
    """
    module_name, _, path = name.partition(":")
    try:
        found = _executed(module_name, name, what)
        for part in path.split("."):
            found = getattr(found, part)
    except RuleBroken:
        raise
    except (ImportError, AttributeError, ValueError) as error:
        raise ValueError(
            f"{what} must be 'module:object' that can be imported, but {name!r} is not: {error}"
        ) from None
    except Exception as error:
        article = "an" if what[0] in "aeiou" else "a"
        raise ValueError(f"{article} {what}'s module must import, but {name!r} raised {said(error)}") from error
    return found


def _executed(module_name: str, name: str, what: str) -> ModuleType:
    """The module; an error of rule and value that its lines raise needs no words about imports."""
    try:
        return _module(module_name)
    except ValueError as error:
        if not module_name:
            raise
        raise RuleBroken(f"{error} ({what} {name!r})") from error


class RuleBroken(ValueError):
    """What a module of the user's raised while it ran."""


def said(error: BaseException) -> str:
    """What somebody else's code raised, on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def _module(name: str) -> ModuleType:
    """A module, which may lie in the working folder, as the user's own do."""
    folder = os.getcwd()
    if folder in sys.path or "" in sys.path:
        return importlib.import_module(name)
    sys.path.append(folder)
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(folder)
