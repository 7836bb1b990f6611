"""The interface of an estimator, which maps inputs and measurements to means and covariances, and its checks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.checks import as_floats, correlation_flaws, short_repr

PARTS = {"mean": "n", "cov": "nn", "innovation": "m", "innovation_cov": "mm"}
NAMES = {
    "mean": "mean",
    "cov": "covariance",
    "innovation": "innovation",
    "innovation_cov": "covariance of the innovation",
}
ROUNDING = 1e-4  # of correlations: single precision leaves less


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


class Checks:
    """Checks of an estimator's outputs, with messages that name it.

    Args:
        name: of the estimator.
        n: states.
        m: measurements.
        has_covariance: whether it has to give covariances.
    """

    def __init__(self, name: str, n: int, m: int, has_covariance: bool):
        self.name, self._sizes, self._has_covariance = name, {"n": (n,), "m": (m,)}, has_covariance

    def output(self, returned, where: str, leading: tuple[int, ...] = ()) -> Output:
        """The parts of an output as float64 arrays of shape (*leading, ...); ValueError if one is wrong.

        Args:
            returned: output of the estimator.
            where: for messages, such as "step 3".
            leading: shape of all before the states: () of one step, (B, K + 1) of many runs.
        """
        parts = returned if isinstance(returned, tuple) else (returned,)
        if not 1 <= len(parts) <= len(PARTS):
            rule = f"{self._label} must give a mean, or a tuple of mean, covariance, innovation and its covariance"
            raise ValueError(f"{rule}, but gave a tuple of {len(parts)} at {where}")
        output = Output(*parts)
        if self._has_covariance and output.cov is None:
            rule = f"{self._label} must give a covariance, or say has_covariance = False"
            raise ValueError(f"{rule}, but gave none at {where}")
        checked = {
            name: None if value is None and name != "mean" else self._part(name, value, where, leading)
            for name, value in output._asdict().items()
        }
        return Output(**checked)

    @property
    def _label(self) -> str:
        return f"the estimator {self.name!r}"

    def _part(self, name: str, value, where: str, leading: tuple[int, ...]) -> np.ndarray:
        size = self._sizes[PARTS[name][0]]
        is_cov = len(PARTS[name]) == 2
        shape = (*leading, *size, *size) if is_cov else (*leading, *size)
        try:
            array = np.atleast_1d(as_floats(value))
        except ValueError:
            array = np.empty(0)
        if is_cov and array.shape == (*leading, *size) != shape:
            array = array[..., None] * np.eye(*size)
        if array.shape != shape:
            got = f"shape {array.shape}" if array.size else short_repr(value)
            rule = f"{NAMES[name]} of {self._label} must be numbers of shape {shape}"
            raise ValueError(f"{rule}, but got {got} at {where}")
        if not np.isfinite(array).all():
            location = _first(~np.isfinite(array), leading)
            rule = f"{NAMES[name]} of {self._label} must be finite"
            raise ValueError(f"{rule}, but it is not at {location or where}")
        return self._covariance(name, array, where, leading) if is_cov else array

    def _covariance(self, name: str, covs: np.ndarray, where: str, leading: tuple[int, ...]) -> np.ndarray:
        least, asymmetry = correlation_flaws(covs)
        wrong = (least < -ROUNDING) | (asymmetry > ROUNDING)
        covs = 0.5 * (covs + covs.swapaxes(-1, -2))
        if wrong.any():
            location = _first(wrong, leading)
            rule = f"{NAMES[name]} of {self._label} must be symmetric and positive semidefinite"
            raise ValueError(f"{rule}, but it is not at {location or where}")
        return covs


def absent(is_cov: bool) -> float:
    """The substitute for a missing output of an estimator: 0 for a covariance, NaN for innovations."""
    return 0.0 if is_cov else np.nan


def _first(wrong: np.ndarray, leading: tuple[int, ...]) -> str:
    """Where the first wrong entry of many runs is; empty of a single step."""
    if not leading:
        return ""
    run, step, *_ = np.argwhere(wrong)[0]
    return f"step {step} of run {run}"


def log_likelihoods(
    innovations: np.ndarray, covs: np.ndarray, measurements: np.ndarray, gaussian: bool
) -> np.ndarray:
    """Log-likelihood of measurements, log N(innovation; 0, S) over the channels present, (B, K + 1).

    It is 0 where nothing was measured. It is NaN where an innovation or S is missing, where S is not positive
    definite, and if the likelihood is not Gaussian.

    Args:
        innovations: (B, K + 1, m); those of missing channels do not matter.
        covs: S, (B, K + 1, m, m), likewise.
        measurements: (B, K + 1, m), NaN where missing.
        gaussian: whether the likelihood is Gaussian.
    """
    present = ~np.isnan(measurements)
    if not gaussian:
        return np.where(present.any(axis=-1), np.nan, 0.0)
    pairs = present[..., :, None] & present[..., None, :]
    s = np.where(pairs, covs, np.eye(covs.shape[-1]))
    v = np.where(present, innovations, 0.0)
    complete = np.asarray(np.isfinite(s).all(axis=(-1, -2)) & np.isfinite(v).all(axis=-1))
    s = np.where(complete[..., None, None], s, np.eye(covs.shape[-1]))
    definite = (np.linalg.eigvalsh(s)[..., 0] > 0.0) & complete
    s = np.where(definite[..., None, None], s, np.eye(covs.shape[-1]))
    squares = (v * np.linalg.solve(s, v[..., None])[..., 0]).sum(axis=-1)
    densities = -0.5 * (squares + np.linalg.slogdet(s).logabsdet + present.sum(axis=-1) * math.log(2.0 * math.pi))
    return np.where(present.any(axis=-1), np.where(definite, densities, np.nan), 0.0)


def without_missing(output: Output, z: np.ndarray) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Innovation and S as filters have them where channels of z are NaN: zero, and no correlations to these."""
    innovation, s = output.innovation, output.innovation_cov
    present = ~np.isnan(z)
    if present.all():
        return innovation, s
    if innovation is not None:
        innovation = np.where(present, innovation, 0.0)
    if s is not None:
        pairs = present[..., :, None] & present[..., None, :]
        s = np.where(pairs | np.eye(s.shape[-1], dtype=bool), s, 0.0)
    return innovation, s
