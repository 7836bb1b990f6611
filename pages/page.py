"""What the scripts of all pages share: tables in Markdown, common parts of pictures, the command line."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

from thruster_env.core.files import write_whole
from thruster_env.core.text_tables import with_tables

DOCS = Path(__file__).parents[1] / "docs"  # where the pages and their pictures are


def digits(value: float, count: int = 3) -> str:
    """A number to so many digits."""
    return f"{float(f'{value:.{count}g}'):.6g}"  # the detour keeps 8820 from becoming 8.82e+03


def legend_below(figure, axis, columns: int = 4) -> None:
    """One legend for a whole figure, that of one of its axes."""
    figure.legend(*axis.get_legend_handles_labels(), loc="outside lower center", ncols=columns, frameon=False)


def label_grid(axes, x: str, y: str) -> None:
    """Label a grid of axes along its lower and its left side."""
    for axis in axes[-1]:
        axis.set_xlabel(x)
    for axis in axes[:, 0]:
        axis.set_ylabel(y)


def log_ticks(axis, values: Sequence[float]) -> None:
    """Make an axis logarithmic, with plain numbers at some values."""
    from matplotlib.ticker import FixedFormatter, FixedLocator, NullLocator

    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    axis.set_major_locator(FixedLocator(values))
    axis.set_major_formatter(FixedFormatter([f"{value:g}" for value in values]))
    axis.set_minor_locator(NullLocator())


def make_page(
    name: str,
    module: str,
    figures: Mapping[str, Callable[[Path], Path]],
    tables: Mapping[str, Callable[[], str]],
    about: str,
    arguments: Sequence[str] | None,
) -> None:
    """Run the command line of a page's script: draw its pictures, write its tables anew.

    Args:
        name: of the page, "plant" for plant.md.
        module: the script.
        figures: what draws each picture, by file name.
        tables: what makes each computed table, by name.
        about: one line for help.
        arguments: of the command line; those of the process if None.
    """
    parser = argparse.ArgumentParser(prog=f"python -m {module}", description=about)
    parser.add_argument("folder", nargs="?", type=Path, default=DOCS, metavar="FOLDER")
    folder = parser.parse_args(arguments).folder
    for file_name, draw in figures.items():
        draw(folder / file_name)
    page = folder / f"{name}.md"
    if page.exists():
        write_whole(page, with_tables(page.read_text(), tables))
