"""Checks of the arguments of filters: beliefs, keys, inputs and measurements."""

from __future__ import annotations

from math import inf, isfinite, sqrt

import numpy as np

from filters.engine.belief import Belief, LostBelief
from thruster_env.core.checks import ROUNDING, as_floats, at_least, covariance, short_repr

FEW = 4  # states, up to which a belief is looked at in Python


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
        raise ValueError(f"{name} must be {count}, each {rule}, but got {short_repr(value)}")
    return array


def checked_key(key) -> tuple[int, int]:
    """Return a key as two integers; raise ValueError unless they are whole numbers below 2^32."""
    if type(key) is tuple and len(key) == 2 and all(type(word) is int and 0 <= word < 2**32 for word in key):
        return key
    try:
        words = [int(word) for word in as_floats(key)] if np.shape(key) == (2,) else []
        if len(words) == 2 and words == list(key) and min(words) >= 0 and max(words) < 2**32:
            return words[0], words[1]
    except (TypeError, ValueError, OverflowError):
        pass
    raise ValueError(f"key must be two whole numbers from 0 to 2^32 - 1, but got {short_repr(key)}")


def checked_actions(actions, count: int, size: int, ignored=False) -> np.ndarray:
    """Return the actions of `count` envs as (count, size); raise ValueError unless they are numbers, none NaN.

    Rows where `ignored` (count,) is true are not checked.
    """
    try:
        array = as_floats(actions)
    except ValueError:
        array = np.empty(0)
    whose = f"the {count} actions" if count > 1 else "an action"
    numbers = f"{size} number{'' if size == 1 else 's'}"
    if array.size != count * size:
        raise ValueError(f"{whose} must be {numbers}{' each' * (count > 1)}, but got {short_repr(actions)}")
    array = array.reshape(count, size)
    if (np.isnan(array).any(axis=1) & ~np.asarray(ignored)).any():
        raise ValueError(f"{whose} must be {numbers} and not NaN, but got {short_repr(actions)}")
    return array


def check_belief(belief: Belief, prior_variances: np.ndarray) -> None:
    """Raise ValueError unless a belief's numbers are finite and its covariance is one, within rounding.

    What filters leave of a covariance that is impossible is a part of its variances, or of the prior's (n,), which
    they began with. A `LostBelief`, which declares that it is not finite, is accepted.
    """
    if _is_surely_one(belief, prior_variances):
        return
    at_least("step of a belief", belief.step, 0)
    at_least("divergences of a belief", belief.divergences, 0)
    if isinstance(belief, LostBelief):
        return
    # Particle filters keep log weights behind the members of their states; those, and extras, may be infinite.
    finite = {"mean": belief.mean, "members": belief.members[: len(belief.mean)]}
    for name, values in finite.items():
        if not np.isfinite(as_floats(values)).all():
            raise ValueError(f"{name} of a belief must be finite, but got {short_repr(values)}")
    for name in ("members", "extras"):
        if np.isnan(as_floats(getattr(belief, name))).any():
            raise ValueError(f"{name} of a belief must not be NaN, but got {short_repr(getattr(belief, name))}")
    covariance("cov of a belief", belief.cov, len(belief.mean), variances=prior_variances)


def _is_surely_one(belief: Belief, prior_variances: np.ndarray) -> bool:
    """Whether a belief passes all checks, by a quick look; if not, the thorough one says what is amiss.

    P + r V = L L' with L real, where V has the variances or the prior's, and r is the tolerance: so no eigenvalue
    of V^(-1/2) P V^(-1/2) is below -r.
    """
    mean, cov, members, extras = belief.mean, belief.cov, belief.members, belief.extras
    if not all(type(one) is np.ndarray and one.dtype == np.float64 for one in (mean, cov, members, extras)):
        return False
    if type(belief.step) is not int or type(belief.divergences) is not int or min(belief[4:6]) < 0:
        return False
    n = len(mean)
    if members.size:
        if not np.abs(members[:n]).sum() < np.inf or np.isnan(members[n:]).any():
            return False
    if extras.size and np.isnan(extras).any():
        return False
    if n > FEW:
        return _many(mean, cov, prior_variances)
    return _few(mean.tolist(), cov.tolist(), prior_variances.tolist())


def _few(mean: list[float], cov: list[list[float]], prior_variances: list[float]) -> bool:
    """`_many` for a few states, for which NumPy's calls take longer than their arithmetic."""
    if not isfinite(sum(mean)):
        return False
    root: list[list[float]] = []
    for i, row in enumerate(cov):
        new: list[float] = []
        for j in range(i):
            if row[j] != cov[j][i]:
                return False
            rest = row[j]
            for k in range(j):
                rest -= new[k] * root[j][k]
            new.append(rest / root[j][j])
        pivot = row[i] + ROUNDING * max(row[i], prior_variances[i])
        if pivot == 0.0 and not any(row):  # of what is known exactly
            pivot = 1.0
        for one in new:
            pivot -= one * one
        if not (row[i] >= 0.0 and 0.0 < pivot < inf):
            return False
        new.append(sqrt(pivot))
        root.append(new)
    return True


def _many(mean: np.ndarray, cov: np.ndarray, prior_variances: np.ndarray) -> bool:
    """Whether a mean is finite and a covariance symmetric and positive semidefinite, by its Cholesky factor."""
    variances = cov.diagonal()
    if not np.abs(mean).sum() + np.abs(cov).sum() < np.inf or not (cov == cov.T).all() or variances.min() < 0:
        return False
    shifted, known = cov.copy(), ~cov.any(axis=1)  # what is known exactly has a variance of 0 and no covariance
    shifted.ravel()[:: len(mean) + 1] += np.where(known, 1.0, ROUNDING * np.maximum(variances, prior_variances))
    try:
        np.linalg.cholesky(shifted)
    except np.linalg.LinAlgError:
        return False
    return True
