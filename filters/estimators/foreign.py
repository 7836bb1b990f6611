"""`ForeignFilter`: an estimator of another package in place of a filter, over logs and beside envs.

Beside an env it runs on one trajectory, or on one for each copy of a vector env.
"""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from filters.engine.belief import Belief, Innovation, Kernels, checked_key, vector_like
from filters.estimators.estimator import (
    Checks,
    Output,
    absent,
    is_estimator,
    log_likelihoods,
    steps_alone,
    without_missing,
)
from filters.filter import Filter
from thruster_env.core.checks import short_repr
from thruster_env.core.modules import error_line
from thruster_env.core.streams import GLOBAL_GENERATORS, GlobalGenerators, derived_seed, seeded_copy
from thruster_env.model.continuous import same_dt

DIFFERENCE = 1e-6  # between two runs of a key, relative to the largest number: threads differ by less


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
    """An estimator on N copies of a vector env, a copy of it for each; see `batch.Beliefs`."""

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

    def update(self, belief: Belief, z, *, u=None, measurement_noise_cov=None) -> tuple[Belief, Innovation]:
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
