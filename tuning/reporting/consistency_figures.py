"""One picture of a filter's consistency: a panel for each check of `filters.consistency`."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from filters.consistency.intervals import LEVELS, Interval
from filters.consistency.nees import SquaresCheck
from filters.consistency.report import ConsistencyReport
from filters.consistency.verdicts import probability_text, rounded
from filters.logs.figure import colour_of
from thruster_env.core.plots import BLUE, DARK, RUST, panels, save_figure
from thruster_env.core.text_tables import TITLE, verbatim
from tuning.reporting.time_figures import COLUMNS, plotted_states

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = (BLUE, RUST, "#5a8f3c", "#7a5195", "#9aa5ad", "#c9a227")  # of states
CHANNEL_COLOURS = ("#44aa99", "#cc6677", "#999933", "#882255", "#ddaa33", "#332288")
PANEL = (4.0, 3.0)  # [inch]
MOST_HANDLES = 5  # of a legend side by side
MOST_VALUES = 3  # in the title of a panel
LOGARITHMIC_FROM = 20  # times the right value


def consistency_figure(path: str | Path, report: ConsistencyReport, title: str, *arguments, **options) -> Path:
    """Save what `draw_consistency` draws."""
    return save_figure(draw_consistency(report, title, *arguments, **options), path)


def draw_consistency(
    report: ConsistencyReport,
    title: str,
    comparison: Mapping[str, tuple[Interval, ...]] | None = None,
    scored: Collection[int] | None = None,
    filter_name: str = "ekf",
) -> Figure:
    """Draw a consistency report; dashed lines show the expected value, grey bands its 95 % range by chance.

    Of many states some are drawn; without truth the checks are those of the innovations.

    Args:
        report: the checks of one filter.
        title: said above the picture.
        comparison: RMSE ratios by state, from `intervals.rmse_ratios`, under the names of the pairs.
        scored: indices of the states that count in the score, which come first where not all are drawn.
        filter_name: of the filter, whose colour is that of what was found.

    Raises:
        ValueError: if there is nothing to draw.
    """
    indices, left_out = plotted_states(report.states, scored)
    colour = colour_of(filter_name)
    checks = _panels(report, comparison, indices, colour)
    if not checks:
        raise ValueError("a figure needs something to draw, but the filter gives no covariance")
    figure, axes = panels(len(checks), COLUMNS, PANEL, extra=0.4)
    for axis, draw in zip(axes, checks, strict=True):
        draw(axis)
        axis.title.set_fontsize(10)
    _legend(figure, report, indices, left_out, colour)
    figure.suptitle(verbatim(title, most=TITLE), fontsize=11)
    return figure


def _panels(
    report: ConsistencyReport, comparison: Mapping | None, indices: Sequence[int], colour: str
) -> list[Callable]:
    """A function on axes for each check that has results."""
    squares = [check for check in (report.nees, report.nis) if not np.isnan(check.mean.value)]
    checks: list[Callable] = [partial(_squares, check=check, report=report, colour=colour) for check in squares]
    if report.whiteness.statistic > 0:
        checks.append(partial(_correlations, report=report, colour=colour))
    checks += [partial(_distribution, check=check, colour=colour) for check in squares]
    if not np.isnan(report.coverage_by_level).all():
        shares: dict[str, Any] = {"coverage": report.coverage, "by_level": report.coverage_by_level}
        checks.append(partial(_coverage, what="truth", colours=_of_states(indices), **shares))
        checks.append(partial(_crps, report=report, indices=indices))
    elif not (report.has_truth or np.isnan(report.innovation_coverage_by_level).all()):
        shares = {"coverage": report.innovation_coverage, "by_level": report.innovation_coverage_by_level}
        checks.append(partial(_coverage, what="measurements", colours=_of_channels(report, colour), **shares))
    if report.ensemble is not None:
        checks.append(partial(_ranks, report=report, indices=indices))
    if comparison:
        checks.append(partial(_comparison, comparison=comparison, indices=indices))
    return checks


def _of_states(indices: Sequence[int]) -> dict[int, str]:
    """Colours of the states that are drawn."""
    return {i: COLOURS[row % len(COLOURS)] for row, i in enumerate(indices)}


def _of_channels(report: ConsistencyReport, colour: str) -> dict[int, str]:
    """Colours of the channels, others than those of states; a single one has that of all that was found."""
    count = len(report.channels)
    return {j: colour if count == 1 else CHANNEL_COLOURS[j % len(CHANNEL_COLOURS)] for j in range(count)}


def _legend(figure, report: ConsistencyReport, indices: Sequence[int], left_out: str, colour: str) -> None:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    handles = [
        Line2D([], [], color=DARK, linestyle="--", linewidth=1, label="expected value"),
        Patch(color=DARK, alpha=0.15, linewidth=0, label="95 % of chance"),
        Line2D([], [], color=colour, linewidth=1, label=f"found in {report.runs} runs"),
    ]
    named = {report.states[i]: colour for i, colour in _of_states(indices).items()} if report.has_truth else {}
    if len(report.channels) > 1:
        named |= {report.channels[j]: shade for j, shade in _of_channels(report, colour).items()}
    handles += [Line2D([], [], color=colour, marker="o", label=verbatim(name)) for name, colour in named.items()]
    title = left_out if report.has_truth and left_out else None
    options = {"ncols": min(len(handles), MOST_HANDLES), "frameon": False, "title": title}
    figure.legend(handles=handles, loc="outside lower center", **options)


def _steps(report: ConsistencyReport) -> np.ndarray:
    return report.first_step + np.arange(len(report.nees.step_means))


def _right(axis, value: float) -> None:
    axis.axhline(value, color=DARK, linestyle="--", linewidth=1, zorder=3)


def _squares(axis, check: SquaresCheck, report: ConsistencyReport, colour: str) -> None:
    steps = _steps(report)
    axis.fill_between(steps, *check.band.T, color=DARK, alpha=0.15, linewidth=0)
    axis.plot(steps, check.step_means, color=colour, linewidth=0.8)
    _right(axis, check.dimension)
    if np.nanmax(check.step_means, initial=0.0) > LOGARITHMIC_FROM * check.dimension:
        axis.set_yscale("log", subs=(2, 5))
        axis.yaxis.set_major_formatter("{x:g}")
        axis.yaxis.set_minor_formatter("{x:g}")
    axis.set_title(f"{check.name}: mean {rounded(check.mean.value)}, expected {check.dimension:.3g}")
    axis.set_xlabel("step [-]")
    axis.set_ylabel(f"mean {check.name} over runs [-]")
    axis.margins(x=0.01)


def _correlations(axis, report: ConsistencyReport, colour: str) -> None:
    whiteness = report.whiteness
    lags, channels = np.arange(1, len(whiteness.correlations) + 1), whiteness.correlations.shape[1]
    for i, shade in _of_channels(report, colour).items():
        positions, values = lags + (i - (channels - 1) / 2) * 0.6 / channels, whiteness.correlations[:, i, i]
        axis.vlines(positions, 0, values, color=shade, linewidth=1.5)
        axis.plot(positions, values, "o", color=shade, markersize=3)
    half = whiteness.half_widths[:, 0, 0]
    axis.fill_between(lags, -half, half, color=DARK, alpha=0.15, linewidth=0)
    _right(axis, 0)
    widest = 1.15 * max(np.abs(np.diagonal(whiteness.correlations, axis1=1, axis2=2)).max(), 2 * half.max())
    axis.set_ylim(-widest, widest)
    axis.set_title(f"innovations: white? {probability_text(whiteness.p_value)}")
    axis.set_xlabel("lag [steps]")
    axis.set_ylabel("correlation [-]")


def _distribution(axis, check: SquaresCheck, colour: str) -> None:
    distribution = check.distribution
    errors = np.abs(distribution.frequency_band - distribution.frequencies[:, None]).T
    centres = (distribution.edges[:-1] + distribution.edges[1:]) / 2
    axis.bar(centres, distribution.frequencies, 0.92 * np.diff(distribution.edges), color=colour, alpha=0.5)
    axis.errorbar(centres, distribution.frequencies, errors, fmt="none", ecolor=colour, elinewidth=1)
    _right(axis, 1)
    axis.set_title(f"{check.name}: {100 * check.beyond.value:.1f} % beyond the 95 % point")
    axis.set_xlabel("probability under chi-square [-]")
    axis.set_ylabel("frequency over that expected [-]")


def _coverage(
    axis, coverage: Sequence[Interval], by_level: np.ndarray, what: str, colours: Mapping[int, str]
) -> None:
    axis.plot([0, 100], [0, 100], color=DARK, linestyle="--", linewidth=1)
    for i, colour in colours.items():
        axis.plot(100 * LEVELS, 100 * by_level[:, i], ".-", linewidth=1, color=colour)
    axis.set_title(f"95 % intervals contain {_told([100 * part.value for part in coverage], '{:.1f} %'.format)}")
    axis.set_xlabel("level of the interval [%]")
    axis.set_ylabel(f"{what} found in it [%]")


def _told(values: Sequence[float], form: Callable[[float], str]) -> str:
    """Few values as they are, many as their range."""
    if len(values) <= MOST_VALUES:
        return ", ".join(map(form, values))
    return f"{form(np.nanmin(values))} to {form(np.nanmax(values))}"


def _crps(axis, report: ConsistencyReport, indices: Sequence[int]) -> None:
    for i, colour in _of_states(indices).items():
        axis.plot(_steps(report), report.crps_ratio[:, i], color=colour, linewidth=0.8)
    _right(axis, 1)
    axis.set_ylim(bottom=0)
    axis.set_title(f"mean CRPS {_told([part.value for part in report.crps], rounded)}")
    axis.set_xlabel("step [-]")
    axis.set_ylabel("CRPS over its expectation [-]")
    axis.margins(x=0.01)


def _ranks(axis, report: ConsistencyReport, indices: Sequence[int]) -> None:
    assert report.ensemble is not None  # this panel is drawn of ensembles alone
    size = report.ensemble.size
    for i, colour in _of_states(indices).items():
        ranks = report.ensemble.ranks[i]
        axis.stairs(ranks.frequencies, ranks.edges * (size + 1), color=colour, linewidth=1.4)
    _right(axis, 1)
    axis.set_ylim(bottom=0)
    axis.set_title(f"rank of the truth among {size} members")
    axis.set_xlabel("members below the truth [-]")
    axis.set_ylabel("frequency over that expected [-]")


def _comparison(axis, comparison: Mapping[str, tuple[Interval, ...]], indices: Sequence[int]) -> None:
    apart = min(0.2, 0.8 / len(indices))
    for number, ratios in enumerate(comparison.values()):
        for row, (i, colour) in enumerate(_of_states(indices).items()):
            ratio, height = ratios[i], -number - apart * (row - (len(indices) - 1) / 2)
            axis.plot([ratio.low, ratio.high], [height, height], "|-", color=colour)
            axis.plot(ratio.value, height, "o", color=colour)
    axis.axvline(1, color=DARK, linestyle="--", linewidth=1)
    axis.set_yticks(-np.arange(len(comparison)), list(comparison))
    axis.set_ylim(0.5 - len(comparison), 0.5)
    axis.grid(axis="y", visible=False)
    axis.set_title("RMSE over that of the other")
    axis.set_xlabel("ratio, 95 % interval paired by run [-]")
