"""Tables of the study of methods: what to use when, and the regret of every method in every case."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np

from thruster_env.core.files import legend_below, new_figure, save_figure, tidy
from thruster_env.core.text_tables import markdown_table
from tuning.api.markers import OUTPUT, ExecutorOption, Option
from tuning.api.markers import RUNS as RUNS_PANEL
from tuning.api.result import Printed
from tuning.cli.output import progress_of
from tuning.experiments.methods_problems import (
    FAST,
    GROUPS,
    ORACLE,
    PREDICTIONS,
    RUNS,
    SCALED,
    START,
    STUDY,
    STUDY_LOG_SCORE,
    WITH_FULL,
    Case,
    Protocol,
)
from tuning.experiments.methods_runs import Regret, Result, regrets, run_protocol, within
from tuning.methods.task import ALONE, TRUTH
from tuning.search.plan import LIKELIHOOD

# Methods that look at no true state; but searches minimise an error where there are true states.
BLIND = (
    *(name for name, method in ALONE.items() if TRUTH not in method.needs),
    f"{LIKELIHOOD}{WITH_FULL}",
    f"als{WITH_FULL}",
)
SEARCHES = ("nelder-mead", "coordinate-steps", "tpe-only", "gp-only", "cma-es-only", "random-only")
ENOUGH, ENOUGH_NATS = 0.005, 0.02  # of log ratios and log scores, up to which the cheaper method is taken
NO_METHODS = (START, ORACLE)  # nobody has these
NOT_ON_PAGE = ", 3 runs", ", 10 runs"  # ends of names of cases
LEAST, MOST = 1e-4, 3.0  # of log ratios, at which points are clipped
MARKS = dict(zip(RUNS, (("o", "0.75"), ("o", "C0"), ("o", "C3")), strict=True))
FOLDER = Path("out") / "methods"


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


def is_blind(method: str, case: Case) -> bool:
    """Whether a method looks at no true state in a case."""
    return method in BLIND and (method not in SEARCHES or not case.truth)


def what_to_use(results: Sequence[Result], protocol: Protocol) -> str:
    """The cheapest method within 0.5 % of the least error, and that within 0.02 nat of the best log score."""
    of_error, of_log_score = ["least error", "regret, mean and worst case"], ["best log score", "regret"]
    heads = ["you have", *of_error, "NEES / n", *of_log_score, "NEES / n"]
    rows = []
    for situation in SITUATIONS:
        cases = [case for case in protocol.cases if situation.has(case)]
        by_case = [regrets(results, case) for case in cases]
        allowed = [
            [regret for regret in each if _may(regret.method, case, situation)]
            for each, case in zip(by_case, cases, strict=True)
        ]
        allowed = [of_case for of_case in allowed if of_case]
        if not allowed:
            continue
        everywhere = set.intersection(*({regret.method for regret in each} for each in allowed)) - {SCALED}
        if not everywhere:
            continue
        error = _cheapest(allowed, everywhere, _log_ratio, ENOUGH)
        proper = _cheapest(allowed, everywhere, lambda regret: _finite(regret.log_score), ENOUGH_NATS)
        cells = [[f"`{method}`", _both(allowed, method), _nees(allowed, method)] for method in (error, proper)]
        rows.append([situation.text, *cells[0], *cells[1]])
    return markdown_table(heads, rows)


def _cheapest(
    by_case: Sequence[Sequence[Regret]], methods: set[str], of: Callable[[Regret], float], enough: float
) -> str:
    """The method of the least time among those whose mean is within what is enough of the least mean."""
    means = {method: _mean(by_case, method, of) for method in methods}
    near = [method for method in methods if means[method] <= min(means.values()) + enough]
    return min(near, key=lambda method: _mean(by_case, method, lambda regret: regret.seconds))


def _may(method: str, case: Case, situation: Situation) -> bool:
    return method not in NO_METHODS and (situation.truth or is_blind(method, case))


def _of(by_case: Sequence[Sequence[Regret]], method: str) -> list[Regret]:
    return [regret for each in by_case for regret in each if regret.method == method]


def _mean(by_case: Sequence[Sequence[Regret]], method: str, of: Callable[[Regret], float]) -> float:
    return float(np.mean([of(regret) for regret in _of(by_case, method)]))


def _log_ratio(regret: Regret) -> float:
    return math.log(regret.ratio.value)


def _finite(value: float) -> float:
    return value if math.isfinite(value) else 1e6


def _both(by_case: Sequence[Sequence[Regret]], method: str) -> str:
    values = [regret.ratio.value for regret in _of(by_case, method)]
    return f"{percent(math.exp(np.mean(np.log(values))))}, {percent(max(values))}"


def _nees(by_case: Sequence[Sequence[Regret]], method: str) -> str:
    return spread([regret.nees for regret in _of(by_case, method)])


def spread(values: Sequence[float]) -> str:
    """The smallest and the largest of some values; nothing of those that are none."""
    known = [value for value in values if math.isfinite(value)]
    if not known:
        return ""
    return f"{known[0]:.3g}" if len(known) == 1 else f"{min(known):.3g} to {max(known):.3g}"


def percent(ratio: float) -> str:
    """A ratio as what is above 1, in percent; as a factor from 2 on."""
    return f"x {ratio:.3g}" if ratio >= 2.0 else f"{100.0 * (ratio - 1.0):+.1f} %"


def group_table(results: Sequence[Result], protocol: Protocol, groups: str) -> str:
    """Regrets [%] of all methods in the cases of some groups; in italics if significantly worse than the best.

    NEES / n is the range over all cases, also those that have no column.
    """
    cases = [case for case in protocol.cases if case.group in groups]
    by_name = {case.name: {regret.method: regret for regret in regrets(results, case)} for case in cases}
    on_page = [case for case in cases if not case.name.endswith(NOT_ON_PAGE)]
    columns = [by_name[case.name] for case in on_page]
    methods = dict.fromkeys(method for column in columns for method in column)
    rows = []
    for method in sorted(methods, key=lambda method: _rank(columns, method)):
        name = f"**{method}**" if method in (STUDY, STUDY_LOG_SCORE) else method
        values = [column[method].nees for column in by_name.values() if method in column]
        rows.append([name, *(_cell(column.get(method)) for column in columns), spread(values)])
    heads = ["method", *(f"{case.group}: `{case.name}`" for case in on_page), "NEES / n"]
    return markdown_table(heads, rows)


def _rank(columns: Sequence[Mapping[str, Regret]], method: str) -> float:
    return float(np.mean([math.log(column[method].ratio.value) for column in columns if method in column]))


def _cell(regret: Regret | None) -> str:
    if regret is None:
        return "-"
    value = 100.0 * (regret.ratio.value - 1.0)
    text = f"{value:+.1f}" if value < 100.0 else f"{value:+.0f}"
    text = f"*{text}*" if regret.worse else text
    return f"{f'**{text}**' if regret.equal else text}{' †' if regret.failures else ''}"


def tables(results: Sequence[Result], protocol: Protocol) -> dict[str, Callable[[], str]]:
    """The tables of the page, by name."""
    return {
        "what to use": lambda: what_to_use(results, protocol),
        "groups A to D": lambda: group_table(results, protocol, "ABCD"),
        "groups E and H": lambda: group_table(results, protocol, "EH"),
        "group F": lambda: group_table(results, protocol, "F"),
        "group G": lambda: group_table(results, protocol, "G"),
    }


def figure(results: Sequence[Result], protocol: Protocol, path: str | Path) -> Path:
    """A panel a group: the mean log ratio of each method over the cases, after each budget of passes."""
    groups = [key for key in GROUPS if any(case.group == key for case in protocol.cases)]
    rows = -(-len(groups) // 2)
    drawn = new_figure((10.0, 5.2 * rows))
    axes = drawn.subplots(rows, 2, squeeze=False)
    tidy(axes.flat)
    for axis in axes.flat[len(groups) :]:
        axis.set_visible(False)
    for axis, group in zip(axes.flat, groups, strict=False):
        cases = [case for case in protocol.cases if case.group == group]
        budgets = [limit for limit in RUNS if limit <= protocol.runs]
        points: dict[float, dict[str, float]] = {}
        for budget in budgets:
            by_case = [regrets(results, case, within("by_runs", f"{budget:g}")) for case in cases]
            methods = dict.fromkeys(regret.method for each in by_case for regret in each)
            points[budget] = {method: _mean(by_case, method, _log_ratio) for method in methods}
        if not points or not points[budgets[-1]]:
            continue
        order = sorted(points[budgets[-1]], key=points[budgets[-1]].__getitem__, reverse=True)
        for budget in budgets:
            mark, colour = MARKS[budget]
            values = [100.0 * np.clip(points[budget].get(method, np.nan), LEAST, MOST) for method in order]
            axis.plot(values, range(len(order)), mark, color=colour, markersize=4, label=f"{budget:g} passes")
        axis.set_xscale("log")
        axis.set_xlim(60.0 * LEAST, 150.0 * MOST)
        axis.set_yticks(range(len(order)), order, fontsize=6)
        for label in axis.get_yticklabels():
            label.set_fontweight("bold" if label.get_text() in (STUDY, START) else "normal")
        axis.set_title(f"{group}: {GROUPS[group]}", fontsize=10)
        axis.set_xlabel("regret [%]")
    legend_below(drawn, axes.flat[:1])
    drawn.suptitle(
        "Score over that of the best constant numbers, held out; left of 0.01 % is drawn there", fontsize=11
    )
    return save_figure(drawn, path)


def reproduce(
    groups: Annotated[str, Option(RUNS_PANEL)] = "ABCDEFGH",
    method: Annotated[Sequence[str], Option(RUNS_PANEL)] = (),
    sets: Annotated[int | None, Option(RUNS_PANEL, least=2, most=20)] = None,
    runs: Annotated[float | None, Option(RUNS_PANEL, least=100, most=1e7)] = None,
    seconds: Annotated[float | None, Option(RUNS_PANEL, least=0.1, most=1e4)] = None,
    many: Annotated[int | None, Option(RUNS_PANEL, least=10, most=10**5)] = None,
    starts: Annotated[int | None, Option(RUNS_PANEL, least=1, most=100)] = None,
    executor: ExecutorOption = None,
    quick: Annotated[bool, Option(RUNS_PANEL)] = False,
    out: Annotated[Path, Option(OUTPUT)] = FOLDER,
) -> Printed:
    """Run every method of tuning on the same data within the same budget, and score it on held-out truth.

    The regret of a method is its score over that of the best constant parameters, found by gradients from many
    starts on many runs. Ctrl-C keeps finished results, and the same command continues. The whole study takes days;
    the options reduce it, and results of different budgets are stored separately.

    Example: thruster reproduce methods --quick

    Args:
        groups: groups of problems.
        method: a method, may be repeated; by default all.
        sets: data sets; 20.
        runs: passes that a method may take; 1e5.
        seconds: seconds of one core; 100.
        many: runs of the reference; 2000.
        starts: starts of the reference; 20.
        executor: where results are computed: in N processes, in those of `mpirun`, or on the workers of a Dask
            scheduler; in this process by default.
        quick: a test run without meaningful results.
        out: folder of results and of the picture, which several hosts may share; existing results stay.
    """
    protocol = FAST if quick else Protocol()
    changes: dict[str, Any] = {"sets": sets, "runs": runs, "seconds": seconds, "many": many, "starts": starts}
    changes["methods"] = tuple(method) if method else None
    changes["cases"] = tuple(case for case in protocol.cases if case.group in groups) or None
    protocol = protocol._replace(**{name: value for name, value in changes.items() if value is not None})
    with progress_of("methods", out) as progress:
        results = run_protocol(protocol, out, executor, progress)
    picture = figure(results, protocol, out / "groups.png")
    texts = {name: make() for name, make in tables(results, protocol).items()}
    data = {
        "results": [result._asdict() for result in results],
        "predictions": [prediction._asdict() for prediction in PREDICTIONS],
        "files": [str(picture)],
    }
    return Printed([*(f"{name}\n\n{content}" for name, content in texts.items()), f"wrote {picture}"], data)


ON_PAGE = Protocol(sets=6, runs=1e4, seconds=10.0, many=200, starts=4)


@cache
def stored() -> list[Result]:
    """All results of the page, of which those in the folder are not computed again."""
    return run_protocol(ON_PAGE, FOLDER)


TABLES = {name: lambda name=name: tables(stored(), ON_PAGE)[name]() for name in tables((), ON_PAGE)}
FIGURES = {"appendix/methods_groups.png": lambda path: figure(stored(), ON_PAGE, path)}
