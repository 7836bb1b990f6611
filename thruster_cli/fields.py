"""What `thruster log` shows of a recorder's file: its topics and their fields."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from rich.console import RenderableType

from thruster_env.numerics.text_tables import plain_text, table
from thruster_env.plants.logs.recorders.registry import ENDINGS, METADATA, Field, fields, format_of

BLOCKS = "▁▂▃▄▅▆▇█"
WIDE = 400  # characters of a line that goes into a file or another program: no name is folded there


def is_listed(log: Path, only: str | None, is_asked: bool) -> bool:
    """Whether the fields of a log are listed: of a recorder's file, unless options say how to read it.

    Args:
        log: its path.
        only: what is sought among its fields, None for nothing.
        is_asked: whether other options are given.

    Raises:
        ValueError: if something is sought in a file that has no topics.
    """
    form = format_of(log)
    if only is not None and form is None:
        rule = f"--only must go with a recorder's file, {', '.join(ENDINGS)} or a folder with {METADATA}"
        raise ValueError(f"{rule}, but got {log}")
    return form is not None and (only is not None or not (is_asked or log.with_suffix(".toml").is_file()))


def found_in(log: Path, only: str | None) -> list[Field]:
    """The fields of a recorder's file whose names contain a text, in any case; ValueError if there are none."""
    every = fields(log)
    some = [one for one in every if only is None or only.casefold() in one.name.casefold()]
    if not some:
        what = "some field of numbers" if only is None else f"a field whose name contains {only!r}"
        raise ValueError(f"a log must have {what}, but {log} has none among {len(every)} fields")
    return some


def as_table(log: Path, some: Sequence[Field], is_terminal: bool) -> RenderableType:
    """The table of fields: by topics for a terminal, or lines of plain text whose names nothing folds."""
    columns = ["field", "samples", "rate\n[Hz]", "longest\ngap [s]", "unit", "least", "greatest", "course"]
    rows = _by_topics(some) if is_terminal else [[one.name, *_counts(one), *_values(one)] for one in some]
    form = format_of(log)
    title = f"{log}: {form.kind if form else 'log'}, {len(some)} fields"
    caption = "To read it as a log: --column NAME=FIELD for each input and measurement"
    shown = table(title, columns, rows, caption=caption)
    return shown if is_terminal else plain_text([shown], WIDE)


def as_json(log: Path, some: Sequence[Field]) -> dict:
    """The same as data."""
    form = format_of(log)
    names = ("name", "topic", "samples", "rate_hz", "longest_gap_s", "unit", "least", "greatest", "course")
    listed = [dict(zip(names, one, strict=True)) for one in some]
    return {"log": str(log), "format": form.kind if form else "", "fields": listed}


def _by_topics(some: Sequence[Field]) -> list[list[str]]:
    """Rows of fields under one of their topic, which has what they have in common."""
    rows = []
    for (topic, *counts), group in groupby(some, lambda one: (one.topic, *_counts(one))):
        rows += [[topic, *counts, *[""] * 4]] if topic else []
        for one in group:
            name, own = (f"  {one.name[len(topic) :]}", [""] * 3) if topic else (one.name, counts)
            rows.append([name, *own, *_values(one)])
    return rows


def _counts(one: Field) -> list[str]:
    return [str(one.samples), _short(one.rate), _short(one.gap)]


def _values(one: Field) -> list[str]:
    return [one.unit, _short(one.least), _short(one.greatest), sparkline(one.course)]


def sparkline(course: Sequence[float]) -> str:
    """Numbers as blocks of eight heights, from least to greatest, a space for NaN; nothing if all are equal."""
    known = [one for one in course if math.isfinite(one)]
    low, high = min(known, default=0.0), max(known, default=0.0)
    if low == high:
        return ""
    heights = [7.0 * ((one / 2 - low / 2) / (high / 2 - low / 2)) for one in course]  # halves do not overflow
    return "".join(BLOCKS[round(one)] if math.isfinite(one) else " " for one in heights)


def _short(number: float) -> str:
    return f"{number:.4g}" if math.isfinite(number) else ""
