"""Compute the tables of the docs and draw their pictures: `python -m docs.scripts PAGE`.

A table stands on its page, or on that of the same name in docs/appendix, between `<!-- table NAME -->` and
`<!-- end -->`. `TABLES` of a module has its function by name, which returns Markdown; `FIGURES` that of a picture
by the file's name, which writes it to a path. The modules are scripts in this folder, and a page's experiments.
"""

from __future__ import annotations

import argparse
import importlib
from collections.abc import Callable, Sequence
from pathlib import Path

import gymnasium as gym
import numpy as np

from filters.consistency.nees import Interval
from thruster_env.core.files import new_figure, tidy, write_whole
from thruster_env.core.text_tables import with_tables
from tuning.experiments import EXPERIMENTS

DOCS = Path(__file__).parents[1]
SCRIPTS = {  # of this folder, by page; experiments name theirs
    "attitude": ("attitude",),
    "auv": ("auv",),
    "explore_scenes": ("explore",),
    "filters": ("filters",),
    "gallery": ("gallery",),
    "machine_code": ("machine_code",),
    "plant": ("plant",),
    "q_and_r": ("q_and_r",),
    "ranking": ("ranking", "estimators"),
    "readme": ("pictures",),
    "tuning": ("tuning", "tuning_choice"),
}


def modules_by_page() -> dict[str, list[str]]:
    """The modules that make tables and pictures, by page."""
    pages = {page: [f"docs.scripts.{name}" for name in names] for page, names in SCRIPTS.items()}
    for experiment in EXPERIMENTS.values():
        module = f"tuning.experiments.{experiment.module}"
        if experiment.page and module not in pages.setdefault(experiment.page, []):
            pages[experiment.page].append(module)
    return dict(sorted(pages.items()))


PAGES = modules_by_page()


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
    parser.add_argument("--data", type=Path, metavar="FOLDER", help="recordings, of attitude and real_data")
    options = parser.parse_args(arguments)
    if options.page is None:
        print("\n".join(f"{page}: {', '.join(modules)}" for page, modules in PAGES.items()))
        return 0
    tables, figures = made_by(options.page, "TABLES"), made_by(options.page, "FIGURES")
    if options.data is not None:
        for module in map(importlib.import_module, PAGES[options.page]):
            tables |= module.tables_from(options.data) if hasattr(module, "tables_from") else {}
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


def save_frame(env, path: Path) -> Path:
    """Write what an env shows as a PNG file, and close the env."""
    from matplotlib.image import imsave

    picture = env.render()
    env.close()
    write_whole(path, lambda stream: imsave(stream, picture, format="png"))
    return path


def returns_of(env, controller, idle: Sequence[float], seed: int = 0) -> np.ndarray:
    """The return (N,) of the first episode of each copy of a vector env, which no copy may end before its time.

    Args:
        env: with N copies.
        controller: what acts; None for a constant action.
        idle: that action.
        seed: of the first copy.
    """
    observations, _ = env.reset(seed=seed)
    action, state, total = np.tile(np.float32(idle), (env.num_envs, 1)), None, np.zeros(env.num_envs)
    for _ in range(gym.spec(env.spec.id).max_episode_steps):
        if controller is not None:
            action, state = controller.predict(observations, state)
        observations, rewards, terminated, *_ = env.step(action)
        if terminated.any():
            raise RuntimeError(f"no episode of {env.spec.id} may end early, but one did")
        total += rewards
    return total


def subplots(size: tuple[float, float], *shape: int, **options):
    """A figure of a size [inch] and its axes, an array of such a shape, in their common form."""
    figure = new_figure(size)
    axes = figure.subplots(*shape, **options)
    tidy(np.ravel(axes))
    return figure, axes


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
