"""Figures of studies and their results: `draw_...` returns a figure, `..._figure` saves it as a file."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from optuna.trial import FrozenTrial, TrialState

from filters.logs.figure import colour_of
from thruster_env.core.plots import BLUE, DARK, GREEN, GREY, MUSTARD, PALE, RUST, panels, save_figure
from thruster_env.core.text_tables import TITLE, verbatim
from tuning.evaluation.baselines import GIVEN, NOISE, ORACLE, RULE, SCALED, TUNED
from tuning.evaluation.held_out import Comparison
from tuning.reporting.panels import COLUMNS, plotted_states
from tuning.search.objectives import SCORE, reported
from tuning.search.outcome import is_consistent

if TYPE_CHECKING:
    from matplotlib.figure import Figure

# Of baselines; the tuned filter has its own.
COLOURS = {GIVEN: RUST, RULE: PALE, SCALED: GREY, NOISE: MUSTARD, ORACLE: GREEN}


def history_figure(
    path: str | Path, trials: Sequence[FrozenTrial], title: str, label: str, objective: str = SCORE
) -> Path:
    """Save what `draw_history` draws."""
    return save_figure(draw_history(trials, title, label, objective), path)


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
        some = [trial for trial in done[1:] if is_consistent(trial) == inside]
        if some:
            x, y = [trial.number + 1 for trial in some], [plotted(trial.values[0]) for trial in some]
            axis.plot(x, y, "o", color=GREY, markerfacecolor=face, markersize=4, label=name)
    if done:
        axis.plot(done[0].number + 1, plotted(values[0]), "s", color=RUST, markersize=7, label="first trial")
        kept = [is_consistent(trial) for trial in done]
        counted = np.where(kept, values, np.inf) if any(kept) else values
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


def comparison_figure(path: str | Path, comparison: Comparison, title: str, filter_name: str = "ekf") -> Path:
    """Save what `draw_comparison` draws."""
    return save_figure(draw_comparison(comparison, title, filter_name), path)


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
    places, left_out = plotted_states(states, comparison.tuned.scored)
    width = 4.0 if len(places) > 1 else 5.2
    figure, axes = panels(len(places), COLUMNS, (width, 3.4), extra=0.6)
    for axis, i in zip(axes, places, strict=True):
        for place, (name, evaluation) in enumerate(names.items()):
            rmse = evaluation.rmse[i]
            whiskers = [[rmse.value - rmse.low], [rmse.high - rmse.value]]
            axis.bar(place, rmse.value, 0.62, yerr=whiskers, color=colours[name], capsize=4)
            axis.annotate(f"{rmse.value:.3g}", (place, rmse.high), (0, 4), textcoords="offset points", ha="center")
        if np.isfinite(comparison.bound[i]):
            axis.axhline(comparison.bound[i], color=DARK, linestyle="--", label="posterior Cramér-Rao bound")
        axis.set_xticks(range(len(names)), [name.replace(" ", "\n", 1) for name in names], fontsize=8)
        axis.set_ylabel(f"RMSE of {states[i].plot_label}")
        axis.margins(y=0.15)
        axis.grid(axis="x", visible=False)
    handles, labels = axes[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", frameon=False, title=left_out or None)
    figure.suptitle(verbatim(title, most=TITLE), fontsize=11)
    return figure
