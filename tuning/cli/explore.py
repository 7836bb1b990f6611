"""`thruster explore`: a page on which one tunes a filter by hand, and sees at once what comes of it."""

from __future__ import annotations

import gc
import os
import shutil
import stat
import tempfile
import webbrowser
from contextlib import suppress
from html import escape
from pathlib import Path
from typing import Annotated

import typer

from tuning.api.evaluate import subject_of
from tuning.api.explore import NEEDS
from tuning.cli.options import (
    FILTER_HELP,
    INPUT,
    RUNS,
    BlockOptions,
    GridOptions,
    SeedOption,
    filter_option,
    problems_of,
    with_groups,
)
from tuning.cli.output import announce_compilation, working
from tuning.cli.problems import PROBLEMS
from tuning.exploring.bench import Bench
from tuning.search.storage import is_alive

FOLDER = "thruster-explore-"  # of what a browser is sent to, then the number of the process
FORWARD = '<!doctype html><meta charset="utf-8"><meta name="referrer" content="no-referrer">'
FORWARD += '<meta http-equiv="refresh" content="0; url={url}"><title>thruster explore</title>'


@with_groups
def command(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="FILE", help="Tuned file where one starts; it names filter and problem."),
    ] = None,
    filter_name: Annotated[str | None, filter_option(f"ekf by default. {FILTER_HELP}")] = None,
    scenario: Annotated[
        str | None,
        typer.Option("--problem", "--scenario", help=f"outliers by default. {PROBLEMS}", rich_help_panel=INPUT),
    ] = None,
    *,
    logs: BlockOptions,
    reading: GridOptions,
    seeds: Annotated[int, typer.Option(min=1, max=64, help="Number of runs at once.", rich_help_panel=RUNS)] = 8,
    port: Annotated[
        int, typer.Option(min=0, max=65535, help="Port of the page; 0 for a free one.", rich_help_panel=RUNS)
    ] = 0,
    browser: Annotated[
        bool, typer.Option("--browser/--no-browser", help="Whether to open the page.", rich_help_panel=RUNS)
    ] = True,
    seed: SeedOption = 0,
) -> None:
    """Tune a filter by hand on a page: move Q and R, and see at once what becomes of its estimates.

    On the left are all numbers of the filter, with the rule of thumb (R), the scaled default (S), the oracle (O)
    and the tuned file (T) marked on their sliders, and the plant's disturbances. On the right the pictures follow
    while one drags: states in their 95 % band, innovations, NEES and NIS in their expected interval, and how white
    the innovations are. An arrow at each figure says whether it is better than at the start.

    Where to begin: is the band too narrow, so that NEES and NIS lie above their interval? Then raise Q or R. Does
    the estimate lag, and are the innovations correlated? Raise Q. Does it follow each outlier? Raise R. Only the
    ratio of Q and R moves the estimate; their size moves the band: the map of the score over two of them shows it
    as a ridge. "Run" has Optuna search from where one is, "Hold" keeps a configuration beside the next one, and
    "Get" exports the tuned file, Python lines, the command or a picture.

    The page is open to this machine alone, by an address with a random token; it reads no file but those named
    here. It ends with Ctrl-C, or some seconds after its last tab was closed. It needs the extra explore: pip
    install 'thruster-env[explore]'.

    Example: thruster explore

    Example: thruster explore --problem mismatch --filter enkf

    Example: thruster explore tuned.json

    Example: thruster explore --log run1.csv --filter ekf
    """
    bench = _bench(file, filter_name, scenario, logs, reading, seed)
    try:
        from tuning.exploring.page.session import Server, page_of
    except ModuleNotFoundError as error:
        raise ValueError(NEEDS.replace("tuning.explore", "thruster explore")) from error
    announce_compilation()
    with working("compiling"):
        bench.view(bench.start, seeds)
    server = Server(page_of(bench, seeds), port=port)
    print(f"{bench.title}, until Ctrl-C or the last tab is closed:\n{server.url}", flush=True)
    gc.collect()
    gc.freeze()  # what is here stays: to look through it, once in 500 moves, took 0.14 s in mid-drag
    _remove_left_over()
    with tempfile.TemporaryDirectory(prefix=f"{FOLDER}{os.getpid()}-") as folder:
        if browser:
            webbrowser.open(_forward(Path(folder), server.url).as_uri())
        server.run()


def _bench(
    file: Path | None,
    filter_name: str | None,
    scenario: str | None,
    logs: BlockOptions,
    reading: GridOptions,
    seed: int,
) -> Bench:
    if file is None:
        (problem,) = problems_of([scenario] if scenario else None, logs, reading, "outliers")
        return Bench(problem, filter_name or "ekf", seed=seed)
    if filter_name is not None:
        raise ValueError(f"give either a tuned file or --filter NAME, but got both, {file} and {filter_name}")
    if logs.log:
        raise ValueError(f"give either a tuned file or --log, but got both, {file} and {logs.log[0]}")
    choice, problem, _ = subject_of(file, scenario, reading.preset, reading.model)
    return Bench(problem, choice.name, choice, seed)


def _forward(folder: Path, url: str) -> Path:
    """A file that leads to the page and that this user alone can read.

    A browser's command line can be read by all users of a machine, so the token must not stand there.
    """
    page = folder / "page.html"
    page.touch(mode=0o600)
    page.write_text(FORWARD.format(url=escape(url, quote=True)), encoding="utf-8")
    return page


def _remove_left_over() -> None:
    """Remove folders of this user's explorers that were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{FOLDER}*-*"):
        process = folder.name.removeprefix(FOLDER).partition("-")[0]
        with suppress(OSError):
            status = folder.lstat()
            ours = stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid()
            if ours and process.isdecimal() and not is_alive(int(process)):
                shutil.rmtree(folder, ignore_errors=True)
