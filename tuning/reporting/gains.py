"""What tuning is worth, in sentences."""

from __future__ import annotations

from math import isnan

from filters.consistency.intervals import Interval, slightly
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.worth import scaling_sentence, sized, without_truth
from tuning.reporting.error_tables import span


def gains(proof: Comparison, seed_word: str) -> list[str]:
    """What tuning is worth, over each baseline, the one that counts first, and what that one is."""
    if not proof.tuned.has_truth:
        return _likelihood_gains(proof, seed_word)
    ratios = proof.ratios
    parts = [f"x {span(ratio, 3)} that of the {proof.label(name)}" for name, ratio in ratios.items()]
    first, place = next(iter(ratios)), f"{len(proof.seeds)} held-out {seed_word}"
    said = f"Score of the tuned filter on {place}: {', '.join(parts)} (paired 95 % intervals)."
    scaling = scaling_sentence(proof)
    return [f"{said} {_verdict(ratios[first], proof.label(first), seed_word)}", *([scaling] if scaling else [])]


def _likelihood_gains(proof: Comparison, seed_word: str) -> list[str]:
    """What tuning is worth where there is no truth: by how much the log-likelihood of a run rises."""
    gained = {name: found for name, found in proof.likelihood_gains.items() if not isnan(found.value)}
    said, scaling = [without_truth("This problem")], scaling_sentence(proof)
    if gained:
        parts = [
            f"{span(sized(found), 2)} {'above' if found.value >= 0 else 'below'} that of the {proof.label(name)}"
            for name, found in gained.items()
        ]
        place = f"{len(proof.seeds)} held-out {seed_word}"
        said.append(f"Log-likelihood of a run of the tuned filter on {place}: {', '.join(parts)}.")
    return [*said, *([scaling] if scaling else [])]


def _verdict(ratio: Interval, name: str, seed_word: str) -> str:
    if slight := slightly(ratio):
        changed = "lower" if ratio.high < 1 else "higher"
        return f"Practically equal to the {name}: the error is {changed} by {slight}."
    if ratio.high < 1:
        return f"Tuning lowers the error by {100 * (1 - ratio.value):.0f} % against the {name}."
    if ratio.low > 1:
        return f"Tuning makes it worse than the {name}."
    return f"No difference from the {name} that these {seed_word} can show."
