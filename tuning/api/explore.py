"""`tuning.explore`: an interactive bench of a filter, in a browser or in a notebook."""

from __future__ import annotations

import html
from pathlib import Path
from typing import TYPE_CHECKING, Any

from thruster_env.core.checks import at_least
from tuning.api.evaluate import subject_of
from tuning.api.problems import problem_of
from tuning.api.study import Study, is_own
from tuning.exploring.bench import Bench

if TYPE_CHECKING:
    from tuning.exploring.page.session import Server

HEIGHT = 900  # [px] in a notebook
NEEDS = "tuning.explore must have Bokeh: pip install 'thruster-env[explore]'"


def explore(
    problem: Any,
    filter: Any = "ekf",
    *,
    tuned: str | Path | Study | None = None,
    seeds: int = 8,
    seed: int = 0,
    preset: str | Path | None = None,
) -> Explorer:
    """Set a filter's Q, R and other numbers by hand, and see at once what becomes of its estimates.

        bench = tuning.explore("outliers", filter="ekf")  # the last line of a notebook's cell shows it
        bench.serve()  # elsewhere: prints where the page is, until Ctrl-C

    The page is on this machine alone, and its address holds a random token without which nothing is answered.

    Args:
        problem: a name, such as "mismatch" or "auv:motion", a file that ends in .toml, "module:object", a
            `Problem`, `tuning.read_logs(...)`, or a pair (model, data) of a model, or a thruster's preset, and
            recorded runs.
        filter: name of a filter; or own numbers where one starts, as `make_filter("ekf", model)`.
        tuned: a tuned file or a `Study` where one starts, in place of a filter; by default the rule of thumb.
        seeds: number of runs at once; logs are shown whole.
        seed: of the study whose training seeds these are.
        preset: the problem of another thruster, by name or file.

    Raises:
        ValueError: states the rule and the value.
        ModuleNotFoundError: without the extra `explore`.
    """
    chosen = problem_of(problem, preset)
    if tuned is None and not is_own(filter):
        return Explorer(Bench(chosen, filter, seed=seed), seeds)
    choice, chosen, _ = subject_of(filter if tuned is None else tuned, chosen)
    return Explorer(Bench(chosen, choice.name, choice, seed), seeds)


class Explorer:
    """A bench and its page: shown by a notebook, or served by `serve`.

    Attributes:
        bench: what computes all that is seen, also without a page.
    """

    def __init__(self, bench: Bench, seeds: int = 8):
        """Hold it; the page begins when it is shown or served."""
        self.bench, self.seeds = bench, at_least("seeds", seeds, 1, 64)
        self._server: Server | None = None

    def serve(self, port: int = 0) -> None:
        """Print the page's address and serve it until Ctrl-C, or until its last tab was left a few seconds ago."""
        server = self._made(port, ends_when_left=True)
        print(server.url, flush=True)
        try:
            server.run()
        except KeyboardInterrupt:
            pass

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
            raise ModuleNotFoundError(NEEDS, name=error.name) from error
        return Server(page_of(self.bench, self.seeds), port=port, ends_when_left=ends_when_left)

    def _repr_html_(self) -> str:
        """A notebook's output: the page in a frame."""
        where = html.escape(self.url, quote=True)
        title = html.escape(self.bench.title, quote=True)
        return f'<iframe src="{where}" title="{title}" width="100%" height="{HEIGHT}" style="border: 0"></iframe>'
