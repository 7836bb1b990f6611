"""The two pictures of a comparison: learning curves by arm, and return against the error of what is observed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from thruster_env.figures import DARK, new_figure, save_figure, tidy
from training.comparison.runs import Result
from training.comparison.statistics import interquartile_mean, typical_error, typical_return
from training.comparison.tables import by_policy, noises_of

COLOURS = {
    "raw": "#999999",
    "raw+action": "#cc79a7",
    "stack": "#e69f00",
    "ekf": "#0072b2",
    "enkf": "#56b4e9",
    "belief": "#009e73",
    "true": DARK,
}
MARKERS = {"low": "o", "medium": "s", "high": "^"}
COST = "cost of an episode: minus the return [-]"


def learning_curves(results: Sequence[Result], path: str | Path) -> Path:
    """Cost over training steps, one panel a noise: interquartile mean over seeds, and the range of all of them."""
    groups = by_policy(results)
    noises = noises_of(groups)
    figure = new_figure((3.6 * len(noises) + 0.8, 3.9))
    axes = figure.subplots(1, len(noises), sharey=True, squeeze=False)[0]
    for axis, noise in zip(axes, noises, strict=True):
        for label, colour in COLOURS.items():
            group = groups.get((noise, "ppo", label), [])
            curves = [np.array(result.curve) for result in group if result.curve]
            if not curves:
                continue
            length = min(map(len, curves))
            steps, costs = curves[0][:length, 0] / 1e3, -np.stack([curve[:length, 1] for curve in curves])
            axis.plot(steps, interquartile_mean(costs), color=colour, label=label, linewidth=1.5)
            axis.fill_between(steps, costs.min(axis=0), costs.max(axis=0), color=colour, alpha=0.15, linewidth=0)
        for kind, label, name, dashes in (("pi", "raw", "PI, raw", ":"), ("lqr", "true", "LQR, true", "--")):
            if group := groups.get((noise, kind, label)):
                axis.axhline(-typical_return(group)[0], color=DARK, linestyle=dashes, lw=1, label=name)
        axis.set(xlabel="steps [thousand]", title=f"{noise} noise", yscale="log")
    axes[0].set_ylabel(COST)
    tidy(axes)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=9, frameon=False)
    return save_figure(figure, path)


def cost_against_error(results: Sequence[Result], path: str | Path) -> Path:
    """Cost against the RMSE of the thrust that a policy is shown: all arms and noises, learnt and classical."""
    groups = by_policy(results)
    figure = new_figure((8.4, 5.0))
    axis = figure.subplots()
    for (noise, kind, _), group in groups.items():
        arm = group[0].run.setup.observe
        colour, learnt = COLOURS.get(arm, "#8c564b"), kind == "ppo"
        if kind == "recurrent-ppo" or arm not in COLOURS:
            continue
        axis.plot(
            typical_error(group, "observed")[0],
            -typical_return(group)[0],
            MARKERS[noise],
            color=colour,
            markerfacecolor=colour if learnt else "none",
            markersize=7 if learnt else 6,
            alpha=0.5 if group[0].run.variant else 1.0,
        )
    for arm, colour in COLOURS.items():
        axis.plot([], [], "o", color=colour, label=arm)
    for noise, marker in MARKERS.items():
        axis.plot([], [], marker, color=DARK, markerfacecolor=DARK, label=f"{noise} noise")
    axis.plot([], [], "o", color=DARK, markerfacecolor="none", label="PI or LQG")
    axis.plot([], [], "o", color=DARK, alpha=0.5, label="another filter setting")
    axis.set(xlabel="RMSE of the thrust that the policy observes [N]", ylabel=COST, yscale="log")
    tidy([axis])
    figure.legend(*axis.get_legend_handles_labels(), loc="outside right center", frameon=False)
    return save_figure(figure, path)
