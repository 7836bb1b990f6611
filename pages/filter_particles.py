"""A picture of docs/filters.md: particles for all states or for one, drawn blindly or aimed."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from filters import make_filter, run
from pages.filter_runs import STYLES
from pages.page import log_ticks
from thruster_env.core.plots import BLUE, DARK, new_figure, save_figure, tidy
from tuning.experiments import mixed_linear

SIZES = (20, 50, 100, 200, 500, 1000, 2000, 5000)
RUNS = 200
SENSORS = ((0.1, "R = 0.1"), (1e-3, "R = 0.001"))
KINDS = {
    "pf": ("pf", {}, STYLES["pf"]),
    "pf, optimal proposal": ("pf", {"proposal": "optimal"}, {"color": BLUE, "linestyle": "-"}),
    "pf, gaussian": (
        "pf",
        {"resampling": "gaussian", "resampling_threshold": 1.0},
        {"color": BLUE, "linestyle": "--"},
    ),
    "rbpf": ("rbpf", {}, STYLES["rbpf"] | {"linestyle": "-"}),
}


def kinds(path: Path) -> Path:
    """RMSE of s over N on the model that is linear where s is known, with poor and with accurate sensors."""
    figure = new_figure((9.6, 3.6))
    axes = figure.subplots(1, 2)
    tidy(axes)
    for axis, (variance, title) in zip(axes, SENSORS, strict=True):
        problem = mixed_linear.problem_of(mixed_linear.model(variance))
        data, model = problem.data(range(RUNS)), problem.model()

        def error(filter_, data=data) -> float:
            estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
            return float(np.sqrt(np.square((estimates.means - data.states)[:, data.late, 0]).mean()))

        for label, (name, numbers, look) in KINDS.items():
            errors = [error(make_filter(name, model, ensemble_size=size, **numbers)) for size in SIZES]
            axis.plot(SIZES, errors, label=label, **look)
        axis.axhline(error(make_filter("ukf", model)), color=DARK, linestyle=":", label="ukf")
        log_ticks(axis.xaxis, SIZES)
        axis.set_title(title, fontsize=10)
        axis.set_xlabel("particles N")
    axes[0].set_ylabel("RMSE of s [-]")
    axes[0].set_ylim(0.44, 0.62)
    axes[1].set_ylim(0.13, 0.26)
    axes[0].legend(fontsize=8, frameon=False)
    return save_figure(figure, path)
