"""Pictures of a study and its results: history, importance, slices, Pareto front, ensemble sizes, and consistency.

The picture of a filter's consistency has a panel for each check of `filters.consistency`.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import optuna
from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances
from optuna.trial import FrozenTrial, TrialState

from filters.consistency.nees import LEVELS, Interval, SquaresCheck
from filters.consistency.report import ConsistencyReport, probability_text, rounded
from filters.logs.findings import colour_of
from thruster_env.core.files import BLUE, DARK, GREEN, GREY, MUSTARD, PALE, RUST, legend_below, panels
from thruster_env.core.text_tables import TITLE, verbatim
from tuning.evaluation.baselines import GIVEN, NOISE, ORACLE, RULE, SCALED, TUNED
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.sizes import SizeRow
from tuning.reporting.time_figures import COLUMNS, plotted_states
from tuning.search.plan import SCORE, reported
from tuning.search.trials import is_consistent

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of baselines; the tuned filter has its own.
COLOURS = {GIVEN: RUST, RULE: PALE, SCALED: GREY, NOISE: MUSTARD, ORACLE: GREEN}
FEWEST_TRIALS = 10  # complete ones, for importances to mean anything
CROSS = {"color": GREY, "markersize": 4, "markeredgewidth": 0.8}

# Of the picture of consistency.
STATE_COLOURS = (BLUE, RUST, "#5a8f3c", "#7a5195", "#9aa5ad", "#c9a227")  # of states
CHANNEL_COLOURS = ("#44aa99", "#cc6677", "#999933", "#882255", "#ddaa33", "#332288")
PANEL = (4.0, 3.0)  # [inch]
MOST_HANDLES = 5  # of a legend side by side
MOST_VALUES = 3  # in the title of a panel
LOGARITHMIC_FROM = 20  # times the right value


def draw_history(trials: Sequence[FrozenTrial], title: str, label: str, objective: str = SCORE) -> Figure:
    """First objective of every trial of a study and the best so far; the first trial is the untuned filter.

    Hollow circles are trials whose mean NIS is outside its band: they are not among the best, unless all are.
    Crosses are pruned trials: the mean of the seeds that they reached.
    """
    figure, (axis,) = panels(1, 1, (6.4, 4.4))
    done = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    values = [trial.values[0] for trial in done]
    early, plotted = early_trials(trials), partial(reported, objective)
    if early:
        x, y = [trial.number + 1 for trial, _ in early], [plotted(value) for _, value in early]
        axis.plot(x, y, "x", color=GREY, markersize=4, label="pruned: mean of its seeds")
    for inside, face, name in ((True, GREY, "trial"), (False, "none", "NIS outside its band")):
        marked = [trial for trial in done[1:] if is_consistent(trial) == inside]
        if marked:
            x, y = [trial.number + 1 for trial in marked], [plotted(trial.values[0]) for trial in marked]
            axis.plot(x, y, "o", color=GREY, markerfacecolor=face, markersize=4, label=name)
    if done:
        axis.plot(done[0].number + 1, plotted(values[0]), "s", color=RUST, markersize=7, label="first trial")
        consistent = [is_consistent(trial) for trial in done]
        counted = np.where(consistent, values, np.inf) if any(consistent) else values
        best = np.minimum.accumulate(counted)
        best[np.isinf(best)] = np.nan
        axis.step(
            [t.number + 1 for t in done], [*map(plotted, best)], where="post", color=BLUE, label="best so far"
        )
        beyond = limit_values(axis, values + [value for _, value in early], objective)
        figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    above = f" ({beyond} of {len(done) + len(early)} lie beyond the axis)" if done and beyond else ""
    axis.set_xlabel(f"trial{above}")
    axis.xaxis.get_major_locator().set_params(integer=True, min_n_ticks=1)
    axis.set_ylabel(verbatim(label))
    axis.set_title(verbatim(title, most=TITLE), fontsize=11)
    return figure


def early_trials(trials: Sequence[FrozenTrial]) -> list[tuple[FrozenTrial, float]]:
    """Pruned trials, each with the mean of its reported scores of single seeds."""
    early = [trial for trial in trials if trial.state == TrialState.PRUNED and trial.intermediate_values]
    return [(trial, float(np.mean(list(trial.intermediate_values.values())))) for trial in early]


def limit_values(axis, values: list[float], objective: str = SCORE) -> int:
    """Limit an axis of an objective to the good values and the first; return how many of them lie beyond it."""
    low, spread = min(values), max(values) - min(values)
    room = 0.1 * abs(low) or 0.1 * spread or 1.0
    top = max(low + 3 * room, values[0] + 1.5 * room)
    axis.set_ylim(*sorted(reported(objective, end) for end in (low - room, top)))
    return sum(value > top for value in values)


def draw_comparison(comparison: Comparison, title: str, filter_name: str = "ekf") -> Figure:
    """RMSE of a tuned filter and its baselines on held-out seeds with 95 % intervals, and the bound.

    A panel is a state; of many some are shown. Bars of the tuned filter have the colour of the one of that name.

    Raises:
        ValueError: if there is no truth, and so no RMSE.
    """
    if not comparison.tuned.has_truth:
        raise ValueError("a figure of errors needs the truth, but there is none")
    colours = {**COLOURS, TUNED: colour_of(filter_name)}
    names, states = comparison.evaluations, comparison.tuned.states
    indices, left_out = plotted_states(states, comparison.tuned.scored)
    width = 4.0 if len(indices) > 1 else 5.2
    figure, axes = panels(len(indices), COLUMNS, (width, 3.4), extra=0.6)
    for axis, i in zip(axes, indices, strict=True):
        for position, (name, evaluation) in enumerate(names.items()):
            rmse = evaluation.rmse[i]
            whiskers = [[rmse.value - rmse.low], [rmse.high - rmse.value]]
            axis.bar(position, rmse.value, 0.62, yerr=whiskers, color=colours[name], capsize=4)
            axis.annotate(
                f"{rmse.value:.3g}", (position, rmse.high), (0, 4), textcoords="offset points", ha="center"
            )
        if np.isfinite(comparison.bound[i]):
            axis.axhline(comparison.bound[i], color=DARK, linestyle="--", label="posterior Cramér-Rao bound")
        axis.set_xticks(range(len(names)), [name.replace(" ", "\n", 1) for name in names], fontsize=8)
        axis.set_ylabel(f"RMSE of {states[i].plot_label}")
        axis.margins(y=0.15)
        axis.grid(axis="x", visible=False)
    legend_below(figure, axes[:1], title=left_out or None)
    figure.suptitle(verbatim(title, most=TITLE), fontsize=11)
    return figure


def importances(study: optuna.Study) -> dict[str, float]:
    """Importance of each parameter for a trial to be among the best tenth; empty if there are too few trials.

    If fewer than ten trials are complete, pruned ones are included at the mean of the seeds that they reached:
    they are among the worse ones on any other seeds, too. With two objectives the best are those nearest to the
    Pareto front. A study over several filter types shows only parameters that all types have.

    Source: Watanabe et al. (2023), "PED-ANOVA: efficiently quantifying hyperparameter importance in arbitrary
    subspaces".
    """
    complete, early = counted_trials(study)
    if complete + early < FEWEST_TRIALS:
        return {}
    study = _with_pruned(study) if early else study
    done = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    shared = [name for name in done[0].params if all(name in trial.params for trial in done)]
    return get_param_importances(study, evaluator=PedAnovaImportanceEvaluator(), params=shared)


def counted_trials(study: optuna.Study) -> tuple[int, int]:
    """The numbers of complete and of pruned trials behind importances."""
    trials = study.get_trials(deepcopy=False)
    complete = sum(trial.state == TrialState.COMPLETE for trial in trials)
    alone = complete >= FEWEST_TRIALS or len(study.directions) > 1
    return complete, 0 if alone else len(early_trials(trials))


def _with_pruned(study: optuna.Study) -> optuna.Study:
    """A copy of a study in memory, with pruned trials completed at the mean of their reports."""
    trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.ERROR)  # it would tell of the copy
    copied = optuna.create_study(direction=study.direction)
    optuna.logging.set_verbosity(before)
    copied.add_trials(trials)
    for trial, value in early_trials(study.get_trials(deepcopy=False)):
        early = optuna.trial.create_trial(params=trial.params, distributions=trial.distributions, value=value)
        copied.add_trial(early)
    return copied


def draw_sizes(sizes: Sequence[SizeRow], chosen: int) -> Figure:
    """RMSE of every state against ensemble size with 95 % intervals; dashed is the size that was kept."""
    states, numbers = sizes[0].evaluation.states, [row.size for row in sizes]
    indices, left_out = plotted_states(states, sizes[0].evaluation.scored)
    width = 4.0 if len(indices) > 1 else 5.2
    figure, axes = panels(len(indices), COLUMNS, (width, 3.6))
    for axis, i in zip(axes, indices, strict=True):
        rmse = np.array([row.evaluation.rmse[i] for row in sizes])
        axis.fill_between(numbers, rmse[:, 1], rmse[:, 2], color=BLUE, alpha=0.2, linewidth=0)
        axis.plot(numbers, rmse[:, 0], "o-", color=BLUE, markersize=4, linewidth=1)
        axis.axvline(chosen, color=RUST, linestyle="--", linewidth=1)
        coordinates = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
        axis.annotate(f"N = {chosen}", (chosen, 1), (4, -10), **coordinates, color=RUST, fontsize=9)
        size_axis(axis, numbers)
        axis.set_xlabel("ensemble size N [-]")
        axis.set_ylabel(f"RMSE of {states[i].plot_label}")
    if left_out:
        figure.supxlabel(left_out, fontsize=9)
    return figure


def words(name: str) -> str:
    """The label of a trial parameter in a picture."""
    return name.replace("_", " ")


def size_axis(axis, sizes: Sequence[int]) -> None:
    """A logarithmic axis of ensemble sizes, smallest first, with round numbers."""
    ticks = [n for n in (5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000) if sizes[0] <= n <= sizes[-1]]
    axis.set_xscale("log")
    axis.set_xticks(ticks, [str(tick) for tick in ticks])
    axis.set_xticks([], minor=True)


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
    return {i: STATE_COLOURS[row % len(STATE_COLOURS)] for row, i in enumerate(indices)}


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
