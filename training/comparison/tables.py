"""What a comparison says: a table for each noise, and what matters, a row a question.

The sentences that answer each question are in `answers`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from filters.consistency.intervals import Interval
from training.comparison.plan import BEST
from training.comparison.runs import Result
from training.comparison.statistics import Figure, as_interval, combined, typical_error, typical_return

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
# Rows of the summary: what stands first, and the kinds and labels whose figures are set against each other.
GAPS = [("mpc", "ekf"), *(("ppo", arm) for arm in ("raw+action", "stack", *FILTERED)), ("ppo+mpc", "ekf")]
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
    """Results grouped: those of one policy and noise, one for each training seed."""
    groups: dict[Key, list[Result]] = {}
    for result in results:
        run = result.run
        groups.setdefault((run.noise, run.kind, run.label), []).append(result)
    return groups


def noises_of(groups: Groups) -> list[str]:
    """The noises of some results, in their order."""
    return list(dict.fromkeys(noise for noise, _, _ in groups))


def name_of(kind: str, label: str) -> str:
    """A policy and what it observes, as tables call it."""
    return f"{'LQR' if (kind, label) == ('lqr', 'true') else KINDS[kind]}: {label}"


def rows_of(results: Sequence[Result], noise: str) -> list[list[str]]:
    """Rows of the table for one noise, under `HEADER`.

    Means over seeds: the return with half of its 95 % interval; the part of the gap that a policy closes between
    PPO on raw measurements and the best controller on the true state; thrust errors, RMS [N], within 0.15 s of a
    step of the reference, after that, and within 0.15 s of a change of its sign; and the error of the thrust that
    is observed.
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
    """What matters, a row a question and a column a noise, with 95 % intervals; empty where a run is missing."""
    groups = by_policy(results)
    noises = noises_of(groups)

    def row(title: str, cell: Callable[[str], str]) -> list[str]:
        return [title, *(cell(noise) for noise in noises)]

    rows = [
        row(f"gap closed by {name_of(*one)}", lambda noise, one=one: _gap_cell(groups, noise, one)) for one in GAPS
    ]
    for above, below in RATIOS:
        title = f"cost of {name_of(*above)} / of {name_of(*below)}"
        rows.append(row(title, lambda noise, pair=(above, below): _ratio_cell(groups, noise, *pair)))
    return rows


def figure_of(groups: Groups, noise: str, kind: str, label: str) -> Figure | None:
    """The return of a policy; None if there is no run of it."""
    group = groups.get((noise, kind, label))
    return typical_return(group) if group else None


def ends_of_gap(groups: Groups, noise: str) -> tuple[Figure, Figure] | None:
    """Return of PPO on raw and of the best controller on true observations; None unless this is surely better."""
    raw, true = (figure_of(groups, noise, *of) for of in (("ppo", "raw"), (BEST, "true")))
    if raw is None or true is None or not as_interval(true - raw).low > 0:
        return None
    return raw, true


def closed(figure: Figure, raw: Figure, true: Figure) -> Figure:
    """Part of the gap that is closed: 0 is as good as PPO on raw, 1 as the best controller on the state."""
    return combined(lambda a, low, high: (a - low) / (high - low), figure, raw, true)


def shown(value: Interval, form: str) -> str:
    """An estimate and its interval."""
    return f"{value.value:{form}} [{value.low:{form}}, {value.high:{form}}]"


def percent(value: Interval | float) -> str:
    """An estimate in per cent, with its interval if it has one."""
    if isinstance(value, Interval):
        return shown(value, ".1%").replace("%", " %")
    return f"{100 * value:.0f} %"


def _gap_cell(groups: Groups, noise: str, one: tuple[str, str]) -> str:
    figure, gap = figure_of(groups, noise, *one), ends_of_gap(groups, noise)
    return "" if figure is None or gap is None else percent(as_interval(closed(figure, *gap)))


def _ratio_cell(groups: Groups, noise: str, above: tuple[str, str], below: tuple[str, str]) -> str:
    figures = [figure_of(groups, noise, *of) for of in (above, below)]
    return "" if None in figures else shown(as_interval(figures[0] / figures[1]), ".3f")
