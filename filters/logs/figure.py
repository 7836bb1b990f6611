"""A picture of an estimate of a log: states, outputs and innovations over time, each with its 95 % band.

The hues are near those of Okabe and Ito, with a wine red: colour-blind people can distinguish them. Filters that
are often drawn together differ in hue, and no two share both hue and dash. Truth is a wide grey line below all,
measurements are pale.

Source: Okabe, Ito (2008), "Color universal design".
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from filters.logs.estimate import SKIPPED, LogEstimate
from filters.logs.findings import LogAlarms, compared, episodes, estimated
from thruster_env.core.angles import with_breaks, wrapped
from thruster_env.core.plots import (
    BLUE,
    GREEN,
    MUSTARD,
    PALE,
    PLUM,
    RUST,
    SKY,
    TRUE,
    WINE,
    new_figure,
    save_figure,
    tidy,
)
from thruster_env.core.sources import is_array
from thruster_env.core.text_tables import TITLE, verbatim
from thruster_env.logs.columns import OUTPUT, STATE

# How each filter is drawn: one colour and one dash, the same in every picture.

SOLID, DASHED, DOTTED, BOTH, TWO_DOTS = "-", "--", ":", "-.", (0, (4, 1.5, 1, 1.5, 1, 1.5))
TRUTH: dict[str, Any] = {"color": TRUE, "linewidth": 3.0, "zorder": 1.8}  # wide, below the estimates
MEASURED: dict[str, Any] = {"color": PALE, "linewidth": 0.8}
OTHER = (GREEN, DOTTED)  # an estimator of one's own
STYLES: dict[str, tuple[str, Any]] = {
    "kf": (PLUM, SOLID),
    "kf-steady": (PLUM, DOTTED),
    "ekf": (BLUE, SOLID),
    "iekf": (MUSTARD, DASHED),
    "ukf": (SKY, BOTH),
    "ckf": (WINE, DOTTED),
    "mhe": (WINE, TWO_DOTS),
    "enkf": (RUST, SOLID),
    "etkf": (SKY, DASHED),
    "letkf": (SKY, TWO_DOTS),
    "ensrf": (WINE, BOTH),
    "denkf": (MUSTARD, BOTH),
    "ienkf": (PLUM, BOTH),
    "enkf-n": (GREEN, TWO_DOTS),
    "rhf": (RUST, TWO_DOTS),
    "pf": (GREEN, SOLID),
    "apf": (GREEN, DASHED),
    "rbpf": (MUSTARD, TWO_DOTS),
    "gsf": (PLUM, DASHED),
    "fading": (RUST, DOTTED),
    "h-infinity": (RUST, DASHED),
    "schmidt": (SKY, DOTTED),
    "imm": (BLUE, DASHED),
    "mmae": (BLUE, DOTTED),
    "fuzzy": (MUSTARD, SOLID),
    "sage-husa": (GREEN, BOTH),
    "vb": (WINE, SOLID),
    "ekf-robust": (RUST, BOTH),
    "open-loop": (MUSTARD, DOTTED),
    "low-pass": (SKY, SOLID),
    "inversion": (WINE, DASHED),
}


def plot_style(name: str) -> dict[str, Any]:
    """Colour and dash of a filter by name, as matplotlib takes them; all estimators of one's own share one."""
    colour, dashes = STYLES.get(name, OTHER)
    return {"color": colour, "linestyle": dashes}


def colour_of(name: str) -> str:
    """Colour of a filter by name."""
    return STYLES.get(name, OTHER)[0]


if TYPE_CHECKING:
    from matplotlib.figure import Figure

TWO_SIDED = 1.96
MOST_PANELS = 6  # of states and outputs
TALL, LOW, WIDTH = 1.5, 1.1, 9.0  # [inch]
ROOM = 0.6  # for title and legend [inch]
ALARM = "tab:red"
MARGIN = 0.06  # of an axis above and below what it shows
DOTS: dict[str, Any] = {"color": "0.5", "s": 4.0, "linewidths": 0, "label": "measurement", "zorder": 1.5}


def log_figure(path: str | Path, estimate: LogEstimate, title: str, alarms: LogAlarms | None = None) -> Path:
    """Save what `draw_log` draws; return the path."""
    return save_figure(draw_log(estimate, title, alarms=alarms), path)


def draw_log(estimate: LogEstimate, title: str, *, states: bool = True, alarms: LogAlarms | None = None) -> Figure:
    """Estimates beside the reference channels, and the innovations below; without `states` these alone.

    Measurements of a state or an output are dots. References come first; of many states and outputs the first six
    are drawn. Bands of the first rows, in which a filter settles from its prior, do not widen the axes. A line in
    the innovations marks the first alarm of an episode, which is shaded.
    """
    model, references, colour = estimate.model, compared(estimate), colour_of(estimate.filter.name)
    values = [f"{STATE}:{quantity.symbol}" for quantity in model.states] + [
        f"{OUTPUT}:{symbol}" for symbol in model.outputs
    ]
    plotted = sorted(values, key=lambda key: key not in references)[:MOST_PANELS]
    plotted = [key for key in values if key in plotted] if states else []
    heights = [TALL] * len(plotted) + [LOW if plotted else TALL] * len(estimate.log.measured)
    figure = new_figure((WIDTH, sum(heights) + ROOM))
    axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    tidy(axes)
    times = estimate.log.start + estimate.log.times
    labels = {f"{STATE}:{quantity.symbol}": quantity for quantity in model.states}
    labels |= {f"{OUTPUT}:{symbol}": output.quantity for symbol, output in model.outputs.items()}
    for axis, key in zip(axes, plotted, strict=False):
        mean, std = estimated(estimate, key)
        line = estimate.log.references[key] if key in references else mean
        line = wrapped(line) if labels[key].angle else line
        _limit(axis, mean, std, line)
        breaks = with_breaks if labels[key].angle else lambda *lines: lines
        if key in references:
            axis.plot(*breaks(times, line), label="reference, not seen", **TRUTH)
        for measured in _measurements_of(estimate, mean):
            axis.scatter(times, wrapped(measured) if labels[key].angle else measured, **DOTS)
        own_times, mean, std = breaks(times, mean, std)
        _band(axis, own_times, mean, std, colour)
        axis.plot(
            own_times, mean, color=colour, linewidth=1.0, label="smoother" if estimate.smoothed else "estimate"
        )
        axis.set_ylabel(labels[key].plot_label.replace(" $", "\n$"))
    for j, (axis, quantity) in enumerate(zip(axes[len(plotted) :], estimate.log.measured, strict=True)):
        std = np.sqrt(np.maximum(estimate.innovation_covs[:, j, j], 0.0))
        _band(axis, times, np.zeros_like(std), std, colour)
        _limit(axis, np.zeros_like(std), std, estimate.innovations[:, j])
        axis.plot(times, estimate.innovations[:, j], color=colour, linewidth=0.8, label="innovation")
        for episode in episodes(alarms.alarms, alarms.monitor.memory) if alarms else ():
            if episode[0].channel == j:
                span = min(alarm.since for alarm in episode), episode[-1].step
                axis.axvspan(*times[list(span)], color=ALARM, alpha=0.2, linewidth=0, zorder=0)
                axis.axvline(times[episode[0].step], color=ALARM, linewidth=1.2, label="alarm")
        axis.set_ylabel(
            f"innovation of\n{quantity.symbol}" + (f"\n[{verbatim(quantity.unit)}]" if quantity.unit else "")
        )
    axes[0].set_title(verbatim(title, most=TITLE), fontsize=11)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    named: dict[str, Any] = {}
    for axis in axes:
        handles, texts = axis.get_legend_handles_labels()
        named |= dict(zip(texts, handles, strict=True))
    figure.legend(named.values(), named, loc="outside lower center", ncols=len(named), frameon=False)
    return figure


def _measurements_of(estimate: LogEstimate, values: np.ndarray) -> list[np.ndarray]:
    """The measured channels whose component of h(x) equals a state or output, judged by some estimates."""
    model, rows = estimate.model, np.linspace(0, len(values) - 1, 40).astype(int)
    states = estimate.means[rows] if is_array(model.n) else [tuple(row) for row in estimate.means[rows].tolist()]
    try:
        expected = np.array([model.functions.observe(x, model.given_constants) for x in states])
    except (ValueError, ArithmeticError):  # of estimates at which h has no value, where Python raises
        return []
    same = np.isclose(expected, values[rows, None], rtol=1e-9, atol=1e-12, equal_nan=True).all(axis=0)
    return [estimate.log.measurements[:, j] for j in np.flatnonzero(same)]


def _band(axis, times: np.ndarray, middle: np.ndarray, std: np.ndarray, colour: str) -> None:
    low, high = middle - TWO_SIDED * std, middle + TWO_SIDED * std
    axis.fill_between(times, low, high, color=colour, alpha=0.25, linewidth=0, label="95 % band")


def _limit(axis, middle: np.ndarray, std: np.ndarray, line: np.ndarray) -> None:
    """Limit an axis to both lines and to the band after its first rows."""
    reach = TWO_SIDED * std[min(SKIPPED, len(std) // 4) :]
    ends = middle[len(std) - len(reach) :]
    limits = np.concatenate((middle, line, ends - reach, ends + reach))
    limits = limits[np.isfinite(limits)]
    if limits.size and np.ptp(limits) > 0.0:
        room = MARGIN * np.ptp(limits)
        axis.set_ylim(limits.min() - room, limits.max() + room)
