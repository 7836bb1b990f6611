"""What a proof says in words: the gain over each baseline, and what the scaled default is."""

from __future__ import annotations

from math import isnan

from filters.consistency.intervals import Interval
from tuning.evaluation.baselines import ORACLE, RULE, SCALED
from tuning.evaluation.held_out import Comparison


def without_truth(name: str) -> str:
    """What is compared where a problem, called `name`, has no truth."""
    return (
        f"{name} has no truth: filters are compared by how well they predict the measurements, the log-likelihood "
        "and the NIS of their innovations."
    )


def worth(proof: Comparison, what: str = "the score") -> str:
    """What tuning does to `what`: against the scaled default, if there is one, and the rule of thumb.

    Without truth it is what it does to the log-likelihood of a run's innovations.
    """
    if not proof.tuned.has_truth:
        return _likelihood_worth(proof)
    ratios, seeds = proof.ratios, len(proof.seeds)
    names = [name for name in (SCALED, RULE) if name in ratios]
    first, *others = (f"{gain(ratios[name], seeds, what)} against the {name}" for name in names)
    shared = first.partition(" against " if "no difference" in first else " by ")[0]
    return " and ".join([first, *(other.removeprefix(f"{shared} ") for other in others)])


def _likelihood_worth(proof: Comparison) -> str:
    gains = {name: gained for name, gained in proof.likelihood_gains.items() if name in (SCALED, RULE)}
    parts = [
        f"by {gained.value:+.2f} [{gained.low:+.2f}, {gained.high:+.2f}] against the {name}"
        for name, gained in gains.items()
        if not isnan(gained.value)
    ]
    changed = "changes the log-likelihood of a run"
    return f"{changed} {' and '.join(parts)}" if parts else "makes no difference that can be told without truth"


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
    oracle = f"; the {ORACLE} has the plant's own Q and R" if proof.true is not None else ""
    return (
        f"The {SCALED} is the {RULE} with its Q times {found.factor:.4g}, which brings the mean NIS on the "
        f"training runs to {found.nis * proof.tuned.expected_nis:.2f}{oracle}."
    )
