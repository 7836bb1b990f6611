"""TOML files: read with one clear line for what is wrong, and written, which the standard library does not."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from pathlib import Path


def read_toml(path: str | Path, what: str) -> dict:
    """The content of a TOML file; ValueError, with the path and what it is ("a preset file"), if there is none."""
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{what} must be readable, but {path} is not: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # not TOML, nested too deeply, or not even text
        raise ValueError(f"{what} must be TOML, but {path} is not: {error}") from None


def as_toml(tables: Mapping[str, Mapping], about: str = "") -> str:
    """A file of tables, empty ones left out, with a line of comment at its beginning.

    Args:
        tables: texts, numbers, truth values, lists and mappings of these, by key, by table.
        about: the comment.
    """
    lines = [f"# {about}"] if about else []
    for name, table in tables.items():
        if table:
            lines += [""] if lines else []
            lines += [f"[{name}]", *(f"{_key(one)} = {_text(value)}" for one, value in table.items())]
    return "\n".join(lines) + "\n"


def _key(name: str) -> str:
    return name if name.replace("_", "").replace("-", "").isalnum() and name.isascii() else _text(name)


def _text(value) -> str:
    """A value as TOML has it."""
    if isinstance(value, Mapping):
        return "{" + ", ".join(f"{_key(name)} = {_text(part)}" for name, part in value.items()) + "}"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(_text, value)) + "]"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        characters = (f"\\u{ord(c):04X}" if ord(c) < 32 or c in '"\\\x7f' else c for c in value)
        return '"' + "".join(characters) + '"'
    return repr(float(value)) if isinstance(value, float) else repr(value)
