"""What a proof says in words: the gain over each baseline, and what the scaled default is."""

from __future__ import annotations

from filters.consistency.intervals import Interval
from tuning.evaluation.baselines import ORACLE, RULE, SCALED
from tuning.evaluation.held_out import Comparison


def worth(proof: Comparison, what: str = "the score") -> str:
    """What tuning does to `what`: against the scaled default, if there is one, and the rule of thumb."""
    ratios, seeds = proof.ratios, len(proof.seeds)
    names = [name for name in (SCALED, RULE) if name in ratios]
    first, *others = (f"{gain(ratios[name], seeds, what)} against the {name}" for name in names)
    shared = first.partition(" against " if "no difference" in first else " by ")[0]
    return " and ".join([first, *(other.removeprefix(f"{shared} ") for other in others)])


def gain(ratio: Interval, seeds: int, what: str = "the score") -> str:
    """What a ratio of scores over those of a baseline says, with its interval."""
    if ratio.low <= 1 <= ratio.high:
        return f"makes no difference that {seeds} seeds can show"
    ends = sorted(100 * abs(1 - part) for part in (ratio.low, ratio.high))
    verb = "lowers" if ratio.high < 1 else "raises"
    return f"{verb} {what} by {100 * abs(1 - ratio.value):.0f} % [{ends[0]:.0f}, {ends[1]:.0f}]"


def scaling_sentence(proof: Comparison) -> str:
    """What the scaled default is, or why there is none; empty where the proof does not know."""
    found = proof.default
    if found is None:
        return ""
    if found.choice is None:
        return f"There is no {SCALED}, so the {RULE} comes first: {found.reason}."
    return (
        f"The {SCALED} is the {RULE} with its Q times {found.factor:.4g}, which brings the mean NIS on the "
        f"training runs to {found.nis:.2f}; the {ORACLE} has the plant's own Q and R."
    )
