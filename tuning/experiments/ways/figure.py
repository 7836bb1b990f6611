"""The picture of the study of ways: regrets by group, at each budget of passes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from thruster_env.core.plots import new_figure, save_figure, tidy
from tuning.experiments.ways.entries import Result
from tuning.experiments.ways.problems import GROUPS
from tuning.experiments.ways.protocol import RUNS, START, STUDY, Protocol
from tuning.experiments.ways.statistics import regrets, within

LEAST, MOST = 1e-4, 3.0  # of log ratios, at which points are clipped
MARKS = dict(zip(RUNS, (("o", "0.75"), ("o", "C0"), ("o", "C3")), strict=True))


def figure(results: Sequence[Result], protocol: Protocol, path: str | Path) -> Path:
    """A panel a group: the mean log ratio of each way over the cases, after each budget of passes."""
    groups = [key for key in GROUPS if any(case.group == key for case in protocol.cases)]
    rows = -(-len(groups) // 2)
    drawn = new_figure((10.0, 5.2 * rows))
    axes = drawn.subplots(rows, 2, squeeze=False)
    tidy(axes.flat)
    for axis in axes.flat[len(groups) :]:
        axis.set_visible(False)
    for axis, group in zip(axes.flat, groups, strict=False):
        cases = [case for case in protocol.cases if case.group == group]
        budgets = [one for one in RUNS if one <= protocol.runs]
        points: dict[float, dict[str, float]] = {}
        for budget in budgets:
            found = [regrets(results, case, within("by_runs", f"{budget:g}")) for case in cases]
            ways = dict.fromkeys(one.way for each in found for one in each)
            points[budget] = {
                way: float(
                    np.mean([math.log(one.ratio.value) for each in found for one in each if one.way == way])
                )
                for way in ways
            }
        if not points or not points[budgets[-1]]:
            continue
        order = sorted(points[budgets[-1]], key=points[budgets[-1]].__getitem__, reverse=True)
        for budget in budgets:
            mark, colour = MARKS[budget]
            values = [100.0 * np.clip(points[budget].get(way, np.nan), LEAST, MOST) for way in order]
            axis.plot(values, range(len(order)), mark, color=colour, markersize=4, label=f"{budget:g} passes")
        axis.set_xscale("log")
        axis.set_xlim(60.0 * LEAST, 150.0 * MOST)
        axis.set_yticks(range(len(order)), order, fontsize=6)
        for label in axis.get_yticklabels():
            label.set_fontweight("bold" if label.get_text() in (STUDY, START) else "normal")
        axis.set_title(f"{group}: {GROUPS[group]}", fontsize=10)
        axis.set_xlabel("regret [%]")
    handles, labels = axes.flat[0].get_legend_handles_labels()
    if handles:
        drawn.legend(handles, labels, loc="outside lower center", ncols=len(labels), frameon=False)
    drawn.suptitle(
        "Score over that of the best constant numbers, held out; left of 0.01 % is drawn there", fontsize=11
    )
    return save_figure(drawn, path)
