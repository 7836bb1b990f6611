"""Rules of a fuzzy filter: a model's affine approximations at the corners of a range of its states."""

from __future__ import annotations

from typing import Any

import numpy as np

from filters.algebra.matrices import operation
from filters.baselines.baselines import place_of
from thruster_env.core.checks import short_repr, vector
from thruster_env.graphs.graphs import where
from thruster_env.model.affine import AffineModel, linearize
from thruster_env.model.state_space import StateSpaceModel

MOST_STATES = 8  # that rules ask for: 256 rules


@operation(lambda x, low, high, premises: (2 ** len(premises),))
def memberships(x, low, high, premises):
    """Of a state in all rules: products of how low or high it is in each premise, as the bits of the rule say."""
    w = np.ones(1)
    for i in premises:
        part = (x[i] - low[i]) / (high[i] - low[i])
        of_high = where(part < 0.0, 0.0, where(part > 1.0, 1.0, part))
        w = np.concatenate([w * (1.0 - of_high), w * of_high])
    return w


def rules_at_corners(
    model: StateSpaceModel, low: np.ndarray, high: np.ndarray, premises: tuple[int, ...], offsets: bool
) -> tuple[AffineModel, ...]:
    """The affine model of each rule, whose bits say where it is linearised: low, or high, in each premise."""
    control = np.zeros(model.inputs) if model.operating_input is None else model.operating_input
    rules, before = [], model.n * (model.n + model.inputs)
    for rule in range(2 ** len(premises)):
        corner = (low + high) / 2
        for bit, i in enumerate(premises):
            corner[i] = (high if rule >> bit & 1 else low)[i]
        found = linearize(model, corner, control)
        c = found.constants  # of which the state's offset may be left out
        without = c[:before] + (0.0,) * model.n + c[before + model.n :]
        rules.append(found if offsets else found.replace(constants=without))
    return tuple(rules)


def checked_corners(model: StateSpaceModel, low: Any, high: Any, premises: Any) -> dict[str, Any]:
    """The range of the states and the places of those that rules ask for; ValueError if there are none."""
    places = _checked_premises(model, premises)
    low, high = model.state_low if low is None else low, model.state_high if high is None else high
    if isinstance(model, AffineModel):  # its rules are all alike, whatever the range
        low = model.prior_mean - model.scales if low is None else low
        high = model.prior_mean + model.scales if high is None else high
    if low is None or high is None:
        raise ValueError(
            "a fuzzy filter must know the range of the states, but got neither low and high nor "
            "a model with state_low and state_high"
        )
    low, high = vector("low", low, model.n), vector("high", high, model.n)
    if not (low < high).all():
        raise ValueError(
            f"low must be below high in every state, but got {short_repr(low)} and {short_repr(high)}"
        )
    return {"premises": places, "low": low, "high": high}


def _checked_premises(model: StateSpaceModel, given: Any) -> tuple[int, ...]:
    """Places of the states that rules ask for, all if None."""
    n, told = model.n, f"all {model.n} states" if given is None else short_repr(given)
    if given is None:
        given = (0,) if n > MOST_STATES and isinstance(model, AffineModel) else range(n)  # all rules are alike
    try:
        places = tuple(place_of("premises", place, n) for place in given)
    except TypeError:
        places = ()
    if not 1 <= len(places) <= MOST_STATES or len(set(places)) < len(places):
        rule = f"premises must name 1 to {MOST_STATES} different states, for there is a rule for each corner"
        raise ValueError(f"{rule} of their range, but got {told}")
    return places
