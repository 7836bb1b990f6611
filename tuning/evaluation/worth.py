"""Held-out results in words: the gain over each baseline, and what the scaled default is.

NIS is the normalised innovation squared.
"""

from __future__ import annotations

from math import isnan

from filters.consistency.intervals import Interval, slightly
from tuning.evaluation.baselines import NO_RANGES, ORACLE, RULE, SCALED
from tuning.evaluation.held_out import Comparison


def without_truth(name: str) -> str:
    """A sentence on what is compared where a problem, called `name`, has no truth."""
    return (
        f"{name} has no truth: filters are compared by how well they predict the measurements, the log-likelihood "
        "and the NIS of their innovations."
    )


def worth(comparison: Comparison, what: str = "the score") -> str:
    """The effect of tuning on `what`: against the scaled default, if there is one, and the rule of thumb.

    Without truth it is the effect on the log-likelihood of a run's innovations.
    """
    if not comparison.tuned.has_truth:
        return _likelihood_worth(comparison)
    ratios, seeds = comparison.ratios, len(comparison.seeds)
    names = [name for name in (SCALED, RULE) if name in ratios]
    first, *others = (f"{gain(ratios[name], seeds, what)} against the {comparison.label(name)}" for name in names)
    shared = first.partition(" against " if "no difference" in first else " by ")[0]
    return " and ".join([first, *(other.removeprefix(f"{shared} ") for other in others)])


def _likelihood_worth(comparison: Comparison) -> str:
    gains = {name: gained for name, gained in comparison.likelihood_gains.items() if name in (SCALED, RULE)}
    parts: list[str] = []
    for name, gained in gains.items():
        verb, (value, low, high) = ("raises" if gained.value >= 0 else "lowers"), sized(gained)
        if not isnan(value):
            what = "" if parts and parts[0].startswith(verb) else f"{verb} the log-likelihood of a run "
            parts.append(f"{what}by {value:.2f} [{low:.2f}, {high:.2f}] against the {comparison.label(name)}")
    return " and ".join(parts) if parts else "makes no difference that can be told without truth"


def sized(gained: Interval) -> Interval:
    """A gain with its interval, or the size of a loss: what "above" or "below" is said of."""
    return gained if gained.value >= 0 else Interval(-gained.value, -gained.high, -gained.low)


def gain(ratio: Interval, seeds: int, what: str = "the score") -> str:
    """A ratio of scores over those of a baseline in words, with its interval."""
    if ratio.low <= 1 <= ratio.high:
        return f"makes no difference that {seeds} seeds can show"
    ends = sorted(100 * abs(1 - part) for part in (ratio.low, ratio.high))
    verb = "lowers" if ratio.high < 1 else "raises"
    if slight := slightly(ratio):
        return f"{verb} {what} by {slight} (practically nothing)"
    return f"{verb} {what} by {100 * abs(1 - ratio.value):.0f} % [{ends[0]:.0f}, {ends[1]:.0f}]"


def scaling_sentence(comparison: Comparison) -> str:
    """What the scaled default is, or why there is none; empty where the comparison has no record of it."""
    found = comparison.default
    if found is None:
        return ""
    rule, known = comparison.rule, comparison.rule == RULE
    its, remark = (" with its Q", "") if known else ("", f" {NO_RANGES}")
    if found.choice is None:
        return f"There is no {SCALED}, so the {rule} comes first: {found.reason}.{remark}"
    if found.factor is None or found.nis is None:
        raise ValueError(f"a scaled default must have its factor and mean NIS, but got {found}")
    oracle = f"; the {ORACLE} has the plant's own Q and R" if comparison.true is not None else ""
    return (
        f"The {SCALED} is the {rule}{its} times {found.factor:.4g}, which brings the mean NIS on the "
        f"training runs to {found.nis * comparison.tuned.expected_nis:.2f}{oracle}.{remark}"
    )
