"""What every command shares: tables on the terminal, JSON for programs."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Container, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console, ConsoleOptions, JustifyMethod, RenderableType, RenderResult
from rich.table import Table
from rich.text import Text

from numerics.compiled import tell_when_compiling
from numerics.files import check_not_read, check_target, write_whole
from numerics.progress import listening
from thruster_cli.characters import showable
from thruster_cli.options import JsonOption, SeedOption  # noqa: F401 - for `demo`
from thruster_env.plant import largest_known_voltage

BEST = "bold green"  # style of rows that win

console = Console(markup=False, highlight=False)
progress_console = Console(stderr=True, markup=False, highlight=False)


class WholeTable(Table):
    """A table whose title and caption are as wide as the terminal, and not broken where the table ends."""

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """The title, the table, the caption."""
        title, caption = self.title, self.caption
        self.title = self.caption = None
        try:
            yield from [Text(str(title), style="table.title")] if title else []
            yield from super().__rich_console__(console, options)
            yield from [Text(str(caption), style="table.caption")] if caption else []
        finally:
            self.title, self.caption = title, caption


def table(
    title: str | None,
    columns: Sequence[str],
    rows: Sequence[Sequence[Any]],
    *,
    caption: str | None = None,
    words: bool = False,
    best: Container[int | None] = (),
) -> Table:
    """A table for the terminal; where it is narrow, cells fold and no column is lost.

    Args:
        title: above it, if there is one.
        columns: their headers; the first one is left-aligned.
        rows: cells.
        caption: below it.
        words: whether the other columns hold words, and are left-aligned, too.
        best: places of rows that win, which stand out on a terminal; None is no row's place.
    """
    title, caption = (part and showable(part, console.encoding) for part in (title, caption))
    out = WholeTable(title=title, caption=caption, box=SIMPLE_HEAD)
    out.padding, out.pad_edge = (0, 1, 0, 0), False  # five figures with their intervals fit into 80 columns
    for index, column in enumerate(columns):
        justify: JustifyMethod = "left" if index == 0 or words else "right"
        out.add_column(Text(showable(column, console.encoding), overflow="fold"), justify=justify, overflow="fold")
    for place, row in enumerate(rows):  # Text: units in brackets are no markup
        cells = [cell if isinstance(cell, Text) else Text(showable(str(cell), console.encoding)) for cell in row]
        out.add_row(*cells, style=BEST if place in best else None)
    _keep_words_whole(out)
    return out


def _keep_words_whole(out: Table) -> None:
    """Let cells fold between words only, if there is room for the longest one of each column."""
    columns = [[column.header, *column.cells] for column in out.columns]
    longest = [max((len(word) for cell in cells for word in str(cell).split()), default=1) for cells in columns]
    if sum(longest) + 2 * len(longest) > console.width:
        out.padding = 0
    if sum(longest) + len(longest) + 1 <= console.width:
        for column, width in zip(out.columns, longest, strict=True):
            column.min_width = width


def emit(shown: Sequence[RenderableType], data: dict, json_target: str | None) -> None:
    """Print tables and lines, unless JSON goes to standard output; write JSON where asked."""
    if json_target == "-":
        sys.stdout.write(as_text(data))
        return
    if json_target is not None:  # first: there may be nobody left who reads what is printed
        write_whole(json_target, as_text(data))
    for part in shown:
        console.print(part)


def check_targets(targets: Iterable[str | Path | None], json_target: str | None, read: Iterable = ()) -> None:
    """Raise ValueError unless all files can be written, before long work, and none of those read is among them.

    Args:
        targets: paths of what is to be written, None for those that nobody asked for.
        json_target: of `--json`.
        read: paths of what is read, None for those that nobody gave.
    """
    named = [one for one in (*targets, None if json_target == "-" else json_target) if one is not None]
    given = [one for one in read if one is not None]
    for target in named:
        check_not_read(target, given)
    for target in named:
        check_target(target)


def warn_beyond(preset: str, voltage: float) -> None:
    """Say on standard error that a preset is driven by a larger voltage [V] than is known of it."""
    known = largest_known_voltage(preset)
    if abs(voltage) > known:
        said = f"{preset} is known up to {known:g} V, but is driven by {abs(voltage):g} V: this is extrapolated"
        progress_console.print(f"thruster: warning: {said}")


@cache
def announce_compilation() -> None:
    """Say on standard error when this process has to compile; later ones find the result in a cache."""
    tell_when_compiling(
        lambda: progress_console.print("compiling numerical code: the first run only, some seconds a filter ...")
    )


@contextmanager
def working(text: str) -> Iterator[None]:
    """Say on standard error what goes on, with how far it is where that is told."""
    with progress_console.status(f"{text} ...") as status, listening(lambda far: status.update(f"{text}: {far}")):
        yield


def as_text(data) -> str:
    """JSON of plain data, arrays and NamedTuples; numbers that are not finite become null."""
    return json.dumps(_plain(data), indent=2, allow_nan=False) + "\n"


def _plain(value):
    if isinstance(value, dict):
        return {str(key): _plain(part) for key, part in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(part) for part in value]
    if isinstance(value, np.ndarray | np.generic):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
