"""What `thruster log` shows of a recorder's file: its topics and their fields."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from itertools import groupby
from pathlib import Path

from rich.console import RenderableType

from thruster_env.core.checks import listed
from thruster_env.core.text_tables import plain_text, table
from thruster_env.env.record import ANY_DT
from thruster_env.logs.columns import find_columns, quantities_of
from thruster_env.logs.grid import time_text
from thruster_env.logs.recorders.bag_counts import METADATA
from thruster_env.logs.recorders.one_clock import HEADER, RECEIPT
from thruster_env.logs.recorders.registry import ENDINGS, Contents, Field, contents, format_of
from thruster_env.logs.table import SUFFIXES, read_table
from tuning.problems.plant_packages import logs_package

BLOCKS = "▁▂▃▄▅▆▇█"
CLOCKS = {HEADER: "stamps of headers", RECEIPT: "when messages were received"}  # in words
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
    if only is None and (is_asked or log.with_suffix(".toml").is_file()):
        return False
    return form is not None or _is_foreign(log)


def _is_foreign(log: Path) -> bool:
    """Whether a log is a table that has no column of a thruster's."""
    if log.suffix.lower() not in SUFFIXES or not log.is_file():
        return False
    table, room = read_table(log), logs_package()
    for one in quantities_of(room.Preset(room.DEFAULT_PRESET, None, ANY_DT).state_space_model()):
        try:
            found = find_columns([one], table.names, {}, {}, table.file)
        except ValueError:  # a missing one
            continue
        if one.key in found:
            return False
    return True


def found_in(log: Path, only: str | None, stamps: str | None = None) -> Contents:
    """What is in a file, fields whose names contain a text in any case; ValueError if there are none."""
    every = contents(log, stamps)
    some = [one for one in every.fields if only is None or only.casefold() in one.name.casefold()]
    if not some:
        what = "some field of numbers" if only is None else f"a field whose name contains {only!r}"
        others = f"; not read are {_listed(every.unread)}" if every.unread else ""
        raise ValueError(f"a log must have {what}, but {log} has none among {len(every.fields)} fields{others}")
    unread = {
        name: why for name, why in every.unread.items() if only is None or only.casefold() in name.casefold()
    }
    return Contents(some, unread, every.damage)


def remarks(some: Contents) -> list[str]:
    """What of a file is damaged or not read, in sentences."""
    said = [f"{one[:1].upper()}{one[1:]}." for one in some.damage]
    return [*said, f"Not read: {_listed(some.unread)}."] if some.unread else said


def _listed(unread: Mapping[str, str]) -> str:
    return listed(f"{name} ({why})" for name, why in unread.items())


def as_table(log: Path, some: Sequence[Field], is_terminal: bool) -> RenderableType:
    """The table of fields: by topics for a terminal, or lines of plain text whose names nothing folds."""
    of_times = ["rate\n[Hz]", "longest\ngap [s]", "begin\n[s]", "end\n[s]"]
    columns = ["field", "samples", *of_times, "unit", "least", "greatest", "course"]
    rows = _by_topics(some) if is_terminal else [[one.name, *_counts(one), *_values(one)] for one in some]
    form = format_of(log)
    title = f"{log}: {form.kind if form else 'table'}, {len(some)} {'fields' if form else 'columns'}"
    caption = "To read it as a log: --column NAME=FIELD for each input and measurement"
    clocks = dict.fromkeys(CLOCKS[one.clock] for one in some if one.clock)
    caption += f"; times: {' and '.join(clocks)}" if clocks else ""
    shown = table(title, columns, rows, caption=caption)
    return shown if is_terminal else plain_text([shown], WIDE)


def as_json(log: Path, some: Contents) -> dict:
    """The same as data."""
    form = format_of(log)
    names: tuple[str, ...] = ("name", "topic", "samples", "rate_hz", "longest_gap_s", "begin_s", "end_s", "stamps")
    names += ("unit", "least", "greatest", "course")
    rows = [dict(zip(names, one, strict=True)) for one in some.fields]
    found = {"log": str(log), "format": form.kind if form else "table", "fields": rows}
    return {**found, "not_read": some.unread, "damage": list(some.damage)}


def _by_topics(some: Sequence[Field]) -> list[list[str]]:
    """Rows of fields under one of their topic, which has what they have in common."""
    rows = []
    for (topic, *counts), group in groupby(some, lambda one: (one.topic, *_counts(one))):
        rows += [[topic, *counts, *[""] * 4]] if topic else []
        for one in group:
            name, own = (f"  {one.name[len(topic) :]}", [""] * len(counts)) if topic else (one.name, counts)
            rows.append([name, *own, *_values(one)])
    return rows


def _counts(one: Field) -> list[str]:
    ends = [time_text(end, one.gap, 4) if math.isfinite(end) else "" for end in (one.begin, one.end)]
    return [str(one.samples), _short(one.rate), _short(one.gap), *ends]


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
