"""Export from the page: a tuned file, Python lines, the command, or one matplotlib figure as PNG or SVG."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Mapping
from functools import partial
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from thruster_env.model.quantities import Quantity
from tuning.exploring.bench import Bench
from tuning.exploring.view import View

WITHIN_95 = 1.959963984540054  # standard normal deviates
MOST_STATES, MOST_INNOVATIONS = 4, 2
INK, ESTIMATE = "#1b1f24", "#0b6bb8"
KINDS = {
    "tuned": "tuned file",
    "python": "Python lines",
    "command": "command",
    "png": "PNG picture",
    "svg": "SVG picture",
}


def figure_of(bench: Bench, view: View, run: int = 0, title: str | None = None) -> Figure:
    """One run's states in their bands and its innovations; NIS, NEES and autocorrelation of all runs."""
    run = min(run, len(view.estimate) - 1)
    panels: list[Callable[[Axes], None]] = []
    for i, named in enumerate(bench.states[:MOST_STATES]):
        panels.append(partial(_state, view=view, run=run, i=i, named=named))
    for i, named in enumerate(bench.measurements[:MOST_INNOVATIONS]):
        panels.append(partial(_innovation, view=view, run=run, i=i, named=named))
    panels.append(lambda ax: _level(ax, view.time[run], view.nis, view.nis_band, "NIS"))
    if view.nees is not None and view.nees_band is not None:
        nees, band = view.nees, view.nees_band
        panels.append(lambda ax: _level(ax, view.time[run], nees, band, "NEES"))
    panels.append(lambda ax: _lags(ax, view))
    rows = -(-len(panels) // 2)
    figure = Figure(figsize=(9.0, 1.5 * rows + 0.6), layout="constrained")
    numbers = ",  ".join(
        f"{name} {figure_.value:.3g} {figure_.unit}".rstrip() for name, figure_ in view.figures.items()
    )
    figure.suptitle(f"{title or bench.title}\n{numbers}", fontsize=8)
    axes = figure.subplots(rows, 2, squeeze=False).ravel()
    for ax, draw in zip(axes, panels, strict=False):
        draw(ax)
        ax.tick_params(labelsize=7)
        ax.xaxis.label.set_size(7)
        ax.yaxis.label.set_size(7)
        ax.spines[["top", "right"]].set_visible(False)
        ax.margins(x=0.01)
    for ax in axes[len(panels) :]:
        ax.set_visible(False)
    return figure


def _state(ax: Axes, view: View, run: int, i: int, named: Quantity) -> None:
    mean, half = view.estimate[run, :, i], WITHIN_95 * view.deviation[run, :, i]
    ax.fill_between(view.time[run], mean - half, mean + half, color=ESTIMATE, alpha=0.2, linewidth=0)
    if view.truth is not None:
        ax.plot(view.time[run], view.truth[run, :, i], color=INK, linewidth=0.8)
    ax.plot(view.time[run], mean, color=ESTIMATE, linewidth=1.0)
    ax.set_ylabel(_labelled(named))


def _innovation(ax: Axes, view: View, run: int, i: int, named: Quantity) -> None:
    half = WITHIN_95 * view.innovation_deviation[run, :, i]
    ax.fill_between(view.time[run], -half, half, color=ESTIMATE, alpha=0.2, linewidth=0)
    ax.plot(*present(view.time[run], view.innovation[run, :, i]), color=ESTIMATE, linewidth=0.7)
    ax.set_ylabel(f"innovation {_labelled(named)}")


def _level(
    ax: Axes, time: np.ndarray, values: np.ndarray, band: tuple[np.ndarray, np.ndarray], label: str
) -> None:
    ax.fill_between(time, *band, color=ESTIMATE, alpha=0.2, linewidth=0)
    ax.semilogy(*present(time, mean_of_runs(values)), color=ESTIMATE, linewidth=0.7)
    ax.set_ylabel(label)


def _lags(ax: Axes, view: View) -> None:
    ax.axhspan(-view.autocorrelation_band, view.autocorrelation_band, color=ESTIMATE, alpha=0.2, linewidth=0)
    for channel in np.asarray(view.autocorrelation):
        ax.vlines(np.arange(1, len(channel) + 1), 0.0, channel, color=ESTIMATE)
    ax.set_ylim(-1.0, 1.0)
    ax.set_xlabel("lag [steps]")
    ax.set_ylabel("autocorrelation")


def _labelled(named: Quantity) -> str:
    return f"{named.name} [{named.unit}]" if named.unit else named.name


def present(time: np.ndarray, values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and values where there is one: between two others that are missing, a line would show none."""
    known = ~np.isnan(values)
    return time[known], values[known]


def mean_of_runs(values: np.ndarray) -> np.ndarray:
    """The mean over runs (S, K) -> (K,) of what is finite; NaN where nothing is."""
    known = np.isfinite(values)
    total = np.where(known, values, 0.0).sum(axis=0)
    return np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)


class File(NamedTuple):
    """A file for the browser to keep: text, or if it is none, bytes in base 64."""

    name: str
    type: str
    text: str | None
    base64: str | None = None


def exported(bench: Bench, values: Mapping[str, float], view: View, run: int, kind: str) -> File:
    """A file of what is seen.

    Raises:
        ValueError: for another kind than those of `KINDS`.
    """
    if kind == "tuned":
        return File("tuned.json", "application/json", bench.tuned_file(values))
    if kind == "python":
        return File("explored.py", "text/x-python", bench.python_lines(values))
    if kind == "command":
        return File("command.txt", "text/plain", bench.command(values))
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, but got {kind}")
    drawn = io.BytesIO()
    figure_of(bench, view, run).savefig(drawn, format=kind, dpi=150)
    if kind == "svg":
        return File("explored.svg", "image/svg+xml", drawn.getvalue().decode())
    return File("explored.png", "image/png", None, base64.b64encode(drawn.getvalue()).decode())
