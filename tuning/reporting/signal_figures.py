"""The inputs and measurements of one run, innovations, and gain, over time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from filters.filter import Filter
from filters.logs.figure import MEASURED, colour_of
from thruster_env.core.angles import wrapped, wrapped_where
from thruster_env.core.plots import GREY, new_figure, thinned, tidy
from thruster_env.core.sources import as_value
from thruster_env.core.text_tables import TITLE, verbatim
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel
from tuning.problems.data import Data
from tuning.reporting.panels import axis_label, plotted_states
from tuning.reporting.time_figures import TWO_SIDED, WIDTH, draw_in_band, limit_innovations, line_of, one_run

if TYPE_CHECKING:
    from matplotlib.figure import Figure

HEIGHT = 1.5  # of a panel [inch]
DASHES = ("-", "--", ":", "-.")
STEP = 1e-6  # of a central difference, in standard deviations


def draw_signal(filter_: Filter, data: Data, index: int, dt: float | None) -> Figure:
    """Every measured channel of a run with the filter's prediction, and the inputs below.

    Args:
        filter_: what predicts.
        data: of a problem.
        index: which of its runs.
        dt: sample time [s]; None for an axis of steps.
    """
    found, model, one = one_run(filter_, data, index, dt), filter_.model, data.one(index)
    seen, left_out = plotted_states(model.measurements)
    given, _ = plotted_states(model.input_quantities)
    figure, axes = _rows(len(seen) + len(given), 2 * WIDTH, dt)
    measured = wrapped_where(one.measurements[0], model.shape.measurement_angles)
    colour = colour_of(filter_.name)
    for axis, j in zip(axes, seen, strict=False):
        angle = model.measurements[j].angle
        line = line_of(angle, found.time, measured[:, j])
        axis.plot(*line, label="measured", **(MEASURED | {"linewidth": 2.0}))
        expected = measured[:, j] - found.innovations[:, j]
        expected = wrapped(expected) if angle else expected
        line = line_of(angle, found.time, expected)
        axis.plot(*line, color=colour, linewidth=0.8, label="predicted before the update")
        axis.set_ylabel(axis_label(model.measurements[j]))
    for axis, i in zip(axes[len(seen) :], given, strict=True):
        time, values = thinned(found.time[:-1], one.inputs[0][:, i])
        axis.plot(time, values, color=GREY, drawstyle="steps-post", linewidth=1.2, label="input")
        axis.set_ylabel(axis_label(model.input_quantities[i]))
    _legend(figure, axes, left_out.replace("states", "channels"))
    return figure


def draw_innovations(filters: Mapping[str, Filter], data: Data, index: int, dt: float | None) -> Figure:
    """Innovations of every channel in the band that each filter expects; one column per filter."""
    channels = next(iter(filters.values())).model.measurements
    seen, left_out = plotted_states(channels)
    figure = new_figure((WIDTH * len(filters), HEIGHT * 1.2 * len(seen) + 0.8))
    axes = figure.subplots(len(seen), len(filters), squeeze=False, sharex=True)
    tidy(axes.flat)
    runs = [one_run(filter_, data, index, dt) for filter_ in filters.values()]
    for column, found, (title, filter_) in zip(axes.T, runs, filters.items(), strict=True):
        for axis, j in zip(column, seen, strict=True):
            band = TWO_SIDED * np.sqrt(found.estimates.innovation_covs[0, :, j, j])
            draw_in_band(axis, found.time, found.innovations[:, j], band, "innovation", colour_of(filter_.name))
        column[0].set_title(verbatim(title, most=TITLE), fontsize=11)
        column[-1].set_xlabel(_time(dt))
    for line, j in zip(axes, seen, strict=True):
        line[0].set_ylabel(axis_label(channels[j]))
        limit_innovations(line, runs, data.first_scored, j)
    _legend(figure, axes[:, 0], left_out.replace("states", "channels"))
    return figure


def gains(filter_: Filter, data: Data, index: int) -> np.ndarray:
    """The gain of each step of a run, (K + 1, n, m): K = P H' R^-1, NaN where nothing was measured.

    P is the covariance after the update, H the slope of the measurement at the estimate, R the assumed one. Of a
    Kalman filter this is its gain; of others it is what their covariance amounts to.

    Source: Anderson, Moore (1979), "Optimal Filtering", section 6.3.
    """
    found, model = one_run(filter_, data, index, None), filter_.model
    means, covs = found.estimates.means[0], found.estimates.covs[0]
    slopes = np.stack([_slopes(model, mean) for mean in means])  # (K + 1, m, n)
    products = slopes @ covs.transpose(0, 2, 1)  # H P', (K + 1, m, n)
    found_gains = np.linalg.solve(model.measurement_noise_cov, products).transpose(0, 2, 1)
    found_gains[np.isnan(data.one(index).measurements[0]).all(axis=1)] = np.nan
    return found_gains


def draw_gains(filters: Mapping[str, Filter], data: Data, index: int, dt: float | None, scored=None) -> Figure:
    """The gain on every state, a line per channel and a column per filter, each panel with its own axis."""
    model = next(iter(filters.values())).model
    places, left_out = plotted_states(model.states, scored)
    channels, _ = plotted_states(model.measurements)
    figure = new_figure((WIDTH * len(filters), HEIGHT * len(places) + 0.8))
    axes = figure.subplots(len(places), len(filters), squeeze=False, sharex=True)
    tidy(axes.flat)
    for column, (title, filter_) in zip(axes.T, filters.items(), strict=True):
        found = gains(filter_, data, index)
        time = (1.0 if dt is None else dt) * np.arange(len(found))
        for axis, i in zip(column, places, strict=True):
            for row, j in enumerate(channels):
                look = {"color": colour_of(filter_.name), "linestyle": DASHES[row % len(DASHES)], "linewidth": 1.0}
                axis.plot(*thinned(time, found[:, i, j]), label=f"by {model.measurements[j].text_symbol}", **look)
        column[0].set_title(verbatim(title, most=TITLE), fontsize=11)
        column[-1].set_xlabel(_time(dt))
    for axis, i in zip(axes[:, 0], places, strict=True):
        units = {_over(model.states[i], model.measurements[j]) for j in channels}
        unit = units.pop() if len(units) == 1 else "state/channel"
        axis.set_ylabel(axis_label(model.states[i]._replace(name="gain on", unit=unit)))
    figure.align_ylabels(axes[:, 0])
    _legend(figure, axes[:, 0], left_out)
    return figure


def _slopes(model: StateSpaceModel, mean: np.ndarray) -> np.ndarray:
    """Slopes of the measurements by the states at an estimate, (m, n)."""
    if not np.isfinite(mean).all():
        return np.full((model.m, model.n), np.nan)
    functions, c = model.functions, model.given_constants
    if functions.observe_jacobian is not None:
        return np.array(functions.observe_jacobian(as_value(mean.tolist()), c), dtype=float).reshape(
            model.m, model.n
        )
    columns = []
    for i, step in enumerate(STEP * model.scales):
        sides = [
            np.array(functions.observe(as_value((mean + s * step * np.eye(model.n)[i]).tolist()), c))
            for s in (1, -1)
        ]
        columns.append((sides[0] - sides[1]) / (2 * step))
    return np.stack(columns, axis=-1).reshape(model.m, model.n)


def _over(state: Quantity, channel: Quantity) -> str:
    """Unit of a gain."""
    if state.unit == channel.unit:
        return "-"
    return f"{_whole(state.unit) or '1'}/{_whole(channel.unit)}" if channel.unit else state.unit


def _whole(unit: str) -> str:
    """A unit as part of a quotient."""
    return f"({unit})" if "/" in unit or " " in unit else unit


def _time(dt: float | None) -> str:
    return "step" if dt is None else "time [s]"


def _rows(count: int, width: float, dt: float | None):
    """A figure of panels one below the other over time."""
    figure = new_figure((width, HEIGHT * count + 0.8))
    axes = figure.subplots(count, 1, squeeze=False, sharex=True)[:, 0]
    tidy(axes)
    axes[-1].set_xlabel(_time(dt))
    figure.align_ylabels(axes)
    return figure, axes


def _legend(figure, axes, left_out: str) -> None:
    named: dict[str, Any] = {}
    for axis in axes:
        handles, labels = axis.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    options = {"ncols": min(len(named), 4), "frameon": False, "title": left_out or None}
    figure.legend(named.values(), named, loc="outside lower center", **options)
