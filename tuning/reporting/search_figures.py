"""Pictures of a study's search: importance, slices, Pareto front, ensemble sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import optuna
from optuna.importance import PedAnovaImportanceEvaluator, get_param_importances
from optuna.trial import FrozenTrial, TrialState

from thruster_env.core.plots import BLUE, GREY, RUST, grid_of, new_figure, panels, tidy
from thruster_env.core.text_tables import verbatim
from tuning.evaluation.sizes import SizeRow
from tuning.reporting.figures import early_trials, limit_values
from tuning.reporting.panels import COLUMNS, plotted_states
from tuning.search.objectives import SCORE, reported
from tuning.search.outcome import best_trial, is_consistent
from tuning.search.space import FILTER_TYPE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FEWEST_TRIALS = 10  # complete ones, for importances to mean anything
CROSS = {"color": GREY, "markersize": 4, "markeredgewidth": 0.8}


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
        made = optuna.trial.create_trial(params=trial.params, distributions=trial.distributions, value=value)
        copied.add_trial(made)
    return copied


def draw_importance(found: Mapping[str, float]) -> Figure:
    """Importance of each number, the largest above."""
    figure = new_figure((6.4, 0.9 + 0.4 * len(found)))
    axis = figure.subplots()
    tidy([axis])
    names, values = list(found)[::-1], list(found.values())[::-1]
    axis.barh([words(name) for name in names], values, 0.6, color=BLUE)
    for place, value in enumerate(values):
        axis.annotate(f"{value:.2f}", (value, place), (4, 0), textcoords="offset points", va="center", fontsize=9)
    axis.margins(x=0.12)
    axis.grid(axis="y", visible=False)
    axis.set_xlabel("importance, of a sum of 1 [-]")
    return figure


def draw_slices(trials: Sequence[FrozenTrial], label: str, objective: str = SCORE) -> Figure:
    """First objective against each parameter, a panel per parameter; dashed is the best trial.

    Hollow circles have a mean NIS outside its band; crosses were pruned and stand at the mean of their seeds.
    """
    done = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    early, names = early_trials(trials), [name for name in done[0].params if name != FILTER_TYPE]
    figure, axes = panels(len(names), COLUMNS, (3.2, 2.7), extra=0.4, sharey=True)
    best, values = best_trial(done), [trial.values[0] for trial in done]
    assert best is not None  # a report is of a study with a complete trial
    faces = [BLUE if is_consistent(trial) else "white" for trial in done]
    for axis, name in zip(axes, names, strict=True):
        places = [trial.params[name] for trial in done]
        axis.scatter(
            places,
            [reported(objective, one) for one in values],
            s=16,
            facecolors=faces,
            edgecolors=BLUE,
            linewidths=0.8,
            alpha=0.7,
        )
        crosses = [trial.params[name] for trial, _ in early], [reported(objective, value) for _, value in early]
        axis.plot(*crosses, "x", **CROSS)
        axis.axvline(best.params[name], color=RUST, linestyle="--", linewidth=1)
        if getattr(best.distributions[name], "log", False):
            if len({*places, *(trial.params[name] for trial, _ in early)}) == 1:
                axis.set_xlim(places[0] / 2.0, places[0] * 2.0)  # the few trials of a short study may be alike
            axis.set_xscale("log")
        if name == "N" or name.endswith(" N"):
            _size_axis(axis, sorted(trial.params[name] for trial in trials if name in trial.params))
        axis.set_xlabel(verbatim(words(name)))
    limit_values(axes[0], values, objective)
    for axis in axes[:: grid_of(len(names), COLUMNS)[1]]:
        axis.set_ylabel(verbatim(label), fontsize=9)
    return figure


def draw_front(
    trials: Sequence[FrozenTrial], front: Sequence[FrozenTrial], labels: Sequence[str], objectives: Sequence[str]
) -> Figure:
    """Trials by their two objectives, and the Pareto front."""
    figure = new_figure((6.4, 4.4))
    axis = figure.subplots()
    tidy([axis])
    done = np.array([trial.values for trial in trials if trial.state == TrialState.COMPLETE])
    best = np.array(sorted(trial.values for trial in front))
    signs = np.array([reported(name, 1.0) for name in objectives])
    axis.plot(*(signs * done).T, "o", color=GREY, markersize=4, label="trial")
    axis.plot(
        *(signs * best).T,
        "o-",
        color=BLUE,
        markersize=6,
        linewidth=1,
        drawstyle="steps-post",
        label="Pareto front",
    )
    axis.plot(*(signs * best[0]), "s", color=RUST, markersize=8, label="best in the first objective")
    for axis_name, column in (("x", 0), ("y", 1)):
        low, high = best[:, column].min(), best[:, column].max()
        room = 0.5 * (high - low) or 0.2 * abs(low) or 1.0
        shown = done[done[:, column] <= high + room, column]
        pad = 0.08 * (shown.max() - low) or room
        ends = signs[column] * np.array([low - pad, shown.max() + pad])
        getattr(axis, f"set_{axis_name}lim")(*sorted(ends))
    axis.set_xlabel(verbatim(labels[0]))
    axis.set_ylabel(verbatim(labels[1]))
    axis.legend(frameon=False)
    return figure


def draw_sizes(sizes: Sequence[SizeRow], kept: int) -> Figure:
    """RMSE of every state against ensemble size with 95 % intervals; dashed is the size that was kept."""
    states, numbers = sizes[0].evaluation.states, [row.size for row in sizes]
    places, left_out = plotted_states(states, sizes[0].evaluation.scored)
    width = 4.0 if len(places) > 1 else 5.2
    figure, axes = panels(len(places), COLUMNS, (width, 3.6))
    for axis, i in zip(axes, places, strict=True):
        found = np.array([row.evaluation.rmse[i] for row in sizes])
        axis.fill_between(numbers, found[:, 1], found[:, 2], color=BLUE, alpha=0.2, linewidth=0)
        axis.plot(numbers, found[:, 0], "o-", color=BLUE, markersize=4, linewidth=1)
        axis.axvline(kept, color=RUST, linestyle="--", linewidth=1)
        place = {"xycoords": ("data", "axes fraction"), "textcoords": "offset points"}
        axis.annotate(f"N = {kept}", (kept, 1), (4, -10), **place, color=RUST, fontsize=9)
        _size_axis(axis, numbers)
        axis.set_xlabel("ensemble size N [-]")
        axis.set_ylabel(f"RMSE of {states[i].plot_label}")
    if left_out:
        figure.supxlabel(left_out, fontsize=9)
    return figure


def words(name: str) -> str:
    """The label of a trial parameter in a picture."""
    return name.replace("_", " ")


def _size_axis(axis, sizes: Sequence[int]) -> None:
    """A logarithmic axis of ensemble sizes, smallest first, with round numbers."""
    ticks = [n for n in (5, 10, 20, 50, 100, 200, 500, 1000, 2000, 5000) if sizes[0] <= n <= sizes[-1]]
    axis.set_xscale("log")
    axis.set_xticks(ticks, [str(tick) for tick in ticks])
    axis.set_xticks([], minor=True)
