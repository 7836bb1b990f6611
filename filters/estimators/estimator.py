"""The interface of an estimator: it maps inputs and measurements to means, and to covariances if it has them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple


class Output(NamedTuple):
    """The output of an estimator after a measurement."""

    mean: Any  # of the state, (n,)
    cov: Any = None  # (n, n) or n variances; None of an estimator that has none
    innovation: Any = None  # (m,), measurement less what was foreseen; None of one that does not tell
    innovation_cov: Any = None  # S, (m, m) or m variances


class Estimator:
    """An estimator of one trajectory at a time; it keeps its own state, and its random draws follow from the key.

    Each run begins with a deep copy of it. Generators of Python and NumPy that it holds are seeded by the key, and
    so are the global ones, with that of torch.

    A subclass defines `reset` and `step`; any other object with both is accepted too, and the rest defaults to
    what is here. Each may return an `Output`, a tuple of the first of its parts, such as (mean, cov), or an array,
    which is a mean alone. A method `run(keys, inputs, measurements)`, of keys (B, 2), inputs (B, K, p) and
    measurements (B, K + 1, m), may take the place of both in evaluations: it returns the same for all trajectories
    and steps, means (B, K + 1, n), covariances (B, K + 1, n, n) and so on.

    Attributes:
        name: for tables; the name under which it is found if None.
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


def steps_alone(found) -> bool:
    """Whether something estimates one trajectory step by step."""
    return not isinstance(found, type) and all(callable(getattr(found, name, None)) for name in ("reset", "step"))


def is_estimator(found) -> bool:
    """Whether something is an estimator, of one trajectory or of many at once, rather than what makes one."""
    return steps_alone(found) or (not isinstance(found, type) and callable(getattr(found, "run", None)))
