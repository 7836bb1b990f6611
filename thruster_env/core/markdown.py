"""Tables in Markdown, and pages whose tables are computed."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from thruster_env.core.files import write_whole


def table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("".join(f"| {cell} " if cell else "| " for cell in line) + "|" for line in lines)


def with_tables(page: str, tables: Mapping[str, Callable[[], str]]) -> str:
    """The page with these computed tables written anew; others stay.

    A table stands between `<!-- table NAME -->` and `<!-- end -->`.
    """

    def anew(match: re.Match) -> str:
        if match[2] not in tables:
            return match[0]
        return f"{match[1]}\n{tables[match[2]]()}\n{match[3]}"

    return re.sub(r"(<!-- table ([^\n]+?) -->).*?(<!-- end -->)", anew, page, flags=re.DOTALL)


def print_or_write(name: str, text: str, arguments: Sequence[str]) -> None:
    """Print a table, or write it anew on the page whose path is the first argument of a command line."""
    if not arguments:
        print(text)
        return
    page = Path(arguments[0])
    write_whole(page, with_tables(page.read_text(encoding="utf-8"), {name: lambda: text}))
