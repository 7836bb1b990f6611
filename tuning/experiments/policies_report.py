"""A comparison in tables, sentences that answer its questions, and two pictures.

There is a table for each noise level, and a summary with a row for each question. The pictures are learning curves
by observation set, and cost against observation error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from filters.consistency.nees import Interval
from filters.logs.findings import colour_of
from thruster_env.core.files import DARK, legend_below, new_figure, save_figure, tidy
from thruster_env.core.text_tables import Table, markdown_table
from tuning.api.markers import OUTPUT, RUNS, ExecutorOption, Option
from tuning.api.result import Printed
from tuning.cli.output import progress_of
from tuning.experiments.policies import (
    BEST,
    NOISES,
    QUICK,
    VARIANT_NOISE,
    WRONG,
    Comparison,
    Figure,
    Result,
    as_interval,
    combined,
    run_comparison,
    typical_error,
    typical_return,
)

KINDS = {
    "ppo": "PPO",
    "sac": "SAC",
    "ppo+mpc": "PPO + MPC",
    "sac+mpc": "SAC + MPC",
    "recurrent-ppo": "recurrent PPO",
    "pi": "PI",
    "lqr": "LQG",
    "one-step": "one step",
    "mpc": "MPC",
}
HEADER = ["policy: what it observes", "return", "gap closed", "transient", "steady", "reversal", "observed"]
FILTERED = ("ekf", "enkf", "belief")
Key = tuple[str, str, str]  # noise, kind, label
Groups = Mapping[Key, Sequence[Result]]
# Rows of the summary: kinds and labels of the figures that are compared.
GAPS = [
    ("mpc", "ekf"),
    *(("ppo", observed) for observed in ("raw+action", "stack", *FILTERED)),
    ("ppo+mpc", "ekf"),
]
RATIOS = [
    (("mpc", "ekf"), ("mpc", "true")),
    (("mpc", "enkf"), ("mpc", "ekf")),
    (("mpc", "ukf"), ("mpc", "ekf")),
    (("one-step", "ekf"), ("mpc", "ekf")),
    (("lqr", "ekf"), ("mpc", "ekf")),
    (("ppo", "ekf"), ("mpc", "ekf")),
    (("ppo+mpc", "ekf"), ("mpc", "ekf")),
    (("ppo", "stack"), ("ppo", "ekf")),
]

# Of the pictures.
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

# Of the page.
NOT_ON_PAGE = "lowpass", "kf", "ukf"
FOLDER = Path("out") / "comparison"
ROUGH = "Rough, by --quick: it shows that everything runs, not which policy is better."


def by_policy(results: Sequence[Result]) -> dict[Key, list[Result]]:
    """Results by policy and noise, one for each training seed."""
    groups: dict[Key, list[Result]] = {}
    for result in results:
        run = result.run
        groups.setdefault((run.noise, run.kind, run.label), []).append(result)
    return groups


def noises_of(groups: Groups) -> list[str]:
    """The noise levels of some results, in their order."""
    return list(dict.fromkeys(noise for noise, _, _ in groups))


def name_of(kind: str, label: str) -> str:
    """Name of a policy and its observations in tables."""
    return f"{'LQR' if (kind, label) == ('lqr', 'true') else KINDS[kind]}: {label}"


def rows_of(results: Sequence[Result], noise: str) -> list[list[str]]:
    """Rows of the table for one noise, under `HEADER`.

    Means over seeds: the return with half of its 95 % interval; the part of the gap between PPO on raw
    measurements and the best controller on the true state that a policy closes; thrust errors, RMS [N], within
    0.15 s of a step of the reference, later, and within 0.15 s of a change of its sign; and the error of the
    observed thrust.
    """
    groups, rows = by_policy(results), []
    gap = ends_of_gap(groups, noise)
    for (of, kind, label), group in groups.items():
        if of != noise:
            continue
        value = as_interval(figure := typical_return(group))
        part = "" if gap is None else percent(closed(figure, *gap).value)
        errors = [typical_error(group, part).value for part in ("transient", "steady", "reversal", "observed")]
        return_text = f"{value.value:.3f} ± {(value.high - value.low) / 2:.3f}"
        rows.append([name_of(kind, label), return_text, part, *[f"{error:.2f}" for error in errors]])
    return rows


def summary_rows(results: Sequence[Result]) -> list[list[str]]:
    """A row for each question, a column for each noise level, 95 % intervals; empty where a run is missing."""
    groups = by_policy(results)
    noises = noises_of(groups)

    def row(title: str, cell: Callable[[str], str]) -> list[str]:
        return [title, *(cell(noise) for noise in noises)]

    rows = [row(f"gap closed by {name_of(*policy)}", partial(_gap_cell, groups, policy=policy)) for policy in GAPS]
    for above, below in RATIOS:
        title = f"cost of {name_of(*above)} / of {name_of(*below)}"
        rows.append(row(title, partial(_ratio_cell, groups, above=above, below=below)))
    return rows


def figure_of(groups: Groups, noise: str, kind: str, label: str) -> Figure | None:
    """The return of a policy; None if there is no run of it."""
    group = groups.get((noise, kind, label))
    return typical_return(group) if group else None


def ends_of_gap(groups: Groups, noise: str) -> tuple[Figure, Figure] | None:
    """Return of PPO on raw and of the best controller on true observations; None unless this is better."""
    raw, true = (figure_of(groups, noise, *of) for of in (("ppo", "raw"), (BEST, "true")))
    if raw is None or true is None or not as_interval(true - raw).low > 0:
        return None
    return raw, true


def closed(figure: Figure, raw: Figure, true: Figure) -> Figure:
    """Part of the gap that is closed: 0 is as good as PPO on raw, 1 as the best controller on the state."""
    return combined(lambda a, low, high: (a - low) / (high - low), figure, raw, true)


def as_text(value: Interval, form: str) -> str:
    """An estimate and its interval."""
    return f"{value.value:{form}} [{value.low:{form}}, {value.high:{form}}]"


def percent(value: Interval | float) -> str:
    """An estimate in per cent, with its interval if it has one."""
    if isinstance(value, Interval):
        return as_text(value, ".1%").replace("%", " %")
    return f"{100 * value:.0f} %"


def _gap_cell(groups: Groups, noise: str, policy: tuple[str, str]) -> str:
    figure, gap = figure_of(groups, noise, *policy), ends_of_gap(groups, noise)
    return "" if figure is None or gap is None else percent(as_interval(closed(figure, *gap)))


def _ratio_cell(groups: Groups, noise: str, above: tuple[str, str], below: tuple[str, str]) -> str:
    top, bottom = (figure_of(groups, noise, *of) for of in (above, below))
    return "" if top is None or bottom is None else as_text(as_interval(top / bottom), ".3f")


GOAL = 0.7  # of the gap between raw and true, at medium noise
NEAR = 0.02  # of the best controller's cost: tolerance within which a learnt policy reaches it
TUNED, TUNED_WRONG = ("ekf, tuned", "ekf, untuned"), ("ekf, wrong model tuned", "ekf, wrong model")
WORTH = {  # of a better estimate to the same controller, without training: what is better, and than what
    "knowing the true state": ("true", "ekf"),
    "tuning the EKF's Q and R, against the rule of thumb,": TUNED,
    "tuning them, where the model is wrong, against the plant's": TUNED_WRONG,
    "a right model": ("ekf", "ekf, wrong model"),
}


def pairs() -> Iterator[tuple[str, str, str, str, str, str]]:
    """Sentences on medium noise: text, kind and label of two policies, and the form of the difference of returns.

    Without a form it is the ratio of costs.
    """
    for what, (better, other) in WORTH.items():
        yield f"With the same controller (MPC), {what} is worth {{}}: ", BEST, better, BEST, other, "+.4f"
    for observed in ("true", "ekf"):
        for kind in ("ppo", "sac", "ppo+mpc", "sac+mpc"):
            text = f"{name_of(kind, observed)} costs {{}} times as much as MPC: "
            yield text, kind, observed, BEST, observed, ""
    for label in (f"ekf, {variant}" for variant in WRONG):
        for kind in ("ppo", "ppo+mpc"):
            yield f"{name_of(kind, label)} returns {{}} more than MPC: ", kind, label, BEST, label, "+.3f"
    for about, (tuned, other), called in (
        ("the exact model", TUNED, "the untuned one"),
        ("a wrong model", TUNED_WRONG, "the one with the plant's Q and R"),
    ):
        text = f"With {about}, PPO on the tuned EKF returns {{}} more than on {called}: "
        yield text, "ppo", tuned, "ppo", other, "+.3f"
    for observed in ("ekf", "enkf"):
        for kind in ("ppo", BEST):
            text = f"A wrong model multiplies the cost of {name_of(kind, observed)} by {{}}"
            yield text, kind, f"{observed}, wrong model", kind, observed, ""


def answers(results: Sequence[Result]) -> list[str]:
    """Sentences on medium noise."""
    groups, sentences = by_policy(results), []
    gap = ends_of_gap(groups, VARIANT_NOISE)
    figures = [figure_of(groups, VARIANT_NOISE, "ppo", observed) for observed in FILTERED]
    parts = [as_interval(closed(figure, *gap)) for figure in figures if gap is not None and figure is not None]
    if parts:
        least = min(parts, key=lambda value: value.low)
        outcome = "reached" if least.low >= GOAL else "not reached by all, intervals counted"
        sentences.append(
            f"At medium noise PPO on filtered state closes at least {percent(least)} of the gap between PPO on "
            f"raw measurements and {name_of(BEST, 'true')}; the aim of {100 * GOAL:.0f} % is {outcome}."
        )
    for text, kind, label, other_kind, other, form in pairs():
        first, second = (figure_of(groups, VARIANT_NOISE, *of) for of in ((kind, label), (other_kind, other)))
        if first is not None and second is not None:
            value = as_interval(first - second if form else first / second)
            ended = _verdict(value, bool(form)) if text.endswith(": ") else ""
            sentences.append(f"{text.format(as_text(value, form or '.3f'))}{ended}.")
    return sentences


def _verdict(value: Interval, is_difference: bool) -> str:
    if is_difference:
        return "better" if value.low > 0 else "worse" if value.high < 0 else "no significant difference"
    if value.high < 1:
        return "better"
    near = f"within {100 * NEAR:.0f} %"
    return near if value.high <= 1 + NEAR else f"not {near}" if value.low > 1 + NEAR else f"perhaps {near}"


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
    legend_below(figure, axes[:1], 2 * len(noises))
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


@cache
def stored() -> list[Result]:
    """All results of the page, of which those in the folder are not computed again."""
    return run_comparison(Comparison(), FOLDER, "processes")


def noise_table(noise: str) -> str:
    """The return of a policy and, at medium noise, its errors; without the observations that are left out."""
    width = len(HEADER) if noise == VARIANT_NOISE else 3
    rows = [row[:width] for row in rows_of(stored(), noise) if row[0].partition(": ")[2] not in NOT_ON_PAGE]
    return markdown_table(HEADER[:width], rows)


TABLES: dict[str, Callable[[], str]] = {
    "summary": lambda: markdown_table(["", *NOISES], summary_rows(stored())),
    "answers": lambda: "\n".join(f"- {sentence}" for sentence in answers(stored())),
    **{f"policies_{noise}": partial(noise_table, noise) for noise in NOISES},
}
FIGURES = {
    "appendix/policies_curves.png": lambda path: learning_curves(stored(), path),
    "appendix/policies_errors.png": lambda path: cost_against_error(stored(), path),
}


def reproduce(
    quick: Annotated[bool, Option(RUNS)] = False,
    seeds: Annotated[int | None, Option(RUNS, least=1, most=1000)] = None,
    steps: Annotated[int | None, Option(RUNS, least=1, most=10**12)] = None,
    recurrent: Annotated[bool, Option(RUNS)] = False,
    executor: ExecutorOption = "processes",
    out: Annotated[Path, Option(OUTPUT)] = FOLDER,
) -> Printed:
    """Train policies on raw, filtered and true state, and compare them with model-predictive control, PI and LQG.

    It trains PPO at three noise levels of the thrust sensor, SAC, and policies that correct the controller, scores
    all on the same held-out episodes, and draws two pictures. Ctrl-C keeps finished work, and the same command
    continues. On two cores it takes an hour or more.

    Example: thruster reproduce policies --quick

    Args:
        quick: one noise, two seeds, few steps: a test run without meaningful results.
        seeds: training seeds of each learned policy; 5 by default.
        steps: training steps of each policy; by default those of `thruster train`.
        recurrent: also PPO with an LSTM on raw measurements: many hours.
        executor: where policies are trained: in N processes (as many as cores), in those of `mpirun`, or on a Dask
            scheduler's workers, which must share the folder.
        out: folder of results and pictures; existing results are not recomputed.
    """
    comparison = QUICK if quick else Comparison()
    changes: dict[str, Any] = {"seeds": seeds, "steps": steps, "recurrent": recurrent or None}
    comparison = comparison._replace(**{name: value for name, value in changes.items() if value is not None})
    with progress_of("policies", out) as progress:
        results = run_comparison(comparison, out, executor, lambda run, *counts: progress(run.name, *counts))
    files = [learning_curves(results, out / "curves.png"), cost_against_error(results, out / "errors.png")]
    rows = {noise: rows_of(results, noise) for noise in comparison.noises}
    conclusions, summary = answers(results), summary_rows(results)
    tables = [Table(f"{noise} noise; thrust errors in N", HEADER, rows[noise]) for noise in rows]
    tables.append(Table("in short, with 95 % intervals", ["", *comparison.noises], summary))
    data = {
        "policies": {noise: [dict(zip(HEADER, row, strict=True)) for row in rows[noise]] for noise in rows},
        "summary": summary,
        "answers": conclusions,
        "files": [str(path) for path in files],
    }
    rough = [ROUGH] if quick else []
    return Printed([*rough, *tables, *conclusions, *(f"wrote {path}" for path in files)], data)
