"""A picture of one run over time: states, estimates, and errors or innovations in their bands."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from functools import partial
from textwrap import wrap
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from filters.engine.batch import Estimates
from filters.filter import Filter
from filters.logs.findings import MEASURED, SPARSE, TRUTH, colour_of, is_sparse
from thruster_env.core.angles import with_breaks, wrapped_where
from thruster_env.core.files import BLUE, GREY, RUST, legend_below, new_figure, thinned, tidy
from thruster_env.core.sources import as_value, is_array
from thruster_env.core.text_tables import TITLE, verbatim
from thruster_env.model.euler import displayed, displayed_deviations, displayed_quantities, measured_and_predicted
from thruster_env.model.quantities import Quantity
from thruster_env.model.shape import observation_slopes
from thruster_env.model.simulate import inputs_until
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import (
    Turn,
    innovations_of,
    leading,
    readings,
    slopes_of_stored,
    slopes_of_tangent,
    tangent_of,
)
from tuning.evaluation.runs import state_errors
from tuning.problems.data import Data, estimates_on
from tuning.reporting.page import Section, Sketchbook, Words, of_series

FAR = 20.0  # where one panel of a row reaches so many times as far as another each has its own limits
WIDEST = 4.0  # times the largest error: how much of a band is shown
ROOM = 0.08  # of what is shown, above and below
NOTE = {"xycoords": "axes fraction", "fontsize": 8, "zorder": 5}
MOST_PANELS = 6  # of states in one figure
COLUMNS = 3  # of panels side by side
LABEL_WIDTH = 18  # characters of a line beside a panel
TWO_SIDED = 1.96
WIDTH = 5.4  # of a filter [inch]
TALL, LOW = 2.0, 1.3  # relative heights of panels of values and of errors ...
UNIT, UNIT_OF_MANY = 8.0 / 6.6, 0.9  # ... in so many inches, for up to two states and for more
HEIGHT = 1.5  # of a panel [inch]
DASHES = ("-", "--", ":", "-.")


def limit_errors(
    axes: Sequence, values: Sequence[np.ndarray], bands: Sequence[np.ndarray], start: int, word: str = "RMSE"
) -> None:
    """Limits of a row of errors or innovations in their bands, symmetric, and the RMSE in each panel.

    Args:
        axes: of the row, a filter each.
        values: of each filter (K + 1,), NaN where there is none.
        bands: half widths beside them.
        start: the first scored step; earlier ones may leave the panel.
        word: for the root of the mean square.
    """
    reaches = [_reach(*pair, start) for pair in zip(values, bands, strict=True)]
    known = [reach for reach in reaches if reach > 0]
    differ = len(known) > 1 and max(known) >= FAR * min(known)
    for column, (axis, of_filter, reach) in enumerate(zip(axes, values, reaches, strict=True)):
        limit = (reach if differ else max(known, default=0.0)) * (1.0 + ROOM)
        if limit > 0:
            axis.set_ylim(-limit, limit)
        before, scored = of_filter[:start], of_filter[start:]
        scored = scored[np.isfinite(scored)]
        clipped = "; start-up is cut off" if limit > 0 and (np.abs(before) > limit).any() else ""
        note = f"{word} {np.sqrt(np.mean(scored**2)):.3g}{clipped}" if scored.size else clipped.strip("; ")
        box = {"facecolor": "white", "alpha": 0.75, "linewidth": 0, "pad": 1.0}
        axis.annotate(note, (0.995, 0.97), ha="right", va="top", bbox=box, **NOTE)
        if differ:
            axis.annotate("axes differ", (0.01, 0.97), ha="left", va="top", bbox=box, **NOTE)
        elif column:
            axis.tick_params(labelleft=False)


def limit_values(axes: Sequence, plotted: Sequence[np.ndarray], bands: Sequence[np.ndarray]) -> None:
    """One pair of limits for a row of estimates: everything shown, and at most as much again of the bands.

    Args:
        axes: of the row, a filter each.
        plotted: truth and estimates, as far as they have to be seen.
        bands: their ends.
    """
    ends = _ends(plotted)
    if ends is None:
        return
    low, high = ends
    span = high - low or abs(high) or 1.0
    edge = _ends(bands) or ends
    low, high = max(min(low, edge[0]), low - span), min(max(high, edge[1]), high + span)
    for column, axis in enumerate(axes):
        axis.set_ylim(low - ROOM * span, high + ROOM * span)
        if column:
            axis.tick_params(labelleft=False)


def _ends(series: Sequence[np.ndarray]) -> tuple[float, float] | None:
    finite = np.concatenate([values[np.isfinite(values)] for values in series])
    return (float(finite.min()), float(finite.max())) if finite.size else None


def _reach(values: np.ndarray, band: np.ndarray, start: int) -> float:
    """The range of a panel: to the largest error, and to the end of a band not far beyond."""
    (_, error), (_, width) = (_ends([np.abs(series[start:])]) or (0.0, 0.0) for series in (values, band))
    return max(error, min(width, WIDEST * error) if error > 0 else width)


def plotted_states(
    states: Sequence[Quantity] | Sequence[str], scored: Collection[int] | None = None
) -> tuple[list[int], str]:
    """Indices of the states that a figure shows, in their order, and a line with the number of those left out.

    Args:
        states: all of them.
        scored: places of those that count in the score, which come first where not all are shown; all if None.
    """
    everyone = range(len(states))
    if len(states) <= MOST_PANELS:
        return list(everyone), ""
    first = sorted(everyone, key=lambda i: scored is not None and i not in scored)[:MOST_PANELS]
    return sorted(first), f"{len(states) - MOST_PANELS} of {len(states)} states are left out"


def axis_label(quantity: Quantity) -> str:
    """Name and symbol above the unit, in lines as short as the axes of low panels have room for."""
    named = quantity.symbol in quantity.name.split()  # as "measured thrust" is
    label = verbatim(quantity.name) if named else quantity._replace(unit="").plot_label
    label = "\n".join(wrap(label, LABEL_WIDTH, break_long_words=False, break_on_hyphens=False))
    return f"{label}\n[{verbatim(quantity.unit)}]" if quantity.unit else label


if TYPE_CHECKING:
    from matplotlib.figure import Figure


class Run(NamedTuple):
    """One run of a filter, as panels draw it; truth and errors are None where there is no truth."""

    time: np.ndarray  # (K + 1,)
    truth: np.ndarray | None  # (K + 1, n)
    errors: np.ndarray | None  # (K + 1, n), of rotations [deg] on the tangent
    estimates: Estimates  # of this run alone
    innovations: np.ndarray  # (K + 1, m), NaN where nothing was measured
    means: np.ndarray  # (K + 1, n), rotations by roll, pitch and yaw [deg]
    deviations: np.ndarray  # (K + 1, n), of these
    error_deviations: np.ndarray  # (K + 1, n), of the errors


class Row(NamedTuple):
    """A row of panels, one a filter."""

    height: float
    label: str
    draw: Callable  # draw(axis, run, colour=that of the filter)
    limit: Callable  # limit(axes, runs, start) once all is drawn


def draw_estimates(
    filters: Mapping[str, Filter],
    data: Data,
    run_index: int,
    dt: float | None,
    scored: Collection[int] | None = None,
) -> Figure:
    """Truth and estimate of every state over time, and the error in its 95 % band; one column per filter.

    The panels of a row have the same limits, those of the scored steps, unless one error is far larger.

    Without truth it is the estimates, and the innovation of every channel in the band that the filter expects. Of
    many states some are shown.

    Args:
        filters: by what stands above their columns.
        data: of a problem.
        run_index: which of its runs.
        dt: sample time [s]; None for an axis of steps.
        scored: places of the states that count in the score, which come first where not all are shown.
    """
    model = next(iter(filters.values())).model
    states = model.states if data.states is None else model.states[: data.states.shape[-1]]
    states = tuple(displayed_quantities(states, leading(model.turns, len(states))))
    indices, left_out = plotted_states(states, scored)
    rows = _rows(states, indices, innovations_of(model), data.states is not None)
    heights = [row.height for row in rows]
    unit = UNIT if len(indices) <= 2 else UNIT_OF_MANY
    figure, axes = _columns(filters, len(rows), unit * sum(heights), dt, height_ratios=heights)
    _draw_rows(axes, rows, filters, data, run_index, dt)
    legend_below(figure, axes[:, 0], title=left_out or None)
    return figure


def _columns(filters: Iterable[str], rows: int, height: float, dt: float | None, **options):
    """A figure of a height [inch] with a column of panels over time per filter, below its title."""
    titles = list(filters)
    figure = new_figure((WIDTH * len(titles), height))
    axes = figure.subplots(rows, len(titles), squeeze=False, sharex=True, **options)
    tidy(axes.flat)
    for column, title in zip(axes.T, titles, strict=True):
        column[0].set_title(verbatim(title, most=TITLE), fontsize=11)
        column[-1].set_xlabel(_time(dt))
    return figure, axes


def _draw_rows(
    axes, rows: Sequence[Row], filters: Mapping[str, Filter], data: Data, index: int, dt: float | None
) -> None:
    """Draw a run of each filter into its column of panels, with one label and one pair of limits a row."""
    runs = [one_run(filter_, data, index, dt) for filter_ in filters.values()]
    for column, filtered, filter_ in zip(axes.T, runs, filters.values(), strict=True):
        for axis, row in zip(column, rows, strict=True):
            row.draw(axis, filtered, colour=colour_of(filter_.name))
    for line, row in zip(axes, rows, strict=True):
        line[0].set_ylabel(row.label)
        row.limit(line, runs, data.first_scored)
    axes[0, 0].figure.align_ylabels(axes[:, 0])


def _rows(
    states: tuple[Quantity, ...], indices: list[int], channels: tuple[Quantity, ...], has_truth: bool
) -> list[Row]:
    """Each state above its error; without truth all states, then the innovations of the channels."""
    rows = []
    for i in indices:
        draw = partial(_values, i=i, angle=states[i].angle)
        rows.append(Row(TALL, axis_label(states[i]), draw, partial(_limit_values, i=i)))
        if has_truth:
            label = axis_label(Quantity("error", "error", states[i].unit))
            rows.append(Row(LOW, label, partial(_error, i=i), partial(_limit_errors, i=i)))
    if not has_truth:
        rows += _innovation_rows(channels, plotted_states(channels)[0])
    return rows


def _innovation_rows(channels: tuple[Quantity, ...], indices: list[int]) -> list[Row]:
    return [
        Row(LOW, axis_label(channels[j]), partial(_innovation, j=j), partial(limit_innovations, j=j))
        for j in indices
    ]


def one_run(filter_: Filter, data: Data, index: int, dt: float | None) -> Run:
    """One run of a filter on some data, with errors where there is a truth; `dt` as in `draw_estimates`."""
    single, model = data.one(index), filter_.model
    estimates = estimates_on(filter_, single)
    means, covs, turns = estimates.means[0], estimates.covs[0], model.turns
    with np.errstate(invalid="ignore"):
        deviations = error_deviations = np.sqrt(np.einsum("kii->ki", covs))
    if turns:
        deviations = displayed_deviations(means, covs, turns)
        means, error_deviations = _displayed(means, turns), _in_degrees(error_deviations, turns)
    parts = means, deviations, error_deviations
    time = (1.0 if dt is None else dt) * np.arange(single.steps + 1)
    innovations = np.where(
        np.isnan(readings(single.measurements[0], model.measured_turns)), np.nan, estimates.innovations[0]
    )
    if single.states is None:
        return Run(time, None, None, estimates, innovations, *parts)
    errors, truth = state_errors(filter_, estimates, single)[0], single.known_states[0]
    known = leading(turns, truth.shape[-1])
    if known:
        errors, truth = _in_degrees(errors, known), _displayed(truth, known)
    else:
        truth = wrapped_where(truth, model.any_shape.state_angles[: truth.shape[-1]])
    return Run(time, truth, errors, estimates, innovations, *parts)


def _displayed(states: np.ndarray, turns: Sequence[Turn]) -> np.ndarray:
    return np.stack(displayed(states.T, turns), axis=-1)


def _in_degrees(errors: np.ndarray, turns: Sequence[Turn]) -> np.ndarray:
    """Errors (..., t) with the angles of rotations in degrees."""
    errors = errors.copy()
    for turn in turns:
        errors[..., turn.tangent : turn.tangent + min(turn.size, 3)] *= np.rad2deg(1.0)
    return errors


def _values(axis, filtered: Run, i: int, angle: bool, colour: str) -> None:
    mean, band = filtered.means[:, i], TWO_SIDED * filtered.deviations[:, i]
    lines = filtered.time, mean, mean - band, mean + band
    time, _, low, high = with_breaks(*lines) if angle else lines
    draw_band(axis, time, low, high, colour)
    if filtered.truth is not None:
        axis.plot(*line_of(angle, filtered.time, filtered.truth[:, i]), label="truth", **TRUTH)
    axis.plot(*line_of(angle, filtered.time, mean), color=colour, linewidth=1.0, label="estimate")


def line_of(angle: bool, time: np.ndarray, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line over time for a figure: that of an angle breaks where it jumps from one end to the other."""
    if angle:
        time, line = with_breaks(time, line)
    return thinned(time, line)


def _error(axis, filtered: Run, i: int, colour: str) -> None:
    assert filtered.errors is not None  # rows of errors are made where there is a truth
    band = TWO_SIDED * filtered.error_deviations[:, i]
    draw_in_band(axis, filtered.time, filtered.errors[:, i], band, "error of the estimate", colour)


def _innovation(axis, filtered: Run, j: int, colour: str) -> None:
    band = TWO_SIDED * np.sqrt(filtered.estimates.innovation_covs[0, :, j, j])
    draw_in_band(axis, filtered.time, filtered.innovations[:, j], band, "innovation", colour)


def _limit_values(axes, runs: Sequence[Run], start: int, i: int) -> None:
    means, ends = [filtered.means[start:, i] for filtered in runs], []
    for filtered, mean in zip(runs, means, strict=True):
        band = TWO_SIDED * filtered.deviations[start:, i]
        ends += [mean - band, mean + band]
    limit_values(axes, [*means, *(filtered.truth[:, i] for filtered in runs if filtered.truth is not None)], ends)


def _limit_errors(axes, runs: Sequence[Run], start: int, i: int) -> None:
    bands = [TWO_SIDED * filtered.error_deviations[:, i] for filtered in runs]
    limit_errors(axes, [filtered.errors[:, i] for filtered in runs if filtered.errors is not None], bands, start)


def limit_innovations(axes, runs: Sequence[Run], start: int, j: int) -> None:
    """Limits of a row of innovations of channel j."""
    bands = [TWO_SIDED * np.sqrt(filtered.estimates.innovation_covs[0, :, j, j]) for filtered in runs]
    limit_errors(axes, [filtered.innovations[:, j] for filtered in runs], bands, start, "RMS")


def draw_in_band(axis, time: np.ndarray, values: np.ndarray, band: np.ndarray, label: str, colour: str) -> None:
    """An error over time in the filter's band; of a slow sensor as dots."""
    present = ~np.isnan(values)
    sparse = is_sparse(present)
    if sparse:
        time, values, band = time[present], values[present], band[present]
    draw_band(axis, time, -band, band, colour)
    contrast = BLUE if colour == RUST else RUST  # an error never looks like the estimate
    style = SPARSE if sparse else {"linewidth": 0.9}
    axis.plot(*thinned(time, values), color=contrast, label=label, **style)


def draw_band(axis, time: np.ndarray, low: np.ndarray, high: np.ndarray, colour: str) -> None:
    """A band over time; of long series the widest of each stretch."""
    (times, below), (_, above) = thinned(time, low, np.fmin), thinned(time, high, np.fmax)
    axis.fill_between(times, below, above, color=colour, alpha=0.22, linewidth=0, label="95 % band of the filter")


def draw_signal(filter_: Filter, data: Data, index: int, dt: float | None) -> Figure:
    """Every measured channel of a run with the filter's prediction, and the inputs below.

    Args:
        filter_: what predicts.
        data: of a problem.
        index: which of its runs.
        dt: sample time [s]; None for an axis of steps.
    """
    filtered, model, single = one_run(filter_, data, index, dt), filter_.model, data.one(index)
    quantities = displayed_quantities(model.measurements, model.measured_turns)
    channels, left_out = plotted_states(quantities)
    inputs, _ = plotted_states(model.input_quantities)
    figure, axes = _signal_rows(len(channels) + len(inputs), 2 * WIDTH, dt)
    measured, expected_rows = measured_and_predicted(model, single.measurements[0], filtered.innovations)
    colour = colour_of(filter_.name)
    for axis, j in zip(axes, channels, strict=False):
        angle = quantities[j].angle
        line, dots = line_of(angle, filtered.time, measured[:, j]), {}
        if is_sparse(~np.isnan(measured[:, j])):
            dots = SPARSE
        axis.plot(*line, label="measured", **(MEASURED | {"linewidth": 2.0, "markeredgewidth": 3.0} | dots))
        line = line_of(angle, filtered.time, expected_rows[:, j])
        axis.plot(*line, color=colour, label="predicted before the update", **({"linewidth": 0.8} | dots))
        axis.set_ylabel(axis_label(quantities[j]))
    for axis, i in zip(axes[len(channels) :], inputs, strict=True):
        time, values = thinned(filtered.time[:-1], single.inputs[0][:, i])
        axis.plot(time, values, color=GREY, drawstyle="steps-post", linewidth=1.2, label="input")
        axis.set_ylabel(axis_label(model.input_quantities[i]))
    legend_below(figure, axes, 4, title=left_out.replace("states", "channels") or None)
    return figure


def draw_innovations(filters: Mapping[str, Filter], data: Data, index: int, dt: float | None) -> Figure:
    """Innovations of every channel in the band that each filter expects; one column per filter."""
    channels = innovations_of(next(iter(filters.values())).model)
    indices, left_out = plotted_states(channels)
    figure, axes = _columns(filters, len(indices), HEIGHT * 1.2 * len(indices) + 0.8, dt)
    _draw_rows(axes, _innovation_rows(channels, indices), filters, data, index, dt)
    legend_below(figure, axes[:, 0], 4, title=left_out.replace("states", "channels") or None)
    return figure


def gains(filter_: Filter, data: Data, index: int) -> np.ndarray:
    """The gain of each step of a run, (K + 1, n, m): K = P H' R^-1, NaN where nothing was measured.

    P is the covariance after the update, H the slope of the measurement at the estimate, R the assumed one. Of a
    Kalman filter this is its gain; of others it is what their covariance amounts to.

    Source: Anderson, Moore (1979), "Optimal Filtering", section 6.3.
    """
    filtered, model = one_run(filter_, data, index, None), filter_.model
    means, covs = filtered.estimates.means[0], filtered.estimates.covs[0]
    acting = inputs_until(data.one(index).inputs[0])
    slopes = np.stack([_slopes(model, mean, u) for mean, u in zip(means, acting, strict=True)])  # (K + 1, m, n)
    products = slopes @ covs.transpose(0, 2, 1)  # H P', (K + 1, m, n)
    found_gains = np.linalg.solve(model.measurement_noise_cov, products).transpose(0, 2, 1)
    measured = readings(data.one(index).measurements[0], model.measured_turns)
    found_gains[np.isnan(measured).all(axis=1)] = np.nan
    return found_gains


def draw_gains(filters: Mapping[str, Filter], data: Data, index: int, dt: float | None, scored=None) -> Figure:
    """The gain on every state, a line per channel and a column per filter, each panel with its own axis."""
    model = next(iter(filters.values())).model
    states = tangent_of(model)
    indices, left_out = plotted_states(states, scored)
    quantities = innovations_of(model)
    channels, _ = plotted_states(quantities)
    figure, axes = _columns(filters, len(indices), HEIGHT * len(indices) + 0.8, dt)
    for column, filter_ in zip(axes.T, filters.values(), strict=True):
        matrices = gains(filter_, data, index)
        time = (1.0 if dt is None else dt) * np.arange(len(matrices))
        for axis, i in zip(column, indices, strict=True):
            for row, j in enumerate(channels):
                look = {"color": colour_of(filter_.name), "linestyle": DASHES[row % len(DASHES)], "linewidth": 1.0}
                axis.plot(*thinned(time, matrices[:, i, j]), label=f"by {quantities[j].text_symbol}", **look)
    for axis, i in zip(axes[:, 0], indices, strict=True):
        units = {_over(states[i], quantities[j]) for j in channels}
        unit = units.pop() if len(units) == 1 else "state/channel"
        axis.set_ylabel(axis_label(states[i]._replace(name="gain on", unit=unit)))
    figure.align_ylabels(axes[:, 0])
    legend_below(figure, axes[:, 0], 4, title=left_out or None)
    return figure


def _slopes(model: StateSpaceModel, mean: np.ndarray, u: np.ndarray) -> np.ndarray:
    """Slopes of the measurements by errors of the state at an estimate and the input until then, (m, n)."""
    if not np.isfinite(mean).all():
        return np.full((model.m, model.t), np.nan)
    slopes, fed = observation_slopes(model.functions, model.any_shape), model.any_shape.fed(as_value(u.tolist()))
    h = slopes(as_value(mean.tolist()), as_value(model.scales), *fed, model.given_constants)
    h = np.array(h, dtype=float).reshape(model.channels, model.n)
    if model.measured_turns:
        y = model.functions.observe(as_value(mean.tolist()), *fed, model.given_constants)
        h = np.array(slopes_of_tangent(y, model.measured_turns)) @ h
    return h @ np.array(slopes_of_stored(mean, model.turns)) if model.turns else h


def _over(state: Quantity, channel: Quantity) -> str:
    if state.unit == channel.unit:
        return "-"
    return f"{_whole(state.unit) or '1'}/{_whole(channel.unit)}" if channel.unit else state.unit


def _whole(unit: str) -> str:
    """A unit as part of a quotient."""
    return f"({unit})" if "/" in unit or " " in unit else unit


def _time(dt: float | None) -> str:
    return "step" if dt is None else "time [s]"


def _signal_rows(count: int, width: float, dt: float | None):
    """A figure of panels one below the other over time."""
    figure = new_figure((width, HEIGHT * count + 0.8))
    axes = figure.subplots(count, 1, squeeze=False, sharex=True)[:, 0]
    tidy(axes)
    axes[-1].set_xlabel(_time(dt))
    figure.align_ylabels(axes)
    return figure, axes


def of_estimates(filters: Mapping[str, Filter], data: Data, index: int, dt: float | None) -> str:
    """RMSE of each filter in one run and the share of the truth, or of the innovations, in its band."""
    sentences = []
    for name, filter_ in filters.items():
        run, parts = one_run(filter_, data, index, dt), []
        values, deviations, what = _against(run)
        quantities: Sequence[Quantity] = innovations_of(filter_.model)
        if run.errors is not None:
            quantities = displayed_quantities(filter_.model.states, filter_.model.turns)
        for i in range(values.shape[-1]):
            finite = np.isfinite(values[:, i]) & np.isfinite(deviations[:, i])
            inside = np.abs(values[finite, i]) <= TWO_SIDED * deviations[finite, i]
            size = np.sqrt(np.mean(values[np.isfinite(values[:, i]), i] ** 2))
            share = f", {100 * inside.mean():.0f} % in the band" if finite.any() else ""
            parts.append(f"{quantities[i].name} {size:.3g} {quantities[i].unit}".rstrip() + share)
        sentences.append(f"{name}: {what} {'; '.join(parts)}")
    return f"{'. '.join(sentences)}."


def _against(run: Run) -> tuple[np.ndarray, np.ndarray, str]:
    """What is compared with a band: values, standard deviations and their name."""
    if run.errors is not None:
        return run.errors, run.error_deviations, "RMSE of"
    with np.errstate(invalid="ignore"):
        return (
            run.innovations,
            np.sqrt(np.einsum("kii->ki", run.estimates.innovation_covs[0])),
            "RMS innovation of",
        )


AXES = (
    "Limits are those of the scored steps, the same in a row unless its panels say otherwise; RMSE and RMS "
    "are over these steps."
)
READ = "Point at a figure to read values; drag sideways to zoom in, double-click to zoom out."


def sections_over_time(
    book: Sketchbook, filters: Mapping[str, Filter], data: Data, dt: float | None, scored: Any, where: str
) -> list[Section]:
    """The first of some runs: estimates, measured signal and, with a covariance, innovations and gain.

    Args:
        book: takes the pictures.
        filters: by title; the last one is the tuned filter.
        data: of a problem.
        dt: sample time [s]; None for an axis of steps.
        scored: places of the states that count in the score; all if None.
        where: what the run is of, in words.
    """
    tuned = list(filters.values())[-1]
    what = "Estimate and innovation, each with its" if data.states is None else "Truth, estimate and"
    caption = f"{what} 95 % band on {where}, before and after. {AXES} {READ}"
    alt = of_estimates(filters, data, 0, dt)
    remark = [] if data.states is not None else [Words(["There is no truth, so there are no errors."])]
    picture = book.picture(draw_estimates(filters, data, 0, dt, scored), caption, alt)
    sections = [Section("One run over time", [picture, *remark])]
    model = tuned.model
    turns = model.measured_turns
    channels = displayed_quantities(model.measurements, turns)
    named = [channel.name for channel in channels], [channel.unit for channel in channels]
    alt = f"Measured: {of_series(named[0], _displayed(data.one(0).measurements[0], turns), named[1])}"
    caption = f"Measurements on {where}, their prediction by the tuned filter before each update, and the inputs."
    sections.append(Section("Measured signal", [book.picture(draw_signal(tuned, data, 0, dt), caption, alt)]))
    if not tuned.has_covariance:
        return sections
    if data.states is not None:
        without = data._replace(states=None, outputs=None)
        caption = (
            f"Innovations on {where}, each in the 95 % band that the filter expects, before and after. {AXES}"
        )
        alt = of_estimates(filters, without, 0, dt)
        picture = book.picture(draw_innovations(filters, data, 0, dt), caption, alt)
        sections.append(Section("Innovations", [picture]))
    if not is_array(model.n, model.m):
        sections.append(_gain_section(book, filters, data, dt, scored, where))
    return sections


def _gain_section(book: Sketchbook, pair, data, dt, scored, where: str) -> Section:
    """The gain over time, before and after."""
    described = []
    for title, filter_ in pair.items():
        matrices, model = gains(filter_, data, 0), filter_.model
        last = [matrix for matrix in matrices if np.isfinite(matrix).all()]
        if last:
            values = ", ".join(
                f"{state.text_symbol} by {channel.text_symbol} {last[-1][i, j]:.3g}"
                for i, state in enumerate(tangent_of(model))
                for j, channel in enumerate(innovations_of(model))
            )
            described.append(f"{title}: {values} at the end")
    caption = (
        f"Gain K on {where}: the change of each state per unit of innovation, before and after tuning. It "
        "is computed from the covariance after the update, K = P H' inv(R), with H at the estimate. Each "
        "panel has its own axis."
    )
    alt = f"Gain over time. {'. '.join(described)}."
    picture = book.picture(draw_gains(pair, data, 0, dt, scored), caption, alt)
    return Section("Gain over time", [picture])
