"""Tables of a comparison: one for each noise level, and a summary with a row for each question.

The sentences that answer each question are in `answers`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial

from filters.consistency.intervals import Interval
from tuning.policies.comparison.plan import BEST
from tuning.policies.comparison.runs import Result
from tuning.policies.comparison.statistics import (
    Figure,
    as_interval,
    combined,
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
        said = f"{value.value:.3f} ± {(value.high - value.low) / 2:.3f}"
        rows.append([name_of(kind, label), said, part, *[f"{error:.2f}" for error in errors]])
    return rows


def summary_rows(results: Sequence[Result]) -> list[list[str]]:
    """A row for each question, a column for each noise level, 95 % intervals; empty where a run is missing."""
    groups = by_policy(results)
    noises = noises_of(groups)

    def row(title: str, cell: Callable[[str], str]) -> list[str]:
        return [title, *(cell(noise) for noise in noises)]

    rows = [row(f"gap closed by {name_of(*one)}", partial(_gap_cell, groups, one=one)) for one in GAPS]
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


def _gap_cell(groups: Groups, noise: str, one: tuple[str, str]) -> str:
    figure, gap = figure_of(groups, noise, *one), ends_of_gap(groups, noise)
    return "" if figure is None or gap is None else percent(as_interval(closed(figure, *gap)))


def _ratio_cell(groups: Groups, noise: str, above: tuple[str, str], below: tuple[str, str]) -> str:
    top, bottom = (figure_of(groups, noise, *of) for of in (above, below))
    return "" if top is None or bottom is None else as_text(as_interval(top / bottom), ".3f")
