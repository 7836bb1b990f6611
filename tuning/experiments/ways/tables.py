"""Tables of the study of ways: what to use when, and the regret of every way in every case."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.core.plots import new_figure, save_figure, tidy
from thruster_env.core.text_tables import markdown_table
from tuning.experiments.ways.entries import Result
from tuning.experiments.ways.problems import (
    FULL_WAYS,
    GROUPS,
    ORACLE,
    RUNS,
    SCALED,
    SECONDS,
    START,
    STUDY,
    STUDY_LOG_SCORE,
    WITH_FULL,
    Case,
    Protocol,
)
from tuning.experiments.ways.runs import Regret, regrets, within
from tuning.search.objectives import LIKELIHOOD
from tuning.ways.registry import WAYS
from tuning.ways.way import GRADIENT, TRUTH

# Ways that look at no true state; but searches minimise an error where there are true states.
BLIND = (
    *(name for name, way in WAYS.items() if TRUTH not in way.needs),
    f"{LIKELIHOOD}{WITH_FULL}",
    f"als{WITH_FULL}",
)
SEARCHES = ("nelder-mead", "coordinate-steps", "tpe", "gp", "cma-es", "random")
ENOUGH, ENOUGH_NATS = 0.005, 0.02  # of log ratios and log scores, up to which the cheaper way is taken
NO_WAYS = (START, ORACLE)  # nobody has these


class Situation(NamedTuple):
    """What somebody has, and the cases that stand for it."""

    text: str
    has: Callable[[Case], bool]
    truth: bool


SITUATIONS = (
    Situation("true states, a model that is right", lambda case: case.group in "AB", True),
    Situation("true states, a model that is wrong", lambda case: case.group == "C", True),
    Situation("true states, outliers or a dead band", lambda case: case.group == "D", True),
    Situation("true states, eight to ten states", lambda case: case.group == "F", True),
    Situation("true states of one to ten runs", lambda case: case.group == "H", True),
    Situation("true states, a small ensemble", lambda case: case.group == "E", True),
    Situation(
        "no truth, a model that is right", lambda case: case.group in "ABH" or case.name == "nominal, blind", False
    ),
    Situation(
        "no truth, a model that is wrong", lambda case: case.group == "C" or case.name == "mismatch, blind", False
    ),
    Situation("no truth, a small ensemble", lambda case: case.group == "E", False),
)


def is_blind(way: str, case: Case) -> bool:
    """Whether a way looks at no true state in a case."""
    return way in BLIND and (way not in SEARCHES or not case.truth)


def what_to_use(results: Sequence[Result], protocol: Protocol) -> str:
    """The cheapest way within 0.5 % of the least error, and that within 0.02 nat of the best log score."""
    heads = [
        "you have",
        "least error",
        "regret, mean and worst case",
        "NEES / n",
        "best log score",
        "regret",
        "NEES / n",
    ]
    rows = []
    for situation in SITUATIONS:
        cases = [case for case in protocol.cases if situation.has(case)]
        found = [regrets(results, case) for case in cases]
        some = [
            [one for one in each if _may(one.way, case, situation)]
            for each, case in zip(found, cases, strict=True)
        ]
        some = [one for one in some if one]
        if not some:
            continue
        everywhere = set.intersection(*({one.way for one in each} for each in some)) - {SCALED}
        if not everywhere:
            continue
        error = _cheapest(some, everywhere, lambda one: math.log(one.ratio.value), ENOUGH)
        proper = _cheapest(some, everywhere, lambda one: _finite(one.log_score), ENOUGH_NATS)
        cells = [[f"`{way}`", _both(some, way), _nees(some, way)] for way in (error, proper)]
        rows.append([situation.text, *cells[0], *cells[1]])
    return markdown_table(heads, rows)


def _cheapest(
    some: Sequence[Sequence[Regret]], ways: set[str], of: Callable[[Regret], float], enough: float
) -> str:
    """The way of the least time among those whose mean is within what is enough of the least mean."""
    means = {way: _mean(some, way, of) for way in ways}
    near = [way for way in ways if means[way] <= min(means.values()) + enough]
    return min(near, key=lambda way: _mean(some, way, lambda one: one.seconds))


def _may(way: str, case: Case, situation: Situation) -> bool:
    return way not in NO_WAYS and (situation.truth or is_blind(way, case))


def _of(some: Sequence[Sequence[Regret]], way: str) -> list[Regret]:
    return [one for each in some for one in each if one.way == way]


def _mean(some: Sequence[Sequence[Regret]], way: str, of: Callable[[Regret], float]) -> float:
    return float(np.mean([of(one) for one in _of(some, way)]))


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 1e6


def _both(some: Sequence[Sequence[Regret]], way: str) -> str:
    values = [one.ratio.value for one in _of(some, way)]
    return f"{percent(math.exp(np.mean(np.log(values))))}, {percent(max(values))}"


def _nees(some: Sequence[Sequence[Regret]], way: str) -> str:
    return spread([one.nees for one in _of(some, way)])


def spread(values: Sequence[float]) -> str:
    """The smallest and the largest of some values; nothing of those that are none."""
    known = [one for one in values if math.isfinite(one)]
    if not known:
        return ""
    return f"{known[0]:.3g}" if len(known) == 1 else f"{min(known):.3g} to {max(known):.3g}"


def percent(ratio: float) -> str:
    """A ratio as what is above 1, in percent; as a factor from 2 on."""
    return f"x {ratio:.3g}" if ratio >= 2.0 else f"{100.0 * (ratio - 1.0):+.1f} %"


def group_table(results: Sequence[Result], protocol: Protocol, group: str) -> str:
    """Regrets of all ways in the cases of a group, in percent; significantly worse than the best: in italics."""
    cases = [case for case in protocol.cases if case.group == group]
    columns = [{one.way: one for one in regrets(results, case)} for case in cases]
    ways = dict.fromkeys(way for column in columns for way in column)
    order = sorted(ways, key=lambda way: _rank(columns, way))
    heads = ["way", *(f"`{case.name}`" for case in cases), "NEES / n", "passes", "seconds"]
    return markdown_table(heads, [_row(way, columns) for way in order])


def _rank(columns: Sequence[Mapping[str, Regret]], way: str) -> float:
    return float(np.mean([math.log(one[way].ratio.value) if way in one else 9.0 for one in columns]))


def _row(way: str, columns: Sequence[Mapping[str, Regret]]) -> list[str]:
    there = [one[way] for one in columns if way in one]
    cells = [_cell(one.get(way)) for one in columns]
    name = f"**{way}**" if way in (STUDY, STUDY_LOG_SCORE) else way
    taken = f"{np.median([one.runs for one in there]):.0f}", f"{np.median([one.seconds for one in there]):.2g}"
    return [name, *cells, spread([one.nees for one in there]), *taken]


def _cell(one: Regret | None) -> str:
    if one is None:
        return "-"
    half = 50.0 * (one.ratio.high - one.ratio.low)
    said = percent(one.ratio.value)
    if one.ratio.value < 2.0 and one.sets > 1:
        said = f"{said[:-2]} ± {half:.1f} %" if half < 100.0 else f"{said[:-2]} ± 100 % or more"
    failed = f", {one.failures} of {one.sets} failed" if one.failures else ""
    said = f"*{said}*" if one.worse else said
    return f"**{said}**{failed}" if one.equal else f"{said}{failed}"


def budget_table(results: Sequence[Result], protocol: Protocol) -> str:
    """Mean regret over the cases of groups A to D and F, at each budget of passes and of seconds."""
    cases = [case for case in protocol.cases if case.group in "ABCDF"]
    by_runs = [f"{one:g}" for one in RUNS if one <= protocol.runs]
    by_seconds = [f"{one:g}" for one in SECONDS if one <= protocol.seconds]
    looks = [(f"{key} passes", within("by_runs", key)) for key in by_runs]
    looks += [(f"{key} s", within("by_seconds", key)) for key in by_seconds]
    found = {name: [{one.way: one for one in regrets(results, case, at)} for case in cases] for name, at in looks}
    rows = []
    for way in (*WAYS, *FULL_WAYS, STUDY, STUDY_LOG_SCORE):
        logs = [[math.log(one[way].ratio.value) for one in columns if way in one] for columns in found.values()]
        if logs and all(logs):
            means = [float(np.mean(some)) for some in logs]
            rows.append((means[-1], [way, str(len(logs[-1])), *(percent(math.exp(one)) for one in means)]))
    return markdown_table(["way", "cases", *found], [row for _, row in sorted(rows, key=lambda one: one[0])])


def ways_table() -> str:
    """What the ways are, whose, and when to use which."""
    rows = [
        [
            f"`{name}`",
            way.about,
            "yes" if TRUTH in way.needs else "",
            "yes" if GRADIENT in way.needs else "",
            way.when,
        ]
        for name, way in WAYS.items()
    ]
    sources = [way.source for way in WAYS.values()]
    heads = ["way", "what it does", "truth", "gradient", "use it", "source"]
    return markdown_table(heads, [[*row, source] for row, source in zip(rows, sources, strict=True)])


def tables(results: Sequence[Result], protocol: Protocol) -> dict[str, Callable[[], str]]:
    """The tables of the page, by name."""
    of_groups = {f"group {key}": (lambda key=key: group_table(results, protocol, key)) for key in GROUPS}
    return {
        "what to use": lambda: what_to_use(results, protocol),
        "ways": ways_table,
        "budgets": lambda: budget_table(results, protocol),
        **of_groups,
    }


# The picture of the study of ways: regrets by group, at each budget of passes.


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
