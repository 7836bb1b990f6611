"""What filters of a comparison know of the plant's noise, and believe of its constants: values and sentences."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from filters.augmented import Unknown
from numerics.checks import one_of, positive

OF_FILE = "tuned"
SAID = {
    "true": "the plant's own (oracle; {option} true)",
    "scaled": "the scaled default ({option} scaled)",
    "untuned": "the rule of thumb ({option} untuned)",
    OF_FILE: "the tuned ones",
}
KNOWLEDGE = ("true", "scaled", "untuned")  # of the plant's Q and R: oracle, scaled default, rule of thumb
# Default belief of a constant: standard deviation of a flow [m/s], of others as a fraction of their value ...
FLOW_STD, RELATIVE_STD, WALK_PART = 0.5, 0.2, 0.02  # ... and of a step's change, as a fraction of the prior's


def noise_sentence(rows: Sequence[Any], option: str = "knows") -> str:
    """Whose Q and R the filters of a comparison have; empty where nobody says.

    Args:
        rows: with a label, and what the filter knows.
        option: what the user calls the choice among them.
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
    """What is believed of each constant that filters estimate, the same of all filters, a sentence a constant."""
    beliefs = {name: belief for row in rows for name, belief in row.beliefs.items()}
    return [
        f"{name} is believed to be {belief.mean:.4g} at first, with a standard deviation of {belief.std:.3g}, and "
        f"to change by {belief.walk_std:.3g} a step (standard deviation; all in its own unit)."
        for name, belief in beliefs.items()
    ]


def beliefs_of(constants: Any, unknown: Mapping[str, Unknown | None]) -> dict[str | int, Unknown]:
    """What is believed of a model's constants, the defaults and the means filled in.

    Raises:
        ValueError: for what is not one of the constants, or has no default.
    """
    beliefs: dict[str | int, Unknown] = {}
    for name, belief in unknown.items():
        one_of("a constant to estimate", name, getattr(constants, "_fields", ()))
        value = getattr(constants, name)
        given = default_belief(name, value) if belief is None else Unknown(*belief)
        beliefs[name] = given if given.mean is not None else given._replace(mean=value)
    return beliefs


def default_belief(name: str, value: float) -> Unknown:
    """The default belief of a constant of the model.

    Its prior has a standard deviation of 0.5 m/s for the ambient flow, and of a fifth of its value otherwise; a
    step changes it by 2 % of that.

    Raises:
        ValueError: if the constant is zero, because its spread is a fraction of its value.
    """
    std = FLOW_STD if name == "ambient_velocity" else RELATIVE_STD * abs(value)
    positive(f"the assumed {name}, of which a part is its spread,", std)
    return Unknown(std=std, walk_std=WALK_PART * std)
