"""`tuning.explore` and `thruster explore`: a page on which one tunes a filter by hand and sees the effect."""

from __future__ import annotations

import gc
import html
import os
import shutil
import tempfile
import webbrowser
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from thruster_env.core.checks import at_least, short_repr
from thruster_env.core.files import is_private
from tuning.api.evaluate import subject_of
from tuning.api.markers import RUNS, FilterOption, Model, OneProblem, Option, Preset, Seed, TunedArgument
from tuning.api.problems import problem_of
from tuning.api.progress import console_for, working
from tuning.api.result import INTERRUPTED
from tuning.api.study import Study, is_own
from tuning.exploring.bench import MOST_SEEDS, Bench
from tuning.search.storage import is_alive

if TYPE_CHECKING:
    from tuning.exploring.page.session import Server

HEIGHT = 900  # [px] in a notebook
NEEDS = "tuning.explore and thruster explore must have Bokeh: pip install 'thruster-env[explore]'"
OUTLIERS = "outliers"  # the problem, where none is named
FOLDER = "thruster-explore-"  # of what a browser is sent to, then the number of the process
FORWARD = '<!doctype html><meta charset="utf-8"><meta name="referrer" content="no-referrer">'
FORWARD += '<meta http-equiv="refresh" content="0; url={url}"><title>thruster explore</title>'


def explore(
    problem: OneProblem = None,
    filter: Annotated[Any, FilterOption] = None,
    *,
    tuned: Annotated[str | Path | Study | None, TunedArgument] = None,
    preset: Preset = None,
    model: Model = None,
    seeds: Annotated[int, Option(RUNS, least=1, most=MOST_SEEDS)] = 8,
    port: Annotated[int, Option(RUNS, least=0, most=65535)] = 0,
    browser: Annotated[bool, Option(RUNS, ("--browser/--no-browser",))] = True,
    seed: Seed = 0,
) -> Explorer:
    """Tune a filter by hand on a page: move Q and R, and see at once what becomes of its estimates.

    On the left are all numbers of the filter, with the rule of thumb (R), the scaled default (S), the oracle (O)
    and the tuned file (T) marked on their sliders, and the plant's disturbances. On the right the pictures follow
    while one drags: states in their 95 % band, innovations, NEES and NIS in their expected interval, and how white
    the innovations are. An arrow at each figure says whether it is better than at the start.

        bench = tuning.explore("outliers", filter="ekf")  # the last line of a notebook's cell shows it
        bench.serve()  # elsewhere: opens the page, until Ctrl-C

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

    Args:
        problem: name of a problem; outliers by default, or that of the tuned file. In Python also a `Problem`,
            `tuning.read_logs(...)`, a pair (model, data) of a model, or a thruster's preset, and recorded runs; or
            the tuned file or `Study` itself.
        filter: without a tuned file, the name of a filter, as `thruster filters` lists them; ekf by default. In
            Python also own numbers where one starts, as `make_filter("ekf", model)`.
        tuned: tuned file where one starts; it names filter and problem. In Python also a `Study`.
        preset: the problem of another thruster, or the present place of a tuned file's preset.
        model: the model of the logs that it was tuned on, if that is code. In Python also what makes or offers
            one.
        seeds: number of runs at once; logs are shown whole.
        port: port of the page; 0 for a free one.
        browser: whether to open the page.
        seed: seed of the study whose training seeds these are.

    Raises:
        ValueError: states the rule and the value, also without the extra `explore` when the page is shown.
    """
    if tuned is None and (
        isinstance(problem, Study) or (isinstance(problem, str | Path) and Path(problem).suffix == ".json")
    ):
        problem, tuned = None, problem
    if tuned is not None and filter is not None:
        got = f"both, {short_repr(tuned)} and {short_repr(filter)}"
        raise ValueError(f"give either a tuned file or a filter (--filter NAME), but got {got}")
    if tuned is None and not is_own(filter):
        chosen = problem_of(OUTLIERS if problem is None else problem, preset)
        return Explorer(Bench(chosen, filter or "ekf", seed=seed), seeds, port, browser)
    choice, chosen, _ = subject_of(filter if tuned is None else tuned, problem, preset, model)
    return Explorer(Bench(chosen, choice.name, choice, seed), seeds, port, browser)


class Explorer:
    """A bench and its page: shown by a notebook, or served by `serve`.

    Attributes:
        bench: what computes all that is seen, also without a page.
    """

    def __init__(self, bench: Bench, seeds: int = 8, port: int = 0, browser: bool = False):
        """Hold it; the page begins when it is shown or served."""
        self.bench, self.seeds = bench, at_least("seeds", seeds, 1, MOST_SEEDS)
        self.port, self.browser = port, browser
        self.exit_code = 0  # of the command
        self._server: Server | None = None

    def serve(self) -> None:
        """Print the page's address and serve it until Ctrl-C, or until its last tab was left a few seconds ago."""
        with working("compiling", console_for(None)):
            self.bench.view(self.bench.start, self.seeds)
        server = self._made(self.port, ends_when_left=True)
        print(f"{self.bench.title}, until Ctrl-C or the last tab is closed:\n{server.url}", flush=True)
        gc.collect()
        gc.freeze()  # what is here stays: to look through it, once in 500 moves, took 0.14 s in mid-drag
        _remove_left_over()
        with tempfile.TemporaryDirectory(prefix=f"{FOLDER}{os.getpid()}-") as folder:
            if self.browser:
                webbrowser.open(_forward(Path(folder), server.url).as_uri())
            try:
                server.run()
            except KeyboardInterrupt:
                self.exit_code = INTERRUPTED

    @property
    def url(self) -> str:
        """Where the page is, served beside what else this process does until `close`."""
        if self._server is None:
            self._server = self._made(0, ends_when_left=False).start()
        return self._server.url

    def close(self) -> None:
        """End the page that `url` or a notebook began."""
        if self._server is not None:
            self._server.stop()
            self._server = None

    def _made(self, port: int, *, ends_when_left: bool) -> Server:
        try:
            from tuning.exploring.page.session import Server, page_of
        except ModuleNotFoundError as error:
            raise ValueError(NEEDS) from error
        return Server(page_of(self.bench, self.seeds), port=port, ends_when_left=ends_when_left)

    def _repr_html_(self) -> str:
        """A notebook's output: the page in a frame."""
        where = html.escape(self.url, quote=True)
        title = html.escape(self.bench.title, quote=True)
        return f'<iframe src="{where}" title="{title}" width="100%" height="{HEIGHT}" style="border: 0"></iframe>'


def _forward(folder: Path, url: str) -> Path:
    """A file that leads to the page and that this user alone can read.

    A browser's command line can be read by all users of a machine, so the token must not stand there.
    """
    page = folder / "page.html"
    page.touch(mode=0o600)
    page.write_text(FORWARD.format(url=html.escape(url, quote=True)), encoding="utf-8")
    return page


def _remove_left_over() -> None:
    """Remove folders of this user's explorers that were killed."""
    for folder in Path(tempfile.gettempdir()).glob(f"{FOLDER}*-*"):
        process = folder.name.removeprefix(FOLDER).partition("-")[0]
        with suppress(OSError):
            if is_private(folder) and process.isdecimal() and not is_alive(int(process)):
                shutil.rmtree(folder, ignore_errors=True)
