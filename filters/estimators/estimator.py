"""The interface of an estimator: it maps inputs and measurements to means, and to covariances if it has them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple


class Output(NamedTuple):
    """The output of an estimator after a measurement."""

    mean: Any  # of the state, (n,)
    cov: Any = None  # (n, n) or n variances; None of an estimator that has none
    innovation: Any = None  # (m,), measurement less its prediction; None of an estimator without one
    innovation_cov: Any = None  # S, (m, m) or m variances


class Estimator:
    """An estimator of one trajectory at a time; it keeps its own state, and its random draws follow from the key.

    Each run begins with a deep copy of it. The key seeds the generators of Python and NumPy that it holds, and the
    global ones, also torch's.

    A subclass defines `reset` and `step`; any other object with both is accepted too, and gets the defaults below
    for the rest. Each may return an `Output`, a tuple of its first parts, such as (mean, cov), or an array, which
    is the mean. In evaluations, a method `run(keys, inputs, measurements)` may replace both: with keys (B, 2),
    inputs (B, K, p) and measurements (B, K + 1, m) it returns the same parts for all trajectories and steps, means
    (B, K + 1, n), covariances (B, K + 1, n, n) and so on.

    Attributes:
        name: for tables; if None, the name by which the user refers to it.
        has_covariance: whether it gives covariances; NEES is left out where it does not.
        gaussian_likelihood: whether the likelihood of a measurement is N(innovation; 0, S); it is left out if not.
        parameters: its tunable parameters: `Parameter`s, each an argument of the function that makes it.
    """

    name: str | None = None
    has_covariance: bool = True
    gaussian_likelihood: bool = True
    parameters: Sequence = ()

    def check_model(self, model: Any) -> None:
        """Raise ValueError if the estimator cannot handle a property of a model, such as an angle."""

    def reset(self, key: tuple[int, int], z) -> Output | tuple | Any:
        """Begin a trajectory: the estimate at its first measurement z (m,), NaN where missing.

        The key is two whole numbers below 2^32: with the same one an estimator draws the same.
        """
        raise NotImplementedError(f"{type(self).__name__} has no reset")

    def step(self, u, z) -> Output | tuple | Any:
        """The estimate one step later, after input u (p,) and measurement z (m,), NaN where missing."""
        raise NotImplementedError(f"{type(self).__name__} has no step")


def steps_alone(candidate) -> bool:
    """Whether something estimates one trajectory step by step."""
    return not isinstance(candidate, type) and all(
        callable(getattr(candidate, name, None)) for name in ("reset", "step")
    )


def is_estimator(candidate) -> bool:
    """Whether something is an estimator, of one trajectory or of many at once, and not a factory of estimators."""
    return steps_alone(candidate) or (
        not isinstance(candidate, type) and callable(getattr(candidate, "run", None))
    )
