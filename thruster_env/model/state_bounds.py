"""Bounds on the states of a model, which its estimates keep."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import as_floats, short_repr
from thruster_env.core.sources import as_value
from thruster_env.model.quantities import Quantity


class Bound(NamedTuple):
    """The smallest and the largest value that a state, by its index, can have; infinite where there is none."""

    place: int
    low: float
    high: float


def checked_bounds(user_bounds: Any, states: Sequence[Quantity]) -> tuple[Bound, ...]:
    """Bounds in the order of the states, from a mapping of symbols or indices to pairs; None is no bound.

    Raises ValueError for another state, an angle, or a pair that is not increasing numbers.
    """
    if not isinstance(user_bounds, Mapping):  # those of another model
        user_bounds = {bound[0]: bound[1:] for bound in user_bounds}
    symbols, result = [state.symbol for state in states], []
    for name, pair in user_bounds.items():
        index = symbols.index(name) if name in symbols else name
        if not isinstance(index, int) or not 0 <= index < len(states) or states[index].angle:
            known = ", ".join(state.symbol for state in states if not state.angle)
            raise ValueError(f"bounds must be of states {known}, and not of angles, but got {short_repr(name)}")
        try:
            low, high = pair
            low, high = (-math.inf if low is None else float(low)), (math.inf if high is None else float(high))
        except (TypeError, ValueError):
            low = high = math.nan
        if not low < high or low == math.inf or high == -math.inf:
            rule = f"bounds of {symbols[index]} must be two increasing numbers, of which one may be None"
            raise ValueError(f"{rule}, but got {short_repr(pair)}")
        if low > -math.inf or high < math.inf:
            result.append(Bound(index, low, high))
    return tuple(sorted(result))


# Scales of a model's states, in which steps of central differences and regions about a mean are measured.


def scales_of(model) -> np.ndarray:
    """Scale of each state of a model, (n,): its standard deviation in prior and Q together.

    For a state without both, such as a position whose velocity is uncertain, it is how far states of known scale
    move it in a step; else how far it moves by itself, or its prior mean's magnitude, or 1. So results do not
    depend on units.
    """
    scales = np.sqrt(np.diag(model.prior_cov) + np.diag(model.process_noise_cov))
    if (scales > 0.0).all():
        return scales
    start = _propagated(model, model.prior_mean)
    shares = 0.75 + 0.25 * np.cos(np.arange(model.n))  # unequal, so that no two changes cancel
    for _ in range(model.n):
        reached = _sizes(_propagated(model, model.prior_mean + shares * scales) - start)
        if not ((scales == 0.0) & (reached > 0.0)).any():
            break
        scales = np.where(scales > 0.0, scales, reached)
    for other in (_sizes(start - model.prior_mean), abs(model.prior_mean), np.ones(model.n)):
        scales = np.where(scales > 0.0, scales, other)
    return scales


def _sizes(changes: np.ndarray) -> np.ndarray:
    """Magnitudes of finite changes, and 0 for others."""
    return np.where(np.isfinite(changes), abs(changes), 0.0)


def _propagated(model, x: np.ndarray) -> np.ndarray:
    """The state after x with inputs of zero, as Python has it; NaN where there is none."""
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")
            u = as_value([0.0] * model.inputs)
            propagated = as_floats(model.transition(as_value(x.tolist()), u, model.given_constants))
    except Exception:  # whatever a user's function raises; `model_check` says what is wrong
        return np.full(model.n, np.nan)
    return propagated if propagated.shape == x.shape else np.full(model.n, np.nan)
