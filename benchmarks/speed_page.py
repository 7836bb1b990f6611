"""The computed parts of docs/speed.md: the table of all rows, and the machine that they were measured on."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from benchmarks.rows import Row, machine_lines
from numerics.checks import shown
from numerics.files import write_whole
from numerics.markdown import table, with_tables

HEADER = ("what", "beside", "ours", "theirs", "ratio", "goal", "met")
MARK = "<!-- table speed -->"


def check_page(path: Path) -> None:
    """Raise ValueError unless a page has a place for the table, before minutes of measuring."""
    try:
        found = path.read_text()
    except (OSError, UnicodeDecodeError):
        raise ValueError(f"--page must be a page that can be read, but got {shown(str(path))}") from None
    if MARK not in found:
        raise ValueError(f"--page must be a page with {MARK}, but {path} has none")


def write_page(path: Path, rows: Sequence[Row], facts: dict, memory: Sequence[str]) -> None:
    """Write the tables of a page anew: `speed`, and `machine`, which says on what and with what memory."""
    tables = {"speed": lambda: speed_table(rows), "machine": lambda: " ".join([*machine_lines(facts), *memory])}
    write_whole(path, with_tables(path.read_text(), tables))


def speed_table(rows: Sequence[Row]) -> str:
    """All rows as a table in Markdown; what there is none of is left empty."""
    lines = []
    for row in rows:
        _, *cells = row.cells()
        lines.append([row.what, row.peer_name or "", *("" if cell == "-" else cell for cell in cells)])
    return table(HEADER, lines)
