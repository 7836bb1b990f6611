"""Picture and table of the fuzzy filters in docs/filters.md: how rules are blended, beside `kf` and `ekf`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from filters import FuzzyKalmanFilter, StateSpaceModel, make_filter, run, thruster_model
from filters.consistency.intervals import Interval, rmse_ratios
from filters.filter import Filter
from filters.gaussian.mixtures import BLENDINGS
from pages.filter_gaussian import FLOW, FLOW_RMSE
from pages.filter_runs import STYLES, Runs, errors_of, held_runs, nees, times
from pages.page import digits, legend_below, log_ticks
from thruster_env.core.plots import DARK, SKY, new_figure, save_figure, tidy
from thruster_env.core.text_tables import markdown_table
from thruster_env.thruster.linear.analysis import steady_state
from thruster_env.thruster.parameters import PRESETS
from tuning.problems.data import FIRST_SCORED_STEP

CENTRE = 12.0  # [V]
SHOWN_WIDTH = 12.0  # [V], of the run that is drawn
WIDTHS = (1.0, 2.0, 4.0, 6.0, 9.0, SHOWN_WIDTH, 16.0, 20.0, 24.0)  # [V]
TABLE_WIDTHS = (2.0, 6.0, 12.0)  # [V]
BLENDING_LOOKS = {
    "weights": STYLES["fuzzy"],
    "moments": {"color": SKY},
    "output": {"color": DARK, "linestyle": ":"},
}


def picture(path: Path) -> Path:
    """The fuzzy filters over the width of the range that their rules span, and a run."""
    figure = new_figure((9.6, 3.8))
    left, right = figure.subplots(1, 2, width_ratios=(2, 3))
    tidy((left, right))
    looks = {f"fuzzy, {blending}": look for blending, look in BLENDING_LOOKS.items()}
    looks |= {name: STYLES[name] for name in ("kf", "ekf")}
    errors = {label: [] for label in looks}
    for width in WIDTHS:
        model, runs = _about_the_centre(width, 20)
        filters = {f"fuzzy, {blending}": _fuzzy(model, width, blending=blending) for blending in BLENDINGS}
        filters |= {name: make_filter(name, model) for name in ("kf", "ekf")}
        for label, filter_ in filters.items():
            errors[label].append(errors_of(filter_, runs)[1])
            if width == SHOWN_WIDTH:
                estimate = run(filter_, *runs.arguments).means[0, :, 1]
                right.plot(times(len(estimate)), estimate, **looks[label])
        if width == SHOWN_WIDTH:
            right.plot(times(501), runs.states[0, :, 1], **STYLES["truth"])
    for label, values in errors.items():
        left.plot(WIDTHS, values, label=label, **looks[label])
    left.plot([], [], label="truth", **STYLES["truth"])
    log_ticks(left.yaxis, (0.03, 0.1, 0.3, 1, 3, 10))
    left.set_xlabel("width of the voltages' range about 12 V [V]")
    left.set_ylabel(FLOW_RMSE)
    right.set_title("levels from 6 to 18 V", fontsize=10)
    right.set_xlabel("time [s]")
    right.set_ylabel(FLOW)
    legend_below(figure, left, 6)
    return save_figure(figure, path)


def fuzzy() -> str:
    """The blendings on the same runs: RMSE, over that of the sources' recursion, and NEES."""
    rows = []
    for width in TABLE_WIDTHS:
        model, runs = _about_the_centre(width)
        low, high = CENTRE - width / 2, CENTRE + width / 2
        filters = {f"`{blending}`": _fuzzy(model, width, blending=blending) for blending in BLENDINGS}
        filters["`weights`, no offsets"] = _fuzzy(model, width, blending="weights", offsets=False)
        rows += _rows(f"{low:g} to {high:g} V", model, runs, filters)
    model, runs = thruster_model(), held_runs()
    filters = {f"`{blending}`": FuzzyKalmanFilter(model=model, blending=blending) for blending in BLENDINGS}
    filters["`weights`, no offsets"] = FuzzyKalmanFilter(model=model, offsets=False)
    rows += _rows("-12 to 12 V", model, runs, filters)
    over = "over `weights`"
    return markdown_table(["levels", "filter", "omega_m [rad/s]", over, "U_a [m/s]", over, "NEES"], rows)


def _rows(name: str, model: StateSpaceModel, runs: Runs, filters: dict[str, Filter]) -> list[list[str]]:
    filters = filters | {f"`{other}`": make_filter(other, model) for other in ("kf", "ekf")}
    rows, first = [], None
    for label, filter_ in filters.items():
        estimates = run(filter_, *runs.arguments)
        errors = (estimates.means - runs.states)[:, FIRST_SCORED_STEP:]
        squares = (errors**2).mean(axis=1)  # of each run, (B, 2)
        cells = [name if first is None else "", label]
        ratios = ("", "") if first is None else map(_about, rmse_ratios(squares, first))
        for rmse, ratio in zip(np.sqrt(squares.mean(axis=0)), ratios, strict=True):
            cells += [digits(rmse), ratio]
        rows.append([*cells, digits(nees(estimates, runs))])
        first = squares if first is None else first
    return rows


def _about(ratio: Interval) -> str:
    return f"{ratio.value:.3f} ± {(ratio.high - ratio.low) / 2:.3f}"


def _about_the_centre(width: float, *count: int) -> tuple[StateSpaceModel, Runs]:
    """A model and runs whose levels span a width [V] about the centre, from its steady state on."""
    start = {"voltage": CENTRE}
    runs = held_runs(*count, amplitude=width / 2, centre=CENTRE, initial_state=start)
    return thruster_model(initial_state=start), runs


def _fuzzy(model: StateSpaceModel, width: float, **choices) -> FuzzyKalmanFilter:
    low, high = (steady_state(PRESETS["tunnel"], CENTRE + sign * width / 2)[:2] for sign in (-1, 1))
    return FuzzyKalmanFilter(model=model, low=low, high=high, **choices)
