"""`ForeignFilter`: an estimator of another package in the place of a filter."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from filters.engine.belief import Belief, Innovation, Kernels
from filters.estimators.checked import Checks, absent, log_likelihoods, without_missing
from filters.estimators.estimator import Output, is_estimator
from filters.estimators.session import EstimatorSession, seed_of
from filters.filter import Filter
from thruster_env.core.checks import short_repr
from thruster_env.core.global_generators import GlobalGenerators, seeded_copy
from thruster_env.core.modules import error_line
from thruster_env.core.streams import GLOBAL_GENERATORS, derived_seed

DIFFERENCE = 1e-6  # between two runs of a key, relative to the largest number: threads differ by less


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
        ValueError: if it is no estimator, or one that refuses the model.
    """

    name: ClassVar[str] = "estimator"  # of the class; each has its own
    varying_noise: ClassVar[bool] = False
    estimator: Any
    label: str = ""

    def __post_init__(self):
        estimator = self.estimator
        if not is_estimator(estimator):
            rule = "an estimator must have reset(key, z) and step(u, z), or run(keys, inputs, measurements)"
            raise ValueError(f"{rule}, but got {short_repr(estimator)}")
        check = getattr(estimator, "check_model", None)
        if callable(check):
            check(self.model)
        declared = getattr(estimator, "name", None)
        name = declared if isinstance(declared, str) and declared else self.label or type(estimator).__name__
        object.__setattr__(self, "name", name)
        for fact in ("has_covariance", "gaussian_likelihood"):
            object.__setattr__(self, fact, bool(getattr(estimator, fact, True)))

    def kernels(self) -> Kernels:
        """Raise ValueError: another package's estimator cannot be compiled."""
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

    def session(self, gate: float | None = None) -> EstimatorSession:
        """The estimator on one trajectory; ValueError for a gate, which it would need to have itself."""
        if gate is not None:
            raise ValueError(f"a gate needs a filter of filters.FILTERS, but got {self.name!r}")
        return EstimatorSession(self)

    def fill(self, keys: np.ndarray, inputs: np.ndarray, measurements: np.ndarray, out: tuple) -> None:
        """Put the estimates of a batch into arrays `out`, as `filters.engine.batch.run` has them.

        Raises:
            ValueError: with the step, if the estimator raises, or gives wrong shapes, NaN, or no covariance.
        """
        means, covs, innovations, innovation_covs, likelihoods, divergences = out
        divergences[:] = 0.0
        fill = self._fill_at_once if callable(getattr(self.estimator, "run", None)) else self._fill_one_by_one
        fill(keys, inputs, measurements, (means, covs, innovations, innovation_covs))
        likelihoods[:] = log_likelihoods(innovations, innovation_covs, measurements, self.gaussian_likelihood)

    def _fill_at_once(self, keys: np.ndarray, inputs: np.ndarray, z: np.ndarray, out: tuple) -> None:
        generators, arguments = GlobalGenerators(), (keys.astype(np.int64), inputs.copy(), z.copy())
        seed = seed_of(arguments[0][0]) if len(keys) else 0
        generators.seed(derived_seed(seed, GLOBAL_GENERATORS))
        try:
            with generators.used():
                returned = _copied(self.estimator, seed).run(*arguments)
        except Exception as error:
            rule = f"the estimator {self.name!r} must not raise"
            raise ValueError(f"{rule}, but its run raised {error_line(error)}") from error
        checks = Checks(self.name, self.model.n, self.model.m, self.has_covariance)
        output = checks.output(returned, "run", z.shape[:2])
        innovation, s = without_missing(output, z)
        for part, values in zip(out, Output(output.mean, output.cov, innovation, s), strict=True):
            part[...] = absent(part is out[1]) if values is None else values

    def _fill_one_by_one(self, keys: np.ndarray, inputs: np.ndarray, z: np.ndarray, out: tuple) -> None:
        session, again = self.session(), np.empty(out[0].shape[1:])
        for b in range(len(keys)):
            _run(session, b, (keys, inputs, z), tuple(part[b] for part in out))
        if len(keys) and not self.__dict__.get("_repeats"):
            _run(session, 0, (keys, inputs, z), (again,))
            room = DIFFERENCE * np.abs(again).max(initial=0.0)
            same = (np.abs(again - out[0][0]) <= room).all(axis=-1)
            if not same.all():
                raise ValueError(
                    f"the estimator {self.name!r} must give the same for the same key and data, but when run "
                    f"0 is repeated, its mean differs from step {int(np.argmin(same))} on: reset must seed "
                    "all random numbers"
                )
            object.__setattr__(self, "_repeats", True)


def _run(session: EstimatorSession, b: int, arguments: tuple, out: tuple) -> None:
    """Put run b into arrays: (K + 1, n) of means, and more of the session's parts if there are more arrays."""
    keys, inputs, z = arguments

    def keep(k: int) -> None:
        now = session.mean, session.cov, session.innovation, session.innovation_cov
        for part, values in zip(out, now, strict=False):
            part[k] = values

    try:
        session.start(tuple(int(word) for word in keys[b]), z[b, 0])
        keep(0)
        with session.generators.used():  # once a run, for it takes some ten microseconds
            for k in range(1, z.shape[1]):
                session.step(inputs[b, k - 1], z[b, k])
                keep(k)
    except ValueError as error:
        raise ValueError(f"{error} of run {b}") from error


def _copied(estimator: Any, seed: int) -> Any:
    """A copy, so that no run begins where another one ended; of what cannot be copied itself."""
    try:
        return seeded_copy(estimator, seed)
    except Exception:
        return estimator
