"""`ForeignFilter`: an estimator of another package in the place of a filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from filters.engine.belief import Belief, Innovation, Kernels
from filters.estimators.checked import Checks, log_likelihoods, without_missing
from filters.estimators.estimator import Output, is_estimator
from filters.estimators.session import EstimatorSession
from filters.filter import Filter
from numerics.checks import shown
from numerics.modules import said


@dataclass(frozen=True, kw_only=True, eq=False)
class ForeignFilter(Filter):
    """An estimator with the model that names its states, inputs and measurements, in the place of a `Filter`.

    It runs over batches and beside envs. It has no kernels: single calls of `predict` and `update`, smoothers and
    gradients need a filter of this package.

    Attributes:
        model: names, sizes and angles; the estimator need not assume this model.
        estimator: an `Estimator`, or any object like one.
        label: its name in tables if it does not name itself.

    Raises:
        ValueError: if it is no estimator.
    """

    name: ClassVar[str] = "estimator"  # of the class; each has its own
    varying_noise: ClassVar[bool] = False
    estimator: Any
    label: str = ""

    def __post_init__(self):
        """Take from the estimator what it says of itself."""
        found = self.estimator
        if not is_estimator(found):
            raise ValueError(
                f"an estimator must have reset(key, z) and step(u, z), or run(keys, inputs, measurements), "
                f"but got {shown(found)}"
            )
        own = getattr(found, "name", None)
        name = own if isinstance(own, str) and own else self.label or type(found).__name__
        object.__setattr__(self, "name", name)
        for fact in ("has_covariance", "gaussian_likelihood"):
            object.__setattr__(self, fact, bool(getattr(found, fact, True)))

    def kernels(self) -> Kernels:
        """Raise ValueError: what somebody else's estimator computes cannot be compiled."""
        raise self._no_filter()

    def init(self, key: tuple[int, int] = (0, 0)) -> Belief:
        """Raise ValueError, as `predict` and `update`: an estimator keeps its belief to itself."""
        raise self._no_filter()

    def predict(self, belief: Belief, u, *, process_noise_cov=None) -> Belief:
        """Raise ValueError; see `init`."""
        raise self._no_filter()

    def update(self, belief: Belief, z, *, measurement_noise_cov=None) -> tuple[Belief, Innovation]:
        """Raise ValueError; see `init`."""
        raise self._no_filter()

    def _no_filter(self) -> ValueError:
        return ValueError(f"this needs a filter of filters.FILTERS, but got the estimator {self.name!r}")

    def session(self) -> EstimatorSession:
        """The estimator at work on one trajectory."""
        return EstimatorSession(self)

    def fill(self, keys: np.ndarray, inputs: np.ndarray, measurements: np.ndarray, out: tuple) -> None:
        """Put the estimates of a batch into arrays `out`, as `filters.engine.batch.run` has them.

        Raises:
            ValueError: with the step, if the estimator raises, or gives wrong shapes, NaN, or no covariance.
        """
        means, covs, innovations, innovation_covs, likelihoods, divergences = out
        divergences[:] = 0.0
        fill = self._at_once if callable(getattr(self.estimator, "run", None)) else self._one_by_one
        fill(keys, inputs, measurements, (means, covs, innovations, innovation_covs))
        likelihoods[:] = log_likelihoods(innovations, innovation_covs, measurements, self.gaussian_likelihood)

    def _at_once(self, keys: np.ndarray, inputs: np.ndarray, z: np.ndarray, out: tuple) -> None:
        try:
            returned = self.estimator.run(keys.astype(np.int64), inputs.copy(), z.copy())
        except Exception as error:
            raise ValueError(
                f"the estimator {self.name!r} must not raise, but its run raised {said(error)}"
            ) from error
        checks = Checks(self.name, self.model.n, self.model.m, self.has_covariance)
        found = checks.output(returned, "run", z.shape[:2])
        innovation, s = without_missing(found, z)
        for part, values in zip(out, Output(found.mean, found.cov, innovation, s), strict=True):
            part[...] = 0.0 if values is None else values

    def _one_by_one(self, keys: np.ndarray, inputs: np.ndarray, z: np.ndarray, out: tuple) -> None:
        session = self.session()
        for b, key in enumerate(keys):
            for k in range(z.shape[1]):
                try:
                    if k:
                        session.step(inputs[b, k - 1], z[b, k])
                    else:
                        session.start(tuple(int(word) for word in key), z[b, k])
                except ValueError as error:
                    raise ValueError(f"{error} of run {b}") from error
                now = session.mean, session.cov, session.innovation, session.innovation_cov
                for part, values in zip(out, now, strict=True):
                    part[b, k] = values
