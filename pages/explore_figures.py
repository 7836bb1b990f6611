"""Make the pictures of docs/explore_scenes.md and its text, the six guided scenes of the bench.

python -m pages.explore_figures [FOLDER]
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from pages.page import digits, make_page, table
from thruster_env.numerics.plots import BLUE, DARK, RUST, new_figure, save_figure, tidy
from tuning.explore.bench import Bench
from tuning.explore.scenes import SCENES, Scene
from tuning.explore.view import View

BAND = 1.96  # half of a 95 % interval, in standard deviations
SPAN = slice(100, 351)  # steps that are drawn
SHOWN = ("NEES", "NIS")  # beside the RMSE


def draw(scene: Scene, path: Path) -> Path:
    """A scene: the state with its truth and band, the innovations and their autocorrelation, before and after."""
    figure = new_figure((9.6, 5.4))
    axes = figure.subplots(3, 2, sharex="row", sharey="row", height_ratios=(5, 3, 2))
    bench = scene.bench()
    place = [state.symbol for state in bench.states].index(scene.state)
    state, channel = bench.states[place], bench.measurements[0]
    for number, (step, column) in enumerate(zip(scene.steps, axes.T, strict=True)):
        view = scene.view(number)
        assert view.truth is not None  # scenes are of plants
        time = view.time[SPAN]
        top, middle, bottom = column
        top.plot(time, view.truth[0, SPAN, place], color=DARK, linewidth=1.0, label="truth")
        _band(top, view, place)
        top.set_title(f"{step.label}\n{_figures(view, scene.state)}", fontsize=9)
        reach = BAND * view.innovation_deviation[0, SPAN, 0]
        middle.fill_between(time, -reach, reach, color=BLUE, alpha=0.2, linewidth=0)
        middle.plot(time, view.innovation[0, SPAN, 0], ".", color=RUST, markersize=2.5)
        lags = np.arange(1, view.autocorrelation.shape[1] + 1)
        bottom.axhspan(-view.autocorrelation_band, view.autocorrelation_band, color=BLUE, alpha=0.2, linewidth=0)
        bottom.vlines(lags, 0.0, view.autocorrelation[0], color=RUST)
        middle.set_xlabel("time [s]")
        bottom.set_xlabel("lag [steps]")
    axes[0, 0].set_ylabel(f"{state.name} [{state.unit}]")
    axes[1, 0].set_ylabel(f"innovation [{channel.unit}]")
    axes[2, 0].set_ylabel("correlation")
    axes[0, 0].legend(fontsize=8, loc="best", frameon=False)
    tidy(axes.flat)
    return save_figure(figure, path)


def _band(axis, view: View, place: int) -> None:
    time, middle, reach = view.time[SPAN], view.estimate[0, SPAN, place], BAND * view.deviation[0, SPAN, place]
    axis.fill_between(time, middle - reach, middle + reach, color=BLUE, alpha=0.25, linewidth=0, label="95 % band")
    axis.plot(time, middle, color=BLUE, linewidth=1.2, label="estimate")


def _figures(view: View, symbol: str) -> str:
    names = (f"RMSE {symbol}", *SHOWN)
    told = [f"{name.split()[0]} {digits(view.figures[name].value)} {view.figures[name].unit}" for name in names]
    return ", ".join(one.removesuffix(" -") for one in told)


def figures_of(scene: Scene) -> str:
    """A table of a scene's figures at each of its steps, on eight seeds."""
    views = [scene.view(number) for number in range(len(scene.steps))]
    rows = [
        [step.label, *(digits(one.value) for name, one in view.figures.items() if name != "restarts")]
        for step, view in zip(scene.steps, views, strict=True)
    ]
    heads = [
        f"{name} [{one.unit}]" if one.unit != "-" else name
        for name, one in views[0].figures.items()
        if name != "restarts"
    ]
    return table(["", *heads], rows)


def halved() -> str:
    """Where on the map of `outliers` an EKF has half of the rule of thumb's error, or less."""
    bench = Bench(SCENES["outliers"].bench().problem)
    rule = _score(bench.view())
    rows = []
    for factor in (1, 10, 22, 100, 1000):
        values = {"R": factor * bench.start["R"]}
        view = bench.view(values)
        rows.append([digits(values["R"]), digits(_score(view)), digits(_score(view) / rule), *_consistency(view)])
    return table(["R [N^2]", "score", "over the rule of thumb's", "NEES", "NIS"], rows)


def _score(view: View) -> float:
    return next(one.value for name, one in view.figures.items() if name.startswith("score"))


def _consistency(view: View) -> list[str]:
    return [digits(view.figures[name].value) for name in SHOWN]


FIGURES = {f"explore_{name}.png": partial(draw, scene) for name, scene in SCENES.items()}
TABLES = {**{name: partial(figures_of, scene) for name, scene in SCENES.items()}, "halved": halved}


def main(arguments: Sequence[str] | None = None) -> None:
    """Draw the pictures and write the tables anew."""
    make_page(
        "explore_scenes", "pages.explore_figures", FIGURES, TABLES, (__doc__ or "").splitlines()[0], arguments
    )


if __name__ == "__main__":
    main()
