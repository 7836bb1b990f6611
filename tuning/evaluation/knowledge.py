"""The noise and constants that filters of a comparison assume."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

OF_FILE = "tuned"
SAID = {
    "true": "the plant's own (oracle; {option} true)",
    "scaled": "the scaled default ({option} scaled)",
    "untuned": "the rule of thumb ({option} untuned)",
    "given": "those that the model came with ({option} given)",
    OF_FILE: "the tuned ones",
}
KNOWLEDGE = ("true", "scaled", "untuned", "given")  # of Q and R; see `SAID`


def noise_sentence(rows: Sequence[Any], option: str = "knows") -> str:
    """The source of the Q and R of the filters in a comparison; empty if not stated.

    Args:
        rows: with a label, and the source of the filter's Q and R.
        option: the user's name for the choice among these.
    """
    groups: dict[str, list[str]] = {}
    for row in rows:
        if row.knows:
            groups.setdefault(SAID[row.knows].format(option=option), []).append(row.label)
    if not groups:
        return ""
    if len(groups) == 1:
        return f"Q and R: {next(iter(groups))}."
    parts = [f"of {', '.join(labels)} {words}" for words, labels in groups.items()]
    return f"Q and R: {'; '.join(parts)}."


def belief_sentences(rows: Sequence[Any]) -> list[str]:
    """The prior of each constant that filters estimate, the same for all filters, a sentence per constant."""
    beliefs = {name: belief for row in rows for name, belief in row.beliefs.items()}
    return [
        f"{name} has a prior mean of {belief.mean:.4g}, a standard deviation of {belief.std:.3g} and a random "
        f"walk of {belief.walk_std:.3g} per step (standard deviation; all in its own unit)."
        for name, belief in beliefs.items()
    ]
