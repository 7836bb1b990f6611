"""Checks of what filters are given: beliefs, keys, inputs and measurements."""

from __future__ import annotations

import numpy as np

from filters.engine.belief import Belief, LostBelief
from numerics.checks import as_floats, at_least, covariance, shown

ROUNDING = 1e-9  # of a covariance's largest variance: what filters leave of a negative one is below that


def vector_like(name: str, value, like: np.ndarray, *, missing_allowed: bool) -> np.ndarray:
    """Return value as float64 of the shape of `like`; raise ValueError for a wrong shape or infinite entries."""
    try:
        array = np.atleast_1d(as_floats(value))
    except ValueError:
        array = np.full(like.size + 1, np.nan)
    wrong = np.isinf(array) if missing_allowed else ~np.isfinite(array)
    if array.shape != like.shape or wrong.any():
        rule = "finite or NaN" if missing_allowed else "finite"
        count = f"{like.size} number{'' if like.size == 1 else 's'}"
        raise ValueError(f"{name} must be {count}, each {rule}, but got {shown(value)}")
    return array


def checked_key(key) -> tuple[int, int]:
    """Return a key as two integers; raise ValueError unless they are whole numbers below 2^32."""
    try:
        words = [int(word) for word in as_floats(key)] if np.shape(key) == (2,) else []
        if len(words) == 2 and words == list(key) and min(words) >= 0 and max(words) < 2**32:
            return words[0], words[1]
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"key must be two whole numbers from 0 to 2^32 - 1, but got {shown(key)}")


def checked_actions(actions, count: int, size: int, ignored=False) -> np.ndarray:
    """Return the actions of `count` envs as (count, size); raise ValueError unless they are numbers, none NaN.

    What is in the rows where `ignored` (count,) is true does not matter.
    """
    try:
        array = as_floats(actions)
    except ValueError:
        array = np.empty(0)
    whose = f"the {count} actions" if count > 1 else "an action"
    numbers = f"{size} number{'' if size == 1 else 's'}"
    if array.size != count * size:
        raise ValueError(f"{whose} must be {numbers}{' each' * (count > 1)}, but got {shown(actions)}")
    array = array.reshape(count, size)
    if (np.isnan(array).any(axis=1) & ~np.asarray(ignored)).any():
        raise ValueError(f"{whose} must be {numbers} and not NaN, but got {shown(actions)}")
    return array


def check_belief(belief: Belief) -> None:
    """Raise ValueError unless a belief's numbers are finite and its covariance is one.

    A `LostBelief`, which says of itself that it is not finite, is let through.
    """
    at_least("step of a belief", belief.step, 0)
    at_least("divergences of a belief", belief.divergences, 0)
    if isinstance(belief, LostBelief):
        return
    # Particle filters keep log weights behind the members of their states; those, and extras, may be infinite.
    finite = {"mean": belief.mean, "members": belief.members[: len(belief.mean)]}
    for name, values in finite.items():
        if not np.isfinite(as_floats(values)).all():
            raise ValueError(f"{name} of a belief must be finite, but got {shown(values)}")
    for name in ("members", "extras"):
        if np.isnan(as_floats(getattr(belief, name))).any():
            raise ValueError(f"{name} of a belief must not be NaN, but got {shown(getattr(belief, name))}")
    covariance("cov of a belief", belief.cov, len(belief.mean), rounding=ROUNDING)
