"""What controls an ensemble's spread: rules of the parameters, and the prior of factors that adapt."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from thruster_env.core.checks import positive, short_repr, switch


def checked(filter_: Any) -> dict[str, float]:
    """The parameters of a filter as numbers; raise ValueError that states the rule and the value."""
    inflation, relaxation = filter_.inflation, positive("relaxation", filter_.relaxation, zero_allowed=True)
    if relaxation > 1.0:
        raise ValueError(f"relaxation must be at most 1, but got {short_repr(filter_.relaxation)}")
    first = positive("adaptive_inflation", filter_.adaptive_inflation, zero_allowed=True)
    if switch("inflation_by_state", filter_.inflation_by_state) and not first:
        raise ValueError("adaptive_inflation of a filter with inflation_by_state must be positive, but got 0")
    least = positive("least_deviation", filter_.least_deviation, zero_allowed=True)
    if least > first:
        rule = f"least_deviation must be at most adaptive_inflation, {first:g}"
        raise ValueError(f"{rule}, but got {short_repr(filter_.least_deviation)}")
    known = {"adaptive_inflation": first, "least_deviation": least}
    return {"inflation": positive("inflation", inflation), "relaxation": relaxation, **known}


def limits(first: float, least: float) -> Mapping[str, float]:
    """What pages read: the deviation of a factor, or the widest and narrowest width; nothing without a factor."""
    if not first:
        return {}
    return {"widest": width_of(first), "narrowest": width_of(least)} if least else {"deviation": first}


def width_of(deviation: float) -> float:
    """The width p of an inverse gamma density, below 1/3, with a standard deviation over its mode."""

    def excess(root):
        p = root * root
        return root - deviation * (1.0 - 2.0 * p) * max(1.0 - 3.0 * p, 0.0) ** 0.5

    from scipy.optimize import brentq  # loads half of SciPy, for this line

    return brentq(excess, 0.0, 3.0**-0.5, xtol=1e-300) ** 2  # of the root, so that small ones are exact, too
