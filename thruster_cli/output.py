"""What every command shares: options, tables on the terminal, JSON for programs, whole files or none."""

from __future__ import annotations

import json
import os
import sys
import tempfile
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.table import Table

JsonOption = Annotated[
    str | None, typer.Option("--json", metavar="FILE", help="Also write the result as JSON; - for standard output.")
]
SeedOption = Annotated[int, typer.Option("--seed", min=0, help="Seed of all randomness; the same seed repeats all.")]

console = Console()
progress_console = Console(stderr=True)


def table(title: str, columns: list[str], rows: list[list[Any]], *, caption: str | None = None) -> Table:
    """A table for the terminal; the first column is left-aligned, the others to the right."""
    out = Table(title=title, caption=caption, title_justify="left", caption_justify="left")
    for index, column in enumerate(columns):
        out.add_column(column, justify="left" if index == 0 else "right")
    for row in rows:
        out.add_row(*[cell if isinstance(cell, str) else str(cell) for cell in row])
    return out


def emit(shown: list, data: dict, json_target: str | None) -> None:
    """Print tables and lines, unless JSON goes to standard output; write JSON where asked."""
    if json_target == "-":
        json.dump(data, sys.stdout, indent=2, default=_plain)
        sys.stdout.write("\n")
        return
    for part in shown:
        console.print(part)
    if json_target is not None:
        write_whole(Path(json_target), json.dumps(data, indent=2, default=_plain) + "\n")


def write_whole(path: Path, text: str) -> None:
    """Write a text file aside, then rename it into place: a reader sees the old file or the new one.

    Raises:
        ValueError: if the folder does not exist or cannot be written.
    """
    try:
        descriptor, aside = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        with os.fdopen(descriptor, "w") as stream:
            stream.write(text)
        os.replace(aside, path)
    except OSError as error:
        raise ValueError(f"a file must be in a folder that can be written, but {path} is not: {error.strerror}") from None


def _plain(value):
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "_asdict"):
        return value._asdict()
    raise TypeError(f"{type(value).__name__} has no JSON form")
