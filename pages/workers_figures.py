"""Make the picture of docs/workers.md and its table: trials a second against workers.

    python -m pages.workers_figures [FOLDER]

The picture goes into FOLDER, docs/ by default. If there is a workers.md in it, its table between the comments
`<!-- table NAME -->` and `<!-- end -->` is written anew. It takes two or three minutes and wants an idle machine.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from pages.page import log_ticks, make_page
from pages.workers_rates import FILTERS, NOTHING, STORAGES, WAITING, WORKS, rates
from thruster_env.core.plots import BLUE, RUST, new_figure, save_figure, tidy
from thruster_env.core.text_tables import markdown_table
from thruster_env.core.threads import cores

COLOURS = dict(zip(STORAGES, (BLUE, RUST), strict=True))
MOST = 128  # workers in the picture
COUNTS = sorted({workers for work in WORKS for workers in work.workers})


def predicted(storage: str, wait: float, workers: np.ndarray) -> np.ndarray:
    """Trials a second that are to be expected where each worker has a core of its own.

    As many as the workers ask for, but no more than the storage has been seen to take.
    """
    idle = rates()[storage, NOTHING.name]
    return np.minimum(workers / (wait + 1 / idle[1]), max(idle.values()))


def throughput(path: Path) -> Path:
    """Trials a second over workers: on the cores of this machine, and with a core for each worker."""
    figure = new_figure((9.6, 4.0))
    here, elsewhere = figure.subplots(1, 2)
    for storage, colour in COLOURS.items():
        for work, dashes, mark in zip(FILTERS, ("-", "--"), ("o", "s"), strict=True):
            rate_of = rates()[storage, work.name]
            label = f"{work.name}, {storage}"
            here.plot(rate_of.keys(), rate_of.values(), dashes, marker=mark, color=colour, label=label)
        rate_of = rates()[storage, WAITING.name]
        elsewhere.plot(rate_of.keys(), rate_of.values(), "o", color=colour, label=f"measured, {storage}")
        workers = np.geomspace(1, MOST, 200)
        expected = predicted(storage, WAITING.wait, workers)
        elsewhere.plot(workers, expected, color=colour, label=f"min(K / (t + s), r), {storage}")
    for axis in (here, elsewhere):
        axis.set(xlabel="workers K [-]", ylabel="trials a second [1/s]")
    tidy([here, elsewhere])
    here.set_title(f"trials that compute, on {cores()} cores", fontsize=10)
    elsewhere.set_title(f"trials that wait t = {WAITING.wait} s", fontsize=10)
    here.set_ylim(0, 1.3 * here.get_ylim()[1])  # room for the legend
    here.set_xticks(FILTERS[0].workers)
    log_ticks(elsewhere.xaxis, (1, 2, 4, 8, 16, 32, 64, MOST))
    log_ticks(elsewhere.yaxis, (1, 2, 5, 10, 20, 50, 100, 200))
    here.legend(fontsize=8, ncols=2, loc="upper center")
    elsewhere.legend(fontsize=8)
    return save_figure(figure, path)


def trials_a_second() -> str:
    """Trials a second by what a trial does, storage and workers."""
    rows = []
    for work in WORKS:
        for storage in STORAGES:
            rate_of = rates()[storage, work.name]
            cells = [f"{rate_of[count]:.3g}" if count in rate_of else "" for count in COUNTS]
            rows.append([work.name if storage == STORAGES[0] else "", storage, *cells])
    return markdown_table(["a trial", "storage", *map(str, COUNTS)], rows)


FIGURES: dict[str, Callable[[Path], Path]] = {"workers_throughput.png": throughput}
TABLES: dict[str, Callable[[], str]] = {"trials_a_second": trials_a_second}


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    make_page("workers", "pages.workers_figures", FIGURES, TABLES, __doc__.splitlines()[0], arguments)


if __name__ == "__main__":
    main()
