"""The two pictures of a comparison: learning curves by observation set, and cost against observation error."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from filters.logs.figure import colour_of
from thruster_env.core.plots import DARK, new_figure, save_figure, tidy
from tuning.policies.comparison.plan import BEST
from tuning.policies.comparison.runs import Result
from tuning.policies.comparison.statistics import typical_error, typical_return
from tuning.policies.comparison.tables import by_policy, name_of, noises_of

COLOURS = {
    "raw": "#999999",
    "raw+action": "#cc79a7",
    "stack": "#e69f00",
    "ekf": colour_of("ekf"),
    "enkf": colour_of("enkf"),
    "belief": "#009e73",
    "true": DARK,
}
GREY = "#666666"
MARKERS = {"low": "o", "medium": "s", "high": "^"}
COST = "cost of an episode: minus the return [-]"


def learning_curves(results: Sequence[Result], path: str | Path) -> Path:
    """Cost over training steps, one panel for each noise level: mean and range over seeds."""
    groups = by_policy(results)
    noises = noises_of(groups)
    figure = new_figure((3.2 * len(noises) + 0.8, 4.2))
    axes = figure.subplots(1, len(noises), sharey=True, squeeze=False)[0]
    for axis, noise in zip(axes, noises, strict=True):
        for label, colour in COLOURS.items():
            group = groups.get((noise, "ppo", label), [])
            curves = [np.array(result.curve) for result in group if result.curve]
            if not curves:
                continue
            length = min(map(len, curves))
            steps, costs = curves[0][:length, 0] / 1e3, -np.stack([curve[:length, 1] for curve in curves])
            axis.plot(steps, costs.mean(axis=0), color=colour, label=label, linewidth=1.5)
            axis.fill_between(steps, costs.min(axis=0), costs.max(axis=0), color=colour, alpha=0.15, linewidth=0)
        for kind, label, dashes in (
            ("pi", "raw", ":"),
            ("lqr", "true", "-."),
            (BEST, "ekf", "--"),
            (BEST, "true", "--"),
        ):
            if reference := groups.get((noise, kind, label)):
                cost, colour = -typical_return(reference).value, COLOURS["ekf"] if label == "ekf" else DARK
                axis.axhline(cost, color=colour, linestyle=dashes, lw=1, label=name_of(kind, label))
        axis.set(xlabel="steps [thousand]", title=f"{noise} noise")
        _make_logarithmic(axis)
    axes[0].set_ylabel(COST)
    tidy(axes)
    named = axes[0].get_legend_handles_labels()
    figure.legend(*named, loc="outside lower center", ncols=2 * len(noises), frameon=False)
    return save_figure(figure, path)


def cost_against_error(results: Sequence[Result], path: str | Path) -> Path:
    """Cost against the RMSE of the observed thrust, for all observation sets, noise levels and policies."""
    groups = by_policy(results)
    figure = new_figure((8.4, 5.0))
    axis = figure.subplots()
    lines: dict[tuple[str, str], list[tuple[float, float]]] = {}
    for (noise, kind, _), group in groups.items():
        run = group[0].run
        observed = run.setup.observe
        if kind not in ("ppo", BEST, "pi", "lqr") or observed not in COLOURS:
            continue
        point = typical_error(group, "observed").value, -typical_return(group).value
        face = COLOURS[observed] if kind == "ppo" else "none"
        faint = 0.4 if run.variant or kind in ("pi", "lqr") else 1.0
        axis.plot(*point, MARKERS[noise], color=COLOURS[observed], markerfacecolor=face, alpha=faint, zorder=3)
        if not run.variant:
            lines.setdefault((kind, observed), []).append(point)
    for (_, observed), points in lines.items():
        axis.plot(*zip(*points, strict=True), color=COLOURS[observed], linewidth=0.8, alpha=0.6)
    for observed, colour in COLOURS.items():
        axis.plot([], [], "-", color=colour, linewidth=4, label=observed)
    for noise, marker in MARKERS.items():
        axis.plot([], [], marker, color=GREY, label=f"{noise} noise")
    axis.plot([], [], "o", color=GREY, label="PPO")
    axis.plot([], [], "o", color=GREY, markerfacecolor="none", label="MPC")
    axis.plot([], [], "o", color=GREY, markerfacecolor="none", alpha=0.4, label="PI, LQG or LQR")
    axis.plot([], [], "o", color=GREY, alpha=0.4, label="wrong model, or\nother Q and R")
    axis.set(xlabel="RMSE of the thrust that the policy observes [N]", ylabel=COST)
    _make_logarithmic(axis)
    tidy([axis])
    figure.legend(*axis.get_legend_handles_labels(), loc="outside right center", frameon=False)
    return save_figure(figure, path)


def _make_logarithmic(axis) -> None:
    """A logarithmic axis of costs, with plain numbers."""
    from matplotlib.ticker import LogLocator, NullLocator

    axis.set_yscale("log")
    axis.yaxis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.yaxis.set_minor_locator(NullLocator())
    axis.yaxis.set_major_formatter("{x:g}")
