"""A picture of one run over time: states, estimates, and errors or innovations in their bands."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from filters.engine.batch import Estimates, run
from filters.filter import Filter
from filters.logs.figure import TRUTH, colour_of
from thruster_env.core.angles import with_breaks, wrapped_where
from thruster_env.core.plots import BLUE, RUST, new_figure, save_figure, thinned, tidy
from thruster_env.core.text_tables import TITLE, verbatim
from thruster_env.model.quantities import Quantity
from tuning.evaluation.runs import state_errors
from tuning.problems.data import Data
from tuning.reporting.limits import limit_errors, limit_values
from tuning.reporting.panels import axis_label, plotted_states

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TWO_SIDED = 1.96
WIDTH = 5.4  # of a filter [inch]
TALL, LOW = 2.0, 1.3  # relative heights of panels of values and of errors ...
UNIT, UNIT_OF_MANY = 8.0 / 6.6, 0.9  # ... in so many inches, for up to two states and for more


class Run(NamedTuple):
    """One run of a filter, as panels draw it; truth and errors are None where there is no truth."""

    time: np.ndarray  # (K + 1,)
    truth: np.ndarray | None  # (K + 1, n)
    errors: np.ndarray | None  # (K + 1, n)
    estimates: Estimates  # of this run alone
    innovations: np.ndarray  # (K + 1, m), NaN where nothing was measured


class Row(NamedTuple):
    """A row of panels, one a filter."""

    height: float
    label: str
    draw: Callable  # draw(axis, run, colour=that of the filter)
    limit: Callable  # limit(axes, runs, start) once all is drawn


def estimates_figure(path: str | Path, filters: Mapping[str, Filter], data: Data, *arguments, **options) -> Path:
    """Save what `draw_estimates` draws."""
    return save_figure(draw_estimates(filters, data, *arguments, **options), path)


def draw_estimates(
    filters: Mapping[str, Filter],
    data: Data,
    run_index: int,
    dt: float | None,
    scored: Collection[int] | None = None,
    **options,
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
        **options: of matplotlib's `subplots`.
    """
    model = next(iter(filters.values())).model
    states = model.states if data.states is None else model.states[: data.states.shape[-1]]
    places, left_out = plotted_states(states, scored)
    rows = _rows(states, places, model.measurements, data.states is not None)
    heights = [row.height for row in rows]
    unit = UNIT if len(places) <= 2 else UNIT_OF_MANY
    figure = new_figure((WIDTH * len(filters), unit * sum(heights)))
    options = {"sharex": True, "height_ratios": heights, **options}
    axes = figure.subplots(len(rows), len(filters), squeeze=False, **options)
    tidy(axes.flat)
    runs = [one_run(filter_, data, run_index, dt) for filter_ in filters.values()]
    for column, found, (title, filter_) in zip(axes.T, runs, filters.items(), strict=True):
        for axis, row in zip(column, rows, strict=True):
            row.draw(axis, found, colour=colour_of(filter_.name))
        column[0].set_title(verbatim(title, most=TITLE), fontsize=11)
        column[-1].set_xlabel("step" if dt is None else "time [s]")
    for line, row in zip(axes, rows, strict=True):
        line[0].set_ylabel(row.label)
        row.limit(line, runs, data.first_scored)
    figure.align_ylabels(axes[:, 0])
    named: dict[str, Any] = {}
    for axis in axes[:, 0]:
        handles, labels = axis.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    options = {"ncols": len(named), "frameon": False, "title": left_out or None}
    figure.legend(named.values(), named, loc="outside lower center", **options)
    return figure


def _rows(
    states: tuple[Quantity, ...], places: list[int], channels: tuple[Quantity, ...], has_truth: bool
) -> list[Row]:
    """Each state above its error; without truth all states, then the innovations of the channels."""
    rows = []
    for i in places:
        rows.append(
            Row(
                TALL,
                axis_label(states[i]),
                partial(_values, i=i, angle=states[i].angle),
                partial(_limit_values, i=i),
            )
        )
        if has_truth:
            label = axis_label(Quantity("error", "error", states[i].unit))
            rows.append(Row(LOW, label, partial(_error, i=i), partial(_limit_errors, i=i)))
    if not has_truth:
        seen, _ = plotted_states(channels)
        rows += [
            Row(LOW, axis_label(channels[j]), partial(_innovation, j=j), partial(limit_innovations, j=j))
            for j in seen
        ]
    return rows


def one_run(filter_: Filter, data: Data, index: int, dt: float | None) -> Run:
    """One run of a filter on some data, with errors where there is a truth; `dt` as in `draw_estimates`."""
    one = data.one(index)
    estimates = run(filter_, one.filter_keys, one.inputs, one.measurements)
    time = (1.0 if dt is None else dt) * np.arange(one.steps + 1)
    innovations = np.where(np.isnan(one.measurements[0]), np.nan, estimates.innovations[0])
    if one.states is None:
        return Run(time, None, None, estimates, innovations)
    errors = state_errors(filter_, estimates, one)[0]
    truth = wrapped_where(one.known_states[0], filter_.model.shape.state_angles[: one.known_states.shape[-1]])
    return Run(time, truth, errors, estimates, innovations)


def _values(axis, found: Run, i: int, angle: bool, colour: str) -> None:
    mean, band = found.estimates.means[0, :, i], TWO_SIDED * np.sqrt(found.estimates.covs[0, :, i, i])
    lines = found.time, mean, mean - band, mean + band
    time, _, low, high = with_breaks(*lines) if angle else lines
    draw_band(axis, time, low, high, colour)
    if found.truth is not None:
        axis.plot(*line_of(angle, found.time, found.truth[:, i]), label="truth", **TRUTH)
    axis.plot(*line_of(angle, found.time, mean), color=colour, linewidth=1.0, label="estimate")


def line_of(angle: bool, time: np.ndarray, line: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A line over time for a figure: that of an angle breaks where it jumps from one end to the other."""
    if angle:
        time, line = with_breaks(time, line)
    return thinned(time, line)


def _error(axis, found: Run, i: int, colour: str) -> None:
    assert found.errors is not None  # rows of errors are made where there is a truth
    band = TWO_SIDED * np.sqrt(found.estimates.covs[0, :, i, i])
    draw_in_band(axis, found.time, found.errors[:, i], band, "error of the estimate", colour)


def _innovation(axis, found: Run, j: int, colour: str) -> None:
    band = TWO_SIDED * np.sqrt(found.estimates.innovation_covs[0, :, j, j])
    draw_in_band(axis, found.time, found.innovations[:, j], band, "innovation", colour)


def _limit_values(axes, runs: Sequence[Run], start: int, i: int) -> None:
    means, ends = [found.estimates.means[0, start:, i] for found in runs], []
    for found, mean in zip(runs, means, strict=True):
        band = TWO_SIDED * np.sqrt(found.estimates.covs[0, start:, i, i])
        ends += [mean - band, mean + band]
    limit_values(axes, [*means, *(found.truth[:, i] for found in runs if found.truth is not None)], ends)


def _limit_errors(axes, runs: Sequence[Run], start: int, i: int) -> None:
    bands = [TWO_SIDED * np.sqrt(found.estimates.covs[0, :, i, i]) for found in runs]
    limit_errors(axes, [found.errors[:, i] for found in runs if found.errors is not None], bands, start)


def limit_innovations(axes, runs: Sequence[Run], start: int, j: int) -> None:
    """Limits of a row of innovations of channel j."""
    bands = [TWO_SIDED * np.sqrt(found.estimates.innovation_covs[0, :, j, j]) for found in runs]
    limit_errors(axes, [found.innovations[:, j] for found in runs], bands, start, "RMS")


def draw_in_band(axis, time: np.ndarray, values: np.ndarray, band: np.ndarray, label: str, colour: str) -> None:
    """An error over time in the filter's band."""
    draw_band(axis, time, -band, band, colour)
    own = BLUE if colour == RUST else RUST  # an error never looks like the estimate
    axis.plot(*thinned(time, values), color=own, linewidth=0.9, label=label)


def draw_band(axis, time: np.ndarray, low: np.ndarray, high: np.ndarray, colour: str) -> None:
    """A band over time; of long series the widest of each stretch."""
    (times, below), (_, above) = thinned(time, low, np.fmin), thinned(time, high, np.fmax)
    axis.fill_between(times, below, above, color=colour, alpha=0.22, linewidth=0, label="95 % band of the filter")
