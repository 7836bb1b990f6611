"""A picture of an estimate of a log: states, outputs and innovations over time, each with its 95 % band."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from filters.logs.estimate import SKIPPED, LogEstimate
from filters.logs.findings import compared, estimated
from filters.looks import TRUTH, colour_of
from numerics.plots import new_figure, save_figure, tidy
from plants.logs.columns import OUTPUT, STATE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TWO_SIDED = 1.96
MOST_PANELS = 6  # of states and outputs
TALL, LOW, WIDTH = 1.5, 1.1, 9.0  # [inch]
ROOM = 0.6  # for title and legend [inch]
MARGIN = 0.06  # of an axis above and below what it shows


def log_figure(path: str | Path, found: LogEstimate, title: str) -> Path:
    """Save what `draw_log` draws; return the path."""
    return save_figure(draw_log(found, title), path)


def draw_log(found: LogEstimate, title: str, *, states: bool = True) -> Figure:
    """Estimates beside the reference channels, and the innovations below; without `states` these alone.

    References come first; of many states and outputs the first six are drawn. Bands of the first rows, in which a
    filter settles from its prior, do not widen the axes.
    """
    model, references, colour = found.model, compared(found), colour_of(found.filter.name)
    values = [f"{STATE}:{one.symbol}" for one in model.states] + [f"{OUTPUT}:{symbol}" for symbol in model.outputs]
    shown = sorted(values, key=lambda key: key not in references)[:MOST_PANELS]
    shown = [key for key in values if key in shown] if states else []
    heights = [TALL] * len(shown) + [LOW if shown else TALL] * len(found.log.measured)
    figure = new_figure((WIDTH, sum(heights) + ROOM))
    axes = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights, squeeze=False)[:, 0]
    tidy(axes)
    times = found.log.start + found.log.times
    labels = {f"{STATE}:{one.symbol}": one for one in model.states}
    labels |= {f"{OUTPUT}:{symbol}": one.quantity for symbol, one in model.outputs.items()}
    for axis, key in zip(axes, shown, strict=False):
        mean, std = estimated(found, key)
        _band(axis, times, mean, std, colour)
        _limit(axis, mean, std, found.log.references[key] if key in references else mean)
        if key in references:
            axis.plot(times, found.log.references[key], label="reference, not seen", **TRUTH)
        axis.plot(times, mean, color=colour, linewidth=1.0, label="smoother" if found.smoothed else "estimate")
        axis.set_ylabel(labels[key].plot_label.replace(" $", "\n$"))
    for j, (axis, one) in enumerate(zip(axes[len(shown) :], found.log.measured, strict=True)):
        std = np.sqrt(np.maximum(found.innovation_covs[:, j, j], 0.0))
        _band(axis, times, np.zeros_like(std), std, colour)
        _limit(axis, np.zeros_like(std), std, found.innovations[:, j])
        axis.plot(times, found.innovations[:, j], color=colour, linewidth=0.8, label="innovation")
        axis.set_ylabel(f"innovation of\n{one.symbol}" + (f"\n[{one.unit}]" if one.unit else ""))
    axes[0].set_title(title, fontsize=11)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    named: dict[str, Any] = {}
    for axis in axes:
        handles, texts = axis.get_legend_handles_labels()
        named |= dict(zip(texts, handles, strict=True))
    figure.legend(named.values(), named, loc="outside lower center", ncols=len(named), frameon=False)
    return figure


def _band(axis, times: np.ndarray, middle: np.ndarray, std: np.ndarray, colour: str) -> None:
    low, high = middle - TWO_SIDED * std, middle + TWO_SIDED * std
    axis.fill_between(times, low, high, color=colour, alpha=0.25, linewidth=0, label="95 % band")


def _limit(axis, middle: np.ndarray, std: np.ndarray, line: np.ndarray) -> None:
    """Let an axis show both lines and, of the band, what is behind the first rows."""
    reach = TWO_SIDED * std[min(SKIPPED, len(std) // 4) :]
    ends = middle[len(std) - len(reach) :]
    shown = np.concatenate((middle, line, ends - reach, ends + reach))
    shown = shown[np.isfinite(shown)]
    if shown.size and np.ptp(shown) > 0.0:
        room = MARGIN * np.ptp(shown)
        axis.set_ylim(shown.min() - room, shown.max() + room)
