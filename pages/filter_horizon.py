"""A picture of docs/filters.md: moving-horizon estimation in a batch reactor."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from filters import make_filter, run
from pages.filter_runs import STYLES
from pages.page import legend_below, log_ticks
from pages.ranking_horizon import POSITIVE, SETTLED, assumed, batches
from thruster_env.core.plots import new_figure, save_figure, tidy

RUNS, LENGTHS = 50, (1, 2, 5, 10, 20, 30)


def reactor(path: Path) -> Path:
    """The pressure that is not measured in one batch, and its error over the horizon."""
    arguments, states = batches(RUNS)
    figure = new_figure((9.6, 3.6))
    left, right = figure.subplots(1, 2)
    tidy((left, right))
    free, within = assumed(), assumed(bounds=POSITIVE, bounded_by="projection")
    filters = {
        "ekf": ("ekf", make_filter("ekf", free)),
        "ukf, bounded": ("ukf", make_filter("ukf", within)),
        "mhe, bounded": ("mhe", make_filter("mhe", within)),
    }
    for label, (name, filter_) in filters.items():
        left.plot(run(filter_, *arguments).means[0, :, 0], label=label, **STYLES[name])
    left.plot(states[0, :, 0], label="truth", **STYLES["truth"])
    left.set_xlabel("step")
    left.set_ylabel("pressure of A")

    def error(filter_) -> float:
        errors = run(filter_, *arguments).means[:, SETTLED:, 0] - states[:, SETTLED:, 0]
        return float(np.sqrt(np.square(errors).mean()))

    by_length = [error(make_filter("mhe", within, horizon=length)) for length in LENGTHS]
    right.plot(LENGTHS, by_length, **STYLES["mhe"])
    for name, filter_ in list(filters.values())[:2]:
        right.axhline(error(filter_), **STYLES[name])
    log_ticks(right.yaxis, (0.01, 0.03, 0.1, 0.3, 1.0, 3.0))
    right.set_xlabel("horizon L of mhe [steps]")
    right.set_ylabel("RMSE from step 20 on")
    legend_below(figure, left)
    return save_figure(figure, path)
