"""What a comparison says: a table for each noise, and an answer to each question that it was made for."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from filters.consistency.intervals import Interval
from training.comparison.runs import Result
from training.comparison.statistics import as_interval, typical_error, typical_return

KINDS = {"ppo": "PPO", "recurrent-ppo": "recurrent PPO", "pi": "PI", "lqr": "LQG"}
HEADER = ["policy: what it observes", "return", "gap closed", "transient", "steady", "reversal", "observed"]
FILTERED = ("ekf", "enkf", "belief")
GOAL = 0.7  # of the gap between raw and true, at medium noise
Key = tuple[str, str, str]  # noise, kind, label
Groups = Mapping[Key, Sequence[Result]]


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


def rows_of(results: Sequence[Result], noise: str) -> list[list[str]]:
    """Rows of the table for one noise, under `HEADER`.

    Interquartile means over seeds: the return with half of its 95 % interval; the part of PPO's gap between raw
    and true observations that a policy closes; thrust errors, RMS [N], within 0.15 s of a step of the reference,
    after that, and within 0.15 s of a change of its sign; and the error of the thrust that is observed.
    """
    groups, rows = by_policy(results), []
    gap = _ends_of_gap(groups, noise)
    for (of, kind, label), group in groups.items():
        if of != noise:
            continue
        name = "LQR" if (kind, label) == ("lqr", "true") else KINDS[kind]
        value = as_interval(figure := typical_return(group))
        closed = "" if gap is None else f"{_closed(figure, *gap)[0]:.0%}".replace("%", " %")
        errors = [typical_error(group, part)[0] for part in ("transient", "steady", "reversal", "observed")]
        shown = f"{value.value:.3f} ± {(value.high - value.low) / 2:.3f}"
        rows.append([f"{name}: {label}", shown, closed, *[f"{error:.2f}" for error in errors]])
    return rows


def answers(results: Sequence[Result]) -> list[str]:
    """Sentences that answer the questions of the comparison, as far as its runs allow."""
    groups = by_policy(results)
    return [sentence for question in (_goal, _tuned, _wrong_model) for sentence in question(groups)]


def summary_rows(results: Sequence[Result]) -> list[list[str]]:
    """What matters, a row a question and a column a noise, with 95 % intervals; empty where a run is missing."""
    groups = by_policy(results)
    rows = [[f"gap closed by {arm}"] for arm in ("raw+action", "stack", *FILTERED)]
    rows += [["cost on stack / on ekf"], ["cost on ekf / on true"]]
    rows += [["reversal error of PPO / of PI, both on ekf"], ["cost of PPO / of LQG, both on ekf"]]
    for noise in noises_of(groups):
        gap = _ends_of_gap(groups, noise)
        ppo = {arm: _figure(groups, noise, "ppo", arm) for arm in ("raw+action", "stack", "true", *FILTERED)}
        closed = [
            None if gap is None or ppo[arm] is None else _closed(ppo[arm], *gap) for arm in ppo if arm != "true"
        ]
        cells = [_percent(as_interval(figure)) if figure is not None else "" for figure in closed]
        reversals = [groups.get((noise, kind, "ekf")) for kind in ("ppo", "pi")]
        errors = [typical_error(group, "reversal") if group else None for group in reversals]
        pairs = [(ppo["stack"], ppo["ekf"]), (ppo["ekf"], ppo["true"]), tuple(errors)]
        pairs.append((ppo["ekf"], _figure(groups, noise, "lqr", "ekf")))
        for row, cell in zip(rows, [*cells, *[_ratio(*pair) for pair in pairs]], strict=True):
            row.append(cell)
    return rows


def _figure(groups: Groups, noise: str, kind: str, label: str) -> np.ndarray | None:
    group = groups.get((noise, kind, label))
    return typical_return(group) if group else None


def _ratio(above: np.ndarray | None, below: np.ndarray | None) -> str:
    return "" if above is None or below is None else _shown(as_interval(above / below), ".2f")


def _goal(groups: Groups) -> Iterator[str]:
    gap = _ends_of_gap(groups, "medium")
    found = [_figure(groups, "medium", "ppo", arm) for arm in FILTERED]
    closed = [as_interval(_closed(figure, *gap)) for figure in found if gap is not None and figure is not None]
    if closed:
        least = min(closed, key=lambda value: value.low)
        said = "reached" if least.low >= GOAL else "not reached by all, intervals counted"
        yield (
            f"At medium noise filtered state closes at least {_percent(least)} of the gap between raw and true; "
            f"the aim of {100 * GOAL:.0f} % is {said}."
        )


def _tuned(groups: Groups) -> Iterator[str]:
    for about, one, other, called in (
        ("the exact model", "ekf, tuned", "ekf, untuned", "the untuned one"),
        ("a wrong model", "ekf, wrong model tuned", "ekf, wrong model", "the one with the plant's Q and R"),
    ):
        found = [groups.get(("medium", "ppo", label)) for label in (one, other)]
        if all(found):
            value = as_interval(typical_return(found[0]) - typical_return(found[1]))
            yield (
                f"With {about}, the policy on the tuned EKF returns {_shown(value, '+.3f')} more than that on "
                f"{called}: {_verdict(value)}."
            )


def _wrong_model(groups: Groups) -> Iterator[str]:
    for arm in ("ekf", "enkf"):
        found = [groups.get(("medium", "ppo", label)) for label in (f"{arm}, wrong model", arm)]
        if all(found):
            value = as_interval(typical_return(found[0]) / typical_return(found[1]))
            yield f"A wrong model in the {arm} multiplies the policy's cost by {_shown(value, '.2f')}."


def _ends_of_gap(groups: Groups, noise: str) -> tuple[np.ndarray, np.ndarray] | None:
    """Return on raw and on true observations, as figures; None unless true ones are better beyond doubt."""
    found = [groups.get((noise, "ppo", arm)) for arm in ("raw", "true")]
    if not all(found):
        return None
    raw, true = map(typical_return, found)
    return (raw, true) if as_interval(true - raw).low > 0 else None


def _closed(figure: np.ndarray, raw: np.ndarray, true: np.ndarray) -> np.ndarray:
    """Part of the gap that is closed: 0 is as good as raw, 1 as good as true."""
    return (figure - raw) / (true - raw)


def _verdict(value: Interval) -> str:
    if value.low > 0:
        return "better"
    return "worse" if value.high < 0 else "no difference that these seeds show"


def _shown(value: Interval, form: str) -> str:
    return f"{value.value:{form}} [{value.low:{form}}, {value.high:{form}}]"


def _percent(value: Interval) -> str:
    return f"{value.value:.0%} [{value.low:.0%}, {value.high:.0%}]".replace("%", " %")
