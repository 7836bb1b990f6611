"""One picture of whether a filter's covariance is honest: a panel for each check of `filters.consistency`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np

from filters.consistency.intervals import Interval
from filters.consistency.nees import SquaresCheck
from filters.consistency.report import ConsistencyReport
from filters.consistency.scores import LEVELS
from filters.consistency.verdicts import probability_text, rounded
from numerics.plots import BLUE, DARK, RUST, new_figure, save_figure, tidy

FOUND = BLUE
STATES = (BLUE, RUST, "#5a8f3c", "#7a5195", "#9aa5ad", "#c9a227")  # colours
PANEL = (4.0, 3.0)  # [inch]
COLUMNS = 3
LOGARITHMIC_FROM = 20  # times the right value


def consistency_figure(
    path: str | Path,
    report: ConsistencyReport,
    title: str,
    comparison: Mapping[str, tuple[Interval, ...]] | None = None,
) -> Path:
    """Draw a consistency report; dashed lines show what is right, grey bands what chance allows.

    Args:
        path: PNG file to write.
        report: the checks of one filter.
        title: said above the picture.
        comparison: RMSE ratios by state, from `intervals.rmse_ratios`, under the names of the pairs.

    Raises:
        ValueError: if there is nothing to draw, or nothing can be written.
    """
    panels = _panels(report, comparison)
    if not panels:
        raise ValueError("a figure needs something to draw, but the filter gives no covariance")
    columns = min(COLUMNS, len(panels))
    rows = -(-len(panels) // columns)
    figure = new_figure((PANEL[0] * COLUMNS, PANEL[1] * rows + 0.4))
    axes = list(figure.subplots(rows, columns, squeeze=False).flat)
    tidy(axes)
    for axis, draw in zip(axes, panels, strict=False):
        draw(axis)
        axis.title.set_fontsize(10)
    for axis in axes[len(panels) :]:
        axis.remove()
    _legend(figure, report)
    figure.suptitle(title, fontsize=11)
    return save_figure(figure, path)


def _panels(report: ConsistencyReport, comparison: Mapping | None) -> list[Callable]:
    """A function on axes for each check of which there are numbers."""
    squares = [check for check in (report.nees, report.nis) if not np.isnan(check.mean.value)]
    panels: list[Callable] = [partial(_squares, check=check, report=report) for check in squares]
    if report.whiteness.statistic > 0:
        panels.append(partial(_correlations, report=report))
    panels += [partial(_distribution, check=check) for check in squares]
    if not np.isnan(report.coverage_by_level).all():
        panels += [partial(_coverage, report=report), partial(_crps, report=report)]
    if report.ensemble is not None:
        panels.append(partial(_ranks, report=report))
    if comparison:
        panels.append(partial(_comparison, comparison=comparison))
    return panels


def _legend(figure, report: ConsistencyReport) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Line2D([], [], color=DARK, linestyle="--", linewidth=1, label="what is right"),
        Patch(color=DARK, alpha=0.15, linewidth=0, label="95 % of chance"),
        Line2D([], [], color=FOUND, linewidth=1, label=f"found in {report.runs} runs"),
        *(Line2D([], [], color=_colour(i), marker="o", label=name) for i, name in enumerate(report.states)),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=len(handles), frameon=False)


def _colour(i: int) -> str:
    return STATES[i % len(STATES)]


def _steps(report: ConsistencyReport) -> np.ndarray:
    return report.first_step + np.arange(len(report.nees.step_means))


def _right(axis, value: float) -> None:
    axis.axhline(value, color=DARK, linestyle="--", linewidth=1, zorder=3)


def _squares(axis, check: SquaresCheck, report: ConsistencyReport) -> None:
    steps = _steps(report)
    axis.fill_between(steps, *check.band.T, color=DARK, alpha=0.15, linewidth=0)
    axis.plot(steps, check.step_means, color=FOUND, linewidth=0.8)
    _right(axis, check.dimension)
    if np.nanmax(check.step_means, initial=0.0) > LOGARITHMIC_FROM * check.dimension:
        axis.set_yscale("log", subs=(2, 5))
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:g}")
    axis.set_title(f"{check.name}: mean {rounded(check.mean.value)} where {check.dimension:.3g} is right")
    axis.set_xlabel("step")
    axis.set_ylabel("mean over runs")
    axis.margins(x=0.01)


def _correlations(axis, report: ConsistencyReport) -> None:
    found = report.whiteness
    lags, channels = np.arange(1, len(found.correlations) + 1), found.correlations.shape[1]
    for i in range(channels):
        places = lags + (i - (channels - 1) / 2) * 0.6 / channels
        values, colour = found.correlations[:, i, i], FOUND if channels == 1 else _colour(i)
        axis.vlines(places, 0, values, color=colour, linewidth=1.5)
        axis.plot(places, values, "o", color=colour, markersize=3)
    half = found.half_widths[:, 0, 0]
    axis.fill_between(lags, -half, half, color=DARK, alpha=0.15, linewidth=0)
    _right(axis, 0)
    widest = 1.15 * max(np.abs(np.diagonal(found.correlations, axis1=1, axis2=2)).max(), 2 * half.max())
    axis.set_ylim(-widest, widest)
    axis.set_title(f"innovations: white? {probability_text(found.p_value)}")
    axis.set_xlabel("steps apart")
    axis.set_ylabel("correlation")


def _distribution(axis, check: SquaresCheck) -> None:
    found = check.distribution
    errors = np.abs(found.frequency_band - found.frequencies[:, None]).T
    centres = (found.edges[:-1] + found.edges[1:]) / 2
    axis.bar(centres, found.frequencies, 0.92 * np.diff(found.edges), color=FOUND, alpha=0.5)
    axis.errorbar(centres, found.frequencies, errors, fmt="none", ecolor=FOUND, elinewidth=1)
    _right(axis, 1)
    axis.set_title(f"{check.name}: {100 * check.beyond.value:.1f} % beyond the 95 % point")
    axis.set_xlabel("probability under chi-square")
    axis.set_ylabel("frequency over the right one")


def _coverage(axis, report: ConsistencyReport) -> None:
    axis.plot([0, 100], [0, 100], color=DARK, linestyle="--", linewidth=1)
    for i in range(len(report.states)):
        axis.plot(100 * LEVELS, 100 * report.coverage_by_level[:, i], ".-", linewidth=1, color=_colour(i))
    shares = ", ".join(f"{100 * part.value:.1f} %" for part in report.coverage)
    axis.set_title(f"95 % intervals hold {shares}")
    axis.set_xlabel("level of the interval [%]")
    axis.set_ylabel("truth found in it [%]")


def _crps(axis, report: ConsistencyReport) -> None:
    for i in range(len(report.states)):
        axis.plot(_steps(report), report.crps_ratio[:, i], color=_colour(i), linewidth=0.8)
    _right(axis, 1)
    axis.set_ylim(bottom=0)
    axis.set_title(f"mean CRPS {', '.join(rounded(part.value) for part in report.crps)}")
    axis.set_xlabel("step")
    axis.set_ylabel("CRPS over its expectation")
    axis.margins(x=0.01)


def _ranks(axis, report: ConsistencyReport) -> None:
    size = report.ensemble.size
    for i, found in enumerate(report.ensemble.ranks):
        axis.stairs(found.frequencies, found.edges * (size + 1), color=_colour(i), linewidth=1.4)
    _right(axis, 1)
    axis.set_ylim(bottom=0)
    axis.set_title(f"rank of the truth among {size} members")
    axis.set_xlabel("members below the truth")
    axis.set_ylabel("frequency over the right one")


def _comparison(axis, comparison: Mapping[str, tuple[Interval, ...]]) -> None:
    for place, ratios in enumerate(comparison.values()):
        for i, ratio in enumerate(ratios):
            height = -place - 0.2 * (i - (len(ratios) - 1) / 2)
            axis.plot([ratio.low, ratio.high], [height, height], "|-", color=_colour(i))
            axis.plot(ratio.value, height, "o", color=_colour(i))
    axis.axvline(1, color=DARK, linestyle="--", linewidth=1)
    axis.set_yticks(-np.arange(len(comparison)), list(comparison))
    axis.set_ylim(0.5 - len(comparison), 0.5)
    axis.grid(axis="y", visible=False)
    axis.set_title("RMSE over that of the other")
    axis.set_xlabel("ratio with its 95 % interval, paired by run")
