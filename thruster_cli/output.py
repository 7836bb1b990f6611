"""What every command shares: options, tables on the terminal, JSON for programs."""

from __future__ import annotations

import json
import sys
from functools import cache
from typing import Annotated, Any

import numpy as np
import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table
from rich.text import Text

from thruster_env.compiled import tell_when_compiling
from thruster_env.files import write_whole

JsonOption = Annotated[
    str | None,
    typer.Option("--json", metavar="FILE", help="Also write the result as JSON; - for standard output."),
]
SeedOption = Annotated[
    int, typer.Option("--seed", min=0, help="Seed of all randomness; the same seed repeats all.")
]

console = Console(markup=False, highlight=False)
progress_console = Console(stderr=True, markup=False, highlight=False)


def table(title: str, columns: list[str], rows: list[list[Any]], *, caption: str | None = None) -> Table:
    """A table for the terminal; the first column is left-aligned, the others to the right."""
    out = Table(title=title, caption=caption, title_justify="left", caption_justify="left", box=SIMPLE_HEAD)
    out.padding, out.pad_edge = (0, 1, 0, 0), False  # five figures with their intervals fit into 80 columns
    for index, column in enumerate(columns):
        out.add_column(Text(column), justify="left" if index == 0 else "right")
    for row in rows:
        out.add_row(*[Text(str(cell)) for cell in row])  # Text: units in brackets are no markup
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
        write_whole(json_target, json.dumps(data, indent=2, default=_plain) + "\n")


@cache
def announce_compilation() -> None:
    """Say on standard error when this process has to compile; later ones find the result in a cache."""
    tell_when_compiling(
        lambda: progress_console.print("compiling numerical code: the first run only, some seconds a filter ...")
    )


def _plain(value):
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, np.generic):
        return value.item()
    if hasattr(value, "_asdict"):
        return value._asdict()
    raise TypeError(f"{type(value).__name__} has no JSON form")
