"""A picture of a recorded run: every channel over time, with findings marked."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from thruster_env.core.characters import TITLE, verbatim
from thruster_env.core.plots import (
    BLUE,
    DARK,
    MUSTARD,
    PLUM,
    RUST,
    WINE,
    new_figure,
    save_figure,
    thinned,
    tidy,
)
from thruster_env.logs.findings import GAP, OUTLIER, SATURATED, STUCK, outliers
from thruster_env.logs.log import Log

if TYPE_CHECKING:
    from matplotlib.figure import Figure

WIDTH, PANEL, ROOM = 9.0, 1.5, 0.7  # [inch]
MOST_PANELS = 12
SPANS = {GAP: ("gap", MUSTARD), STUCK: ("stuck", WINE)}


def findings_figure(path: str | Path, log: Log) -> Path:
    """Save what `draw_findings` draws; return the path."""
    return save_figure(draw_findings(log), path)


def draw_findings(log: Log) -> Figure:
    """Inputs, then measurements, one below the other; findings are shaded, outliers have rings."""
    times = log.start + log.times
    inputs = np.vstack((log.inputs, np.full((1, log.inputs.shape[1]), np.nan)))
    panels = [("", one, inputs[:, place]) for place, one in enumerate(log.input_quantities)]
    for place, one in enumerate(log.measured):
        panels.append((f"measurement:{one.symbol}", one, log.measurements[:, place]))
    panels = panels[-MOST_PANELS:]
    figure = new_figure((WIDTH, PANEL * len(panels) + ROOM))
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    tidy(axes)
    named: dict[str, object] = {}
    for axis, (channel, quantity, values) in zip(axes, panels, strict=True):
        if channel:
            there = ~np.isnan(values)
            axis.plot(*thinned(times[there], values[there]), ".", color=BLUE, markersize=2.5, label="sample")
        else:
            axis.step(*thinned(times, values), where="post", color=DARK, linewidth=0.9, label="input")
        for finding in log.findings:
            if finding.kind in SPANS and finding.channel in ("", channel):
                word, colour = SPANS[finding.kind]
                ends = times[finding.first] - log.dt / 2, times[finding.last] + log.dt / 2
                axis.axvspan(*ends, color=colour, alpha=0.25, linewidth=0, label=word)
            elif finding.kind == SATURATED and finding.channel == channel:
                rows = values == values[finding.first]
                axis.plot(times[rows], values[rows], ".", color=PLUM, markersize=4, label="saturated")
            elif finding.kind == OUTLIER and finding.channel == channel:
                rows = outliers(log, channel)
                style = {"color": RUST, "fillstyle": "none", "markersize": 7, "markeredgewidth": 1.3}
                axis.plot(times[rows], values[rows], "o", label="outlier", **style)
        axis.set_ylabel(quantity.plot_label.replace(" $", "\n$"))
        handles, texts = axis.get_legend_handles_labels()
        named |= dict(zip(texts, handles, strict=True))
    axes[0].set_title(verbatim(f"{log.name}: {log.steps + 1} rows, dt {log.dt:g} s", most=TITLE), fontsize=11)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    figure.legend(named.values(), named, loc="outside lower center", ncols=len(named), frameon=False)
    return figure
