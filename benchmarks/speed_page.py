"""The computed parts of docs/speed.md: a section for each machine, with the table of all rows."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from benchmarks.timing import Row, machine_lines, machine_name
from thruster_env.core.checks import short_repr
from thruster_env.core.files import write_whole
from thruster_env.core.text_tables import markdown_table, with_tables

HEADER = ("what", "beside", "ours", "theirs", "ratio", "limit", "x limit", "goal", "met")
NO_BREAK = "\N{NO-BREAK SPACE}"  # between a number and its unit
MARK, END = "<!-- table speed: ", "<!-- end -->"


def check_page(path: Path) -> None:
    """Raise ValueError unless a page has a place for the table, before minutes of measuring."""
    try:
        page = path.read_text()
    except (OSError, UnicodeDecodeError):
        raise ValueError(f"--page must be a page that can be read, but got {short_repr(str(path))}") from None
    if MARK not in page:
        raise ValueError(f"--page must be a page with {MARK}PROCESSOR, N cores -->, but {path} has none")


def write_page(path: Path, rows: Sequence[Row], facts: dict, memory: Sequence[str]) -> None:
    """Replace this machine's section or append it; those of other machines stay."""
    page, name = path.read_text(), f"speed: {machine_name(facts)}"
    mark = f"<!-- table {name} -->"
    if mark not in page:
        last = [match.end() for match in re.finditer(f"{MARK}.*?{END}", page, flags=re.DOTALL)][-1]
        page = f"{page[:last]}\n\n{mark}\n{END}{page[last:]}"
    write_whole(path, with_tables(page, {name: lambda: machine_section(rows, facts, memory)}))


def machine_section(rows: Sequence[Row], facts: dict, memory: Sequence[str]) -> str:
    """The machine's name as a heading, its table and its other facts."""
    lines = " ".join([*machine_lines(facts), *memory])
    return f"\n## On {machine_name(facts)}\n\n{speed_table(rows)}\n\n{lines}\n"


def speed_table(rows: Sequence[Row]) -> str:
    """All rows as a table in Markdown, with empty cells for missing values."""
    lines = []
    for row in rows:
        _, *cells = row.cells()
        numbers = ("" if cell == "-" else cell.replace(" ", NO_BREAK) for cell in cells)
        lines.append([row.what, row.peer_name or "", *numbers])
    return markdown_table(HEADER, lines)
