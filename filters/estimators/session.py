"""Estimators at work beside envs: on one trajectory, or on one a copy of a vector env."""

from __future__ import annotations

import copy

import numpy as np

from filters.engine.belief import checked_key, vector_like
from filters.estimators.checked import Checks, absent, without_missing
from filters.estimators.estimator import steps_alone
from thruster_env.core.global_generators import GlobalGenerators, seeded_copy
from thruster_env.core.modules import error_line
from thruster_env.core.streams import GLOBAL_GENERATORS, derived_seed
from thruster_env.model.continuous import same_dt


class EstimatorSession:
    """The counterpart of a filter's `Session`: a copy of an estimator on one trajectory, with checked outputs.

    Each trajectory begins with a fresh copy of the user's estimator. The key seeds the generators that it holds
    and the global ones of Python, NumPy and torch, so earlier trajectories have no effect.

    Attributes:
        generators: the estimator's global generators.
        mean, cov, innovation, innovation_cov: (n,), (n, n), (m,), (m, m), of the last output; without a covariance
            that is zero, and an innovation and its covariance that the estimator does not give are NaN.
        divergences: 0: an estimator whose numbers are not finite is an error.
    """

    def __init__(self, filter_):
        """Of a `filters.estimators.foreign.ForeignFilter`; `start` comes next."""
        if not steps_alone(filter_.estimator):
            rule = f"the estimator {filter_.name!r} must have reset(key, z) and step(u, z) to run beside an env"
            raise ValueError(f"{rule}, but it lacks them")
        model, self._filter = filter_.model, filter_
        n, m = model.n, model.m
        self._original = copy.deepcopy(filter_.estimator)
        self._estimator, self.generators = self._original, GlobalGenerators()
        self._checks = Checks(filter_.name, n, m, filter_.has_covariance)
        self._like = np.zeros(model.inputs), np.zeros(m)
        self._steps = 0
        self.divergences = 0
        self.mean, self.cov = np.zeros(n), np.zeros((n, n))
        self.innovation, self.innovation_cov = np.zeros(m), np.zeros((m, m))

    def start(self, key, z) -> None:
        """Begin with a random key (2,) and a first measurement z (m,)."""
        z = vector_like("z", z, self._like[1], missing_allowed=True)
        self._steps = 0
        key = checked_key(key)
        self._estimator = seeded_copy(self._original, seed_of(key))
        self.generators.seed(derived_seed(seed_of(key), GLOBAL_GENERATORS))
        self._take("reset", key, z)

    def step(self, u, z) -> None:
        """One step later, after input u (p,) and measurement z (m,); NaN marks a missing channel."""
        u = vector_like("u", u, self._like[0], missing_allowed=False)
        z = vector_like("z", z, self._like[1], missing_allowed=True)
        self._steps += 1
        self._take("step", u.copy(), z)

    def set_noise(self, *, process_noise_cov=None, measurement_noise_cov=None) -> None:
        """Raise ValueError for another Q or R: `Filter.fixed_noise`."""
        self._filter.check_noise(process_noise_cov, measurement_noise_cov)

    def scale_process_noise(self, factor: float) -> None:
        """Raise ValueError for another Q, unless the factor is 1 to rounding."""
        if not same_dt(factor, 1.0):
            self._filter.check_noise(process_noise_cov=factor)

    def set_dt(self, dt: float) -> None:
        """Raise ValueError: an estimator has no dt."""
        raise self._fixed_error("dt")

    def set_parameter(self, name: str, value: float) -> None:
        """Raise ValueError: an estimator keeps its numbers to itself."""
        raise self._fixed_error(str(name))

    def _fixed_error(self, name: str) -> ValueError:
        return ValueError(
            f"{name} of the estimator {self._filter.name!r} cannot vary from step to step, but got another "
            f"{name}: make the estimator for a model with it, or take a filter of filters.FILTERS"
        )

    def _take(self, method: str, first, z: np.ndarray) -> None:
        where = f"step {self._steps}"
        copied = z.copy()  # an estimator may write into it, or keep it
        try:
            with self.generators.used():
                returned = getattr(self._estimator, method)(first, copied)
        except Exception as error:
            rule = f"the estimator {self._checks.name!r} must not raise"
            raise ValueError(f"{rule}, but its {method} raised {error_line(error)} at {where}") from error
        output = self._checks.output(returned, where)
        innovation, s = without_missing(output, z)
        for attribute, value in (
            (self.mean, output.mean),
            (self.cov, output.cov),
            (self.innovation, innovation),
            (self.innovation_cov, s),
        ):
            attribute[...] = absent(attribute is self.cov) if value is None else value


def seed_of(key) -> int:
    """The seed of an estimator's generators in the run of a key."""
    return int(key[0]) << 32 | int(key[1])


class EstimatorBeliefs:
    """An estimator on N copies of a vector env, a copy of it for each; see `batch_session.Beliefs`."""

    def __init__(self, filter_, count: int):
        """Of a `ForeignFilter`; `start` comes next."""
        self._sessions = [EstimatorSession(filter_) for _ in range(count)]

    def start(self, which: np.ndarray, keys: np.ndarray, z: np.ndarray) -> None:
        """Begin in some copies with keys (len(which), 2) and measurements z (N, m)."""
        for i, key in zip(which, keys, strict=True):
            self._sessions[i].start(tuple(int(word) for word in key), z[i])

    def step(self, u: np.ndarray, z: np.ndarray, idle: np.ndarray | None = None) -> None:
        """One step in all copies that are not idle, with inputs u (N, p) and measurements z (N, m)."""
        for i, session in enumerate(self._sessions):
            if idle is None or not idle[i]:
                session.step(u[i], z[i])

    def part(self, name: str, *shape: int) -> np.ndarray:
        """A copy of a part of all sessions, such as "mean": (N, *shape)."""
        return np.array(
            [np.reshape(getattr(session, name), shape) for session in self._sessions], dtype=np.float64
        )
