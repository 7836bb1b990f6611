"""Pictures and tables of docs/explore_scenes.md, the six guided scenes of the bench."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np

from docs.scripts import digits, subplots
from thruster_env.core.files import BLUE, DARK, RUST, legend_below, save_figure
from thruster_env.core.text_tables import markdown_table
from tuning.exploring.bench import SCENES, Scene
from tuning.exploring.view import View

BAND = 1.96  # half of a 95 % interval, in standard deviations
SPAN = slice(100, 351)  # steps that are drawn
SHOWN = ("NEES", "NIS")  # beside the RMSE
NOT_ON_PAGE = ("restarts", "log score", "log-likelihood")


def draw(scene: Scene, path: Path) -> Path:
    """A scene on one seed: the state with its truth, its error and the innovations with their bands."""
    figure, axes = subplots((9.6, 5.8), 3, 2, sharex=True, sharey="row", height_ratios=(4, 3, 3))
    bench = scene.bench()
    index = [state.symbol for state in bench.states].index(scene.state)
    state, channel = bench.states[index], bench.measurements[0]
    for number, (step, column) in enumerate(zip(scene.steps, axes.T, strict=True)):
        view = scene.view(number)
        assert view.truth is not None  # scenes are of plants
        time, truth, estimate = view.time[0, SPAN], view.truth[0, SPAN, index], view.estimate[0, SPAN, index]
        column[0].plot(time, truth, color=DARK, linewidth=1.0, label="truth")
        column[0].plot(time, estimate, color=BLUE, linewidth=1.2, label="estimate")
        column[0].set_title(f"{step.label}\n{_figures(view, scene.state)}", fontsize=9)
        _band(column[1], time, view.deviation[0, SPAN, index])
        column[1].plot(time, estimate - truth, color=BLUE, linewidth=1.0)
        _band(column[2], time, view.innovation_deviation[0, SPAN, 0])
        column[2].plot(time, view.innovation[0, SPAN, 0], ".", color=RUST, markersize=2.5)
        column[2].set_xlabel("time [s]")
    labels = (state.name, state.unit), ("its error", state.unit), ("innovation", channel.unit)
    for axis, (label, unit) in zip(axes[:, 0], labels, strict=True):
        axis.set_ylabel(f"{label} [{unit}]", fontsize=9)
    legend_below(figure, axes[:2, 0], fontsize=9)
    return save_figure(figure, path)


def _band(axis, time: np.ndarray, deviation: np.ndarray) -> None:
    reach = BAND * deviation
    axis.fill_between(time, -reach, reach, color=BLUE, alpha=0.25, linewidth=0, label="95 % band")


def _figures(view: View, symbol: str) -> str:
    names = (f"RMSE {symbol}", *SHOWN)
    texts = [f"{name.split()[0]} {digits(view.figures[name].value)} {view.figures[name].unit}" for name in names]
    return ", ".join(text.removesuffix(" -") for text in texts)


def figures_of(scene: Scene) -> str:
    """A table of a scene's figures at each of its steps, on eight seeds."""
    views = [scene.view(number) for number in range(len(scene.steps))]
    rows = [
        [step.label, *(digits(figure.value) for name, figure in view.figures.items() if name not in NOT_ON_PAGE)]
        for step, view in zip(scene.steps, views, strict=True)
    ]
    heads = [
        f"{name} [{figure.unit}]" if figure.unit != "-" else name
        for name, figure in views[0].figures.items()
        if name not in NOT_ON_PAGE
    ]
    return markdown_table(["", *heads], rows)


FIGURES = {f"explore_{name}.png": partial(draw, scene) for name, scene in SCENES.items()}
TABLES = {
    **{name: partial(figures_of, scene) for name, scene in SCENES.items()},
}
