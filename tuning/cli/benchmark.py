"""Standard problems on the terminal: published results beside ours, and why they differ."""

from __future__ import annotations

from collections.abc import Sequence

from rich.console import RenderableType
from rich.table import Table
from rich.text import Text

from thruster_env.core.text_tables import console, table
from tuning.cli.output import announce_compilation, progress_console
from tuning.experiments.benchmark import WHY, Benchmark, Row, find_benchmark


def reproduce_benchmark(name: str, runs: int, seed: int) -> tuple[list[RenderableType], dict]:
    """Solve a standard problem; return what to show, as a list and as plain data."""
    announce_compilation()
    benchmark = find_benchmark(name)
    with progress_console.status("...") as status:
        rows = benchmark.reproduce(runs, seed, lambda row: status.update(f"done: {row.label}"))
    output: list[RenderableType] = [_table(benchmark, rows, runs), Text(""), Text(f"{name}: {benchmark.source}")]
    if benchmark.remarks:
        output.append(list_of(benchmark.remarks))
    return output, {
        "settings": {"runs": runs, "seed": seed},
        "source": benchmark.source,
        "score": benchmark.score,
        "theirs": benchmark.theirs,
        "rows": [row._asdict() | {"ratio": row.ratio, "why": row.why} for row in rows],
        "statements": list(benchmark.remarks),
    }


def _table(benchmark: Benchmark, rows: list[Row], runs: int) -> Table:
    columns = benchmark.header
    columns[2] = f"ours ({runs} runs)"
    cells = [row.cells() for row in rows]
    for row in cells:
        row[2] = row[2].replace(" [", "\n[")
    compared = f"The table compares {benchmark.score}, ours with its 95 % interval."
    caption = f"{compared} Median run: median score of single runs. Pooled: the RMSE of our tables."
    out = fitted(table(benchmark.about, columns, cells, caption=caption), cells, flexible=WHY)
    out.columns[0].width = None
    return out


LEAST = 12  # width of a column of words


def fitted(out: Table, rows: list[list[str]], flexible: str = "") -> Table:
    """The table with a blank line between rows of two lines, and numbers that do not wrap where there is room."""
    out.leading = 1
    fixed = [i for i, column in enumerate(out.columns) if str(column.header) != flexible]
    widths = [max(len(line) for row in rows for line in row[i].split("\n")) for i in fixed]
    if sum(widths) + 2 * len(out.columns) + (LEAST if flexible else 0) > console.width:
        return out
    for i, column in enumerate(out.columns):
        if str(column.header) == flexible:
            column.justify = "left"
        else:
            lines = [line for row in rows for line in row[i].split("\n")]
            column.width = max(len(text) for text in lines + str(column.header).split())
    return out


def list_of(statements: Sequence[str]) -> Table:
    """Statements as a list."""
    out = Table.grid(padding=(0, 1))
    for statement in statements:
        out.add_row("-", Text(statement))
    return out
