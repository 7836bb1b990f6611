"""What filters of a comparison know about the plant's noise and assume about its constants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from filters.augmented import Unknown
from thruster_env.numerics.checks import one_of, positive

OF_FILE = "tuned"
SAID = {
    "true": "the plant's own (oracle; {option} true)",
    "scaled": "the scaled default ({option} scaled)",
    "untuned": "the rule of thumb ({option} untuned)",
    "given": "those that the model came with ({option} given)",
    OF_FILE: "the tuned ones",
}
KNOWLEDGE = ("true", "scaled", "untuned", "given")  # of Q and R; see `SAID`
# Default belief of a constant: standard deviation of a flow [m/s], of others as a fraction of their value ...
FLOW_STD, RELATIVE_STD, WALK_PART = 0.5, 0.2, 0.02  # ... and of a step's change, as a fraction of the prior's


def noise_sentence(rows: Sequence[Any], option: str = "knows") -> str:
    """The source of the Q and R of the filters in a comparison; empty if not stated.

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
    """The prior of each constant that filters estimate, the same for all filters, a sentence per constant."""
    beliefs = {name: belief for row in rows for name, belief in row.beliefs.items()}
    return [
        f"{name} has a prior mean of {belief.mean:.4g}, a standard deviation of {belief.std:.3g} and a random "
        f"walk of {belief.walk_std:.3g} per step (standard deviation; all in its own unit)."
        for name, belief in beliefs.items()
    ]


def beliefs_of(constants: Any, unknown: Mapping[str, Unknown | None]) -> dict[str | int, Unknown]:
    """The priors of a model's constants, with defaults and means filled in.

    Raises:
        ValueError: for a name that is not a constant, or a constant without a default.
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
