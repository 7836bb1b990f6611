"""Compute the tables of the docs and draw their pictures: `python -m docs.scripts PAGE`.

A table stands on its page, or on that of the same name in docs/appendix, between `<!-- table NAME -->` and
`<!-- end -->`. `TABLES` of a module has its function by name, which returns Markdown; `FIGURES` that of a picture
by the file's name, which writes it to a path. The modules are the scripts in this folder, and experiments.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from filters.consistency.intervals import Interval
from thruster_env.core.files import new_figure, tidy, write_whole
from thruster_env.core.text_tables import with_tables

DOCS = Path(__file__).parents[1]
PAGES: Mapping[str, tuple[str, ...]] = {  # and the modules that make their tables and pictures
    "auv": ("docs.scripts.auv", "tuning.experiments.vehicle.tables"),
    "benchmarks": (
        *("tuning.experiments.lorenz63", "tuning.experiments.lorenz96", "tuning.experiments.range_bearing"),
        "tuning.experiments.benchmark",
    ),
    "explore_scenes": ("docs.scripts.explore",),
    "filters": ("docs.scripts.filters",),
    "gallery": ("docs.scripts.gallery",),
    "logs": ("tuning.experiments.hidden_truth",),
    "machine_code": ("docs.scripts.machine_code",),
    "methods": ("tuning.experiments.lidar",),
    "monitoring": ("tuning.experiments.faults",),
    "plant": ("docs.scripts.plant",),
    "ranking": ("docs.scripts.ranking", "docs.scripts.estimators"),
    "readme": ("docs.scripts.pictures",),
    "real_data": ("tuning.experiments.recordings.identification",),
    "tuning": ("docs.scripts.tuning", "docs.scripts.tuning_choice", "tuning.experiments.users"),
    "workers": ("docs.scripts.workers",),
}


def made_by(page: str, kind: str) -> dict[str, Callable]:
    """The functions that make a page's TABLES or FIGURES, by name."""
    modules = map(importlib.import_module, PAGES[page])
    return {name: function for module in modules for name, function in getattr(module, kind, {}).items()}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; return 1 if --check finds a table that is not that of the page."""
    parser = argparse.ArgumentParser(prog="python -m docs.scripts", description=__doc__.partition("\n")[0])
    parser.add_argument("page", nargs="?", choices=list(PAGES), metavar="PAGE")
    parser.add_argument("--table", action="append", metavar="NAME", help="only this table; may be repeated")
    parser.add_argument("--figure", action="append", metavar="FILE", help="only this picture; may be repeated")
    parser.add_argument("--out", type=Path, default=DOCS, metavar="FOLDER", help="of page and pictures [docs]")
    parser.add_argument("--check", action="store_true", help="write nothing, compare the tables with the page's")
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="recordings, which the page real_data needs")
    options = parser.parse_args(arguments)
    if options.page is None:
        print("\n".join(f"{page}: {', '.join(modules)}" for page, modules in PAGES.items()))
        return 0
    tables, figures = made_by(options.page, "TABLES"), made_by(options.page, "FIGURES")
    if options.data is not None:
        tables |= importlib.import_module(PAGES[options.page][0]).tables_from(options.data)
    for asked, known, what in ((options.table, tables, "table"), (options.figure, figures, "figure")):
        for name in set(asked or ()) - set(known):
            parser.error(f"--{what} must be one of {', '.join(known) or 'none'} on this page, but got {name}")
    everything = options.table is options.figure is None
    for name in options.figure or figures if everything or options.figure else ():
        if not options.check:
            figures[name](options.out / name)
    differing: list[str] = []
    for page in (options.out / f"{options.page}.md", options.out / "appendix" / f"{options.page}.md"):
        if not page.exists():
            continue
        for name in options.table or tables if everything or options.table else ():
            text = page.read_text(encoding="utf-8")  # written one by one, so that what is done stays
            computed = with_tables(text, {name: tables[name]})
            differing += [name] if computed != text else []
            if not options.check:
                write_whole(page, computed)
    if options.check:
        print(f"differ: {', '.join(differing) or 'none'}")
    return int(options.check and bool(differing))


def by_name(*functions: Callable[[], str]) -> dict[str, Callable[[], str]]:
    """Functions by their names."""
    return {function.__name__: function for function in functions}


def digits(value: float, count: int = 3) -> str:
    """A number to so many digits."""
    return f"{float(f'{value:.{count}g}'):.6g}"  # the detour keeps 8820 from becoming 8.82e+03


def about(value: Interval, decimals: int = 3) -> str:
    """A value with half of its interval."""
    return f"{value.value:.{decimals}f} ± {(value.high - value.low) / 2:.{decimals}f}"


def subplots(size: tuple[float, float], *shape: int, **options):
    """A figure of a size [inch] and its axes, an array of such a shape, in their common form."""
    figure = new_figure(size)
    axes = figure.subplots(*shape, **options)
    tidy(np.ravel(axes))
    return figure, axes


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
