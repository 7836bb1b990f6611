"""The papers' paths in three dimensions: one run of each, truth and estimates."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from filters.logs.figure import TRUTH as TRUTH_LOOK
from filters.logs.figure import plot_style
from thruster_env.core.checks import at_least
from thruster_env.core.plots import BLUE, GREEN, PLUM, SKY, new_figure, save_figure
from tuning.experiments import ngatini2017, ngatini2019
from tuning.experiments.vehicle.estimators import Estimator, ensembles, full_pose, fuzzy, planar_pose
from tuning.experiments.vehicle.experiment import PATHS, estimate, keys_of, true_runs
from tuning.experiments.vehicle.models import DT

TRUTH = "truth"
STYLES = {
    TRUTH: TRUTH_LOOK,
    "EnKF8 N=50": plot_style("enkf") | {"linewidth": 1.4},
    "EnKF8 N=100": {"color": GREEN, "linewidth": 1.2, "linestyle": (0, (6, 3))},
    "EnKF8 N=200": {"color": SKY, "linewidth": 1.2, "linestyle": (0, (3, 3))},
    "EnKF8 N=300": {"color": PLUM, "linewidth": 1.2, "linestyle": (0, (1, 2))},
    "EnKF8 N=50 by yaw alone": {"color": BLUE, "linewidth": 1.4, "linestyle": (0, (4, 2))},
    "fuzzy 0..1": plot_style("fuzzy") | {"linewidth": 1.2, "linestyle": (0, (1, 1))},
}
LEAST_SPAN = 2.0  # of an axis [m]: millimetres of a straight path are no shape
EVERY = 20  # steps between points of a line


class PathRun(NamedTuple):
    """One run of a path."""

    path: str
    time: np.ndarray  # (T,) [s]
    positions: dict[str, np.ndarray]  # x, y, z [m] by what they are, (T, 3)


def path_run(path: str, estimators: Sequence[Estimator], *, seed: int = 0, steps: int | None = None) -> PathRun:
    """The first of the runs that the study makes with the same seed, every 20 ms of it."""
    inputs, keys = PATHS[path].inputs(steps), keys_of(path, 1, at_least("seed", seed, 0))
    truth = true_runs("vehicle", keys, inputs)
    positions = {TRUTH: truth.states[0, :, 9:]}
    for estimator in estimators:
        means = estimate(estimator, truth, keys, inputs)[0].means
        pose = full_pose(means[..., :6], means[..., 6:] if estimator.has_attitude else None, DT)
        positions[estimator.label] = pose[0, :, :3]
        if estimator is estimators[0]:
            positions[f"{estimator.label} by yaw alone"] = planar_pose(means[..., :6], DT)[0, :, :3]
    thinned = {label: line[::EVERY] for label, line in positions.items()}
    return PathRun(path, DT * np.arange(len(inputs) + 1)[::EVERY], thinned)


def path_runs(paper: str, *, seed: int = 0, steps: int | None = None) -> list[PathRun]:
    """One run of every path that a paper shows."""
    if paper == ngatini2019.PAPER.name:
        return [path_run("IV", ensembles(8)[:-1], seed=seed, steps=steps)]
    both = [ensembles(8, members=(ngatini2017.MEMBERS,))[0], fuzzy()[0]]
    return [path_run(path, both, seed=seed, steps=steps) for path in PATHS]


def paths_figure(path: str | Path, runs: Sequence[PathRun]) -> Path:
    """Paths to the north, to the east and down as PNG, a panel each."""
    columns = min(3, len(runs))
    rows = -(-len(runs) // columns)
    side = 4.2 if columns > 1 else 7.0
    figure = new_figure((side * columns + 0.5, 0.84 * side * rows + 0.4))
    figure.get_layout_engine().set(
        rect=(0.0, 0.0, 1.0 - 0.5 / figure.get_figwidth(), 1.0)
    )  # labels of depth stick out
    for panel, run in enumerate(runs, start=1):
        axis = figure.add_subplot(rows, columns, panel, projection="3d")
        for label, line in run.positions.items():
            axis.plot(*line.T, label=label, **STYLES[label])
        _arrange(axis, np.concatenate(list(run.positions.values())))
        meaning = PATHS[run.path].meaning
        axis.set_title(run.path if run.path == meaning else f"{run.path}: {meaning}", fontsize=11, y=0.94)
    handles, labels = axis.get_legend_handles_labels()
    if rows * columns > len(runs):
        corner = figure.add_subplot(rows, columns, rows * columns)
        corner.axis("off")
        corner.legend(handles, labels, loc="center", frameon=False)
    else:
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
    return save_figure(figure, path)


def _arrange(axis, points: np.ndarray) -> None:
    """Labels, limits with a least span, depth downwards."""
    from matplotlib.ticker import MaxNLocator

    low, high = points.min(axis=0), points.max(axis=0)
    middle, half = (low + high) / 2, np.maximum(1.04 * (high - low), LEAST_SPAN) / 2
    (north, east, down) = zip(middle - half, middle + half, strict=True)
    axis.set(xlabel="north [m]", ylabel="east [m]", zlabel="down [m]", xlim=north, ylim=east, zlim=down[::-1])
    for each in (axis.xaxis, axis.yaxis, axis.zaxis):
        each.set_major_locator(MaxNLocator(5))
        each.set_pane_color((0.97, 0.97, 0.97))
        each._axinfo["grid"].update(color="#dddddd", linewidth=0.6)
    axis.tick_params(labelsize=8, pad=0)
    axis.set_box_aspect((4, 4, 3), zoom=0.95)  # or the label of depth is cut off
    axis.patch.set_visible(False)  # or it lies over that of the panel to the left
    axis.view_init(elev=24, azim=-58)
