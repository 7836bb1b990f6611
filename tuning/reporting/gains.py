"""The gain of tuning, in sentences."""

from __future__ import annotations

from math import isnan

from filters.consistency.intervals import Interval, slightly, span
from tuning.evaluation.baselines import TUNED, called
from tuning.evaluation.held_out import Comparison
from tuning.evaluation.worth import LARGEST_RATIO, scaling_sentence, sized, times, without_truth

GIVEN_IS_ORACLE = (
    "The given Q and R are the plant's own, as the oracle's are; no trial of a study starts from them."
)


def gains(comparison: Comparison, seed_word: str, name: str = TUNED) -> list[str]:
    """The gain of tuning over each baseline, the main one first, and a description of that one."""
    if not comparison.tuned.has_truth:
        return _likelihood_gains(comparison, seed_word, name)
    ratios = comparison.ratios
    parts = [f"{span(ratio, 3)} times that of the {called(name)}" for name, ratio in ratios.items()]
    first, place = next(iter(ratios)), f"{len(comparison.seeds)} held-out {seed_word}"
    said = f"Score of the {_filter(name)} on {place}: {', '.join(parts)} (paired 95 % intervals)."
    scaling = scaling_sentence(comparison)
    if name == TUNED:
        said += f" {_verdict(ratios[first], called(first), seed_word)}"
    same = [GIVEN_IS_ORACLE] if comparison.given_is_oracle else []
    return [said, *([scaling] if scaling else []), *same]


def _filter(name: str) -> str:
    """The filter that is compared, after "the"."""
    return f"{name} filter" if name == TUNED else name


def _likelihood_gains(comparison: Comparison, seed_word: str, name: str) -> list[str]:
    """The gain of tuning without truth: the increase of the log-likelihood of a run."""
    gained = {name: found for name, found in comparison.likelihood_gains.items() if not isnan(found.value)}
    said, scaling = [without_truth("This problem")], scaling_sentence(comparison)
    if gained:
        parts = [
            f"{span(sized(found), 2)} {'above' if found.value >= 0 else 'below'} that of the {called(name)}"
            for name, found in gained.items()
        ]
        place = f"{len(comparison.seeds)} held-out {seed_word}"
        said.append(f"Log-likelihood of a run of the {_filter(name)} on {place}: {', '.join(parts)}.")
    return [*said, *([scaling] if scaling else [])]


def _verdict(ratio: Interval, name: str, seed_word: str) -> str:
    if slight := slightly(ratio):
        changed = "lower" if ratio.high < 1 else "higher"
        return f"Practically equal to the {name}: the error is {changed} by {slight}."
    if ratio.high < 1:
        much = times(ratio) if ratio.value < 1.0 / LARGEST_RATIO else f"by {100 * (1 - ratio.value):.0f} %"
        return f"Tuning lowers the error {much} against the {called(name)}."
    if ratio.low > 1:
        return f"Tuning makes the filter worse than the {name}."
    return f"No significant difference from the {name} on these {seed_word}."
