"""Pictures of studies and estimates, each saved as one PNG file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from optuna.trial import FrozenTrial, TrialState

from filters.engine.batch import run
from filters.filter import Filter
from numerics.plots import BLUE, DARK, RUST, new_figure, save_figure, tidy
from thruster_env.linear.figures import STATES
from tuning.evaluation.baselines import ORACLE, RULE, SCALED, TUNED
from tuning.evaluation.held_out import Comparison
from tuning.problems.data import Data
from tuning.search.outcome import is_consistent

SCORE = "score: mean RMSE over bound [-]"
TRUTH, ESTIMATE, BOUND = DARK, BLUE, RUST
GREY = "#9aa5ad"
COLOURS = {RULE: "#c5ccd1", SCALED: "#8a959d", TUNED: ESTIMATE, ORACLE: "#5a8f3c"}


def _new(rows: int, columns: int, size: tuple[float, float], **options):
    figure = new_figure(size)
    axes = figure.subplots(rows, columns, squeeze=False, **options)
    tidy(axes.flat)
    return figure, axes


def estimates_figure(
    path: Path, filters: Mapping[str, Filter], data: Data, run_index: int, dt: float, **options
) -> Path:
    """Truth and estimate of every state over time, and the error in its 95 % band; one column a filter.

    Options such as `sharey="row"` are those of matplotlib's `subplots`.
    """
    size, options = (5.4 * len(filters), 8.0), {"sharex": True, "height_ratios": (2, 1.3, 2, 1.3), **options}
    figure, axes = _new(4, len(filters), size, **options)
    one = slice(run_index, run_index + 1)
    time = dt * np.arange(data.states.shape[1])
    for column, (title, filter_) in enumerate(filters.items()):
        estimates = run(filter_, data.filter_keys[one], data.inputs[one], data.measurements[one])
        for i, (label, unit) in enumerate(STATES):
            above, below = axes[2 * i, column], axes[2 * i + 1, column]
            truth, mean = data.states[run_index, :, i], estimates.means[0, :, i]
            band = 1.96 * np.sqrt(estimates.covs[0, :, i, i])
            above.fill_between(time, mean - band, mean + band, color=ESTIMATE, alpha=0.3, linewidth=0)
            above.plot(time, truth, color=TRUTH, linewidth=1.6, label="truth")
            above.plot(time, mean, color=ESTIMATE, linewidth=1.0, label="estimate")
            below.fill_between(
                time, -band, band, color=ESTIMATE, alpha=0.3, linewidth=0, label="95 % band of the filter"
            )
            below.plot(time, mean - truth, color=BOUND, linewidth=0.9, label="error of the estimate")
            if column == 0:
                above.set_ylabel(f"{label}\n[{unit}]")
                below.set_ylabel(f"error\n[{unit}]")
        axes[-1, column].set_xlabel("time [s]")
        axes[0, column].set_title(title, fontsize=11)
    figure.align_ylabels(axes[:, 0])
    handles, labels = (
        sum(parts, []) for parts in zip(*(a.get_legend_handles_labels() for a in axes[:2, 0]), strict=True)
    )
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return save_figure(figure, path)


def history_figure(path: Path, trials: Sequence[FrozenTrial], title: str, label: str = SCORE) -> Path:
    """First objective of every trial of a study and the best so far; the first trial is the untuned filter.

    Hollow circles are trials whose mean NIS is outside its band: they are not among the best, unless all are.
    Crosses are trials that ended early: the mean of the seeds that they came to.
    """
    figure, axes = _new(1, 1, (6.4, 4.4))
    axis = axes[0, 0]
    done = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    values = [trial.values[0] for trial in done]
    early = early_trials(trials)
    if early:
        x, y = [trial.number + 1 for trial, _ in early], [value for _, value in early]
        axis.plot(x, y, "x", color=GREY, markersize=4, label="ended early: mean of its seeds")
    for inside, face, name in ((True, GREY, "trial"), (False, "none", "NIS outside its band")):
        some = [trial for trial in done[1:] if is_consistent(trial) == inside]
        if some:
            x, y = [trial.number + 1 for trial in some], [trial.values[0] for trial in some]
            axis.plot(x, y, "o", color=GREY, markerfacecolor=face, markersize=4, label=name)
    if done:
        axis.plot(done[0].number + 1, values[0], "s", color=BOUND, markersize=7, label="first trial")
        kept = [is_consistent(trial) for trial in done]
        counted = np.where(kept, values, np.inf) if any(kept) else values
        best = np.minimum.accumulate(counted)
        best[np.isinf(best)] = np.nan
        axis.step([t.number + 1 for t in done], best, where="post", color=ESTIMATE, label="best so far")
        beyond = limit_values(axis, values + [value for _, value in early])
        figure.legend(loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    above = f" ({beyond} of {len(done) + len(early)} lie above the axis)" if done and beyond else ""
    axis.set_xlabel(f"trial{above}")
    axis.set_ylabel(label)
    axis.set_title(title, fontsize=11)
    return save_figure(figure, path)


def early_trials(trials: Sequence[FrozenTrial]) -> list[tuple[FrozenTrial, float]]:
    """Trials that ended early, each with the mean of what it reported: scores of single seeds."""
    early = [trial for trial in trials if trial.state == TrialState.PRUNED and trial.intermediate_values]
    return [(trial, float(np.mean(list(trial.intermediate_values.values())))) for trial in early]


def limit_values(axis, values: list[float]) -> int:
    """Let an axis of objective values show the good ones and the first; return how many lie above it."""
    low, spread = min(values), max(values) - min(values)
    room = 0.1 * abs(low) or 0.1 * spread or 1.0
    top = max(low + 3 * room, values[0] + 1.5 * room)
    axis.set_ylim(low - room, top)
    return sum(value > top for value in values)


def comparison_figure(path: Path, proof: Comparison, title: str) -> Path:
    """RMSE of a tuned filter and its baselines on held-out seeds with 95 % intervals, and the bound."""
    figure, axes = _new(1, 2, (8.0, 4.0))
    names = proof.evaluations
    for column, (label, unit) in enumerate(STATES):
        axis = axes[0, column]
        for place, (name, evaluation) in enumerate(names.items()):
            rmse = evaluation.rmse[column]
            whiskers = [[rmse.value - rmse.low], [rmse.high - rmse.value]]
            axis.bar(place, rmse.value, 0.62, yerr=whiskers, color=COLOURS[name], capsize=4)
            axis.annotate(f"{rmse.value:.3g}", (place, rmse.high), (0, 4), textcoords="offset points", ha="center")
        if np.isfinite(proof.bound[column]):
            axis.axhline(proof.bound[column], color=BOUND, linestyle="--", label="posterior Cramér-Rao bound")
        axis.set_xticks(range(len(names)), [name.replace(" ", "\n", 1) for name in names])
        axis.set_ylabel(f"RMSE of {label} [{unit}]")
        axis.margins(y=0.15)
        axis.grid(axis="x", visible=False)
    handles, labels = axes[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", frameon=False)
    figure.suptitle(title, fontsize=11)
    return save_figure(figure, path)
