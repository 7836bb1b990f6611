"""`ForeignFilter`: an estimator of another package in place of a filter, over logs and beside envs.

Beside an env it runs on one trajectory, or on one for each copy of a vector env.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np

from filters.engine.belief import Belief, Innovation, Kernels, checked_key, vector_like
from filters.filter import Filter
from thruster_env.core.checks import as_floats, correlation_flaws, short_repr
from thruster_env.core.modules import error_line, is_code, object_named
from thruster_env.core.streams import GLOBAL_GENERATORS, GlobalGenerators, derived_seed, seeded_copy
from thruster_env.model.continuous import same_dt
from thruster_env.model.turns import refuse_rotations

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
        refuse_rotations(self.model)
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

    def session(self, gate: float | None = None, most: int | None = None) -> EstimatorSession:
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


TRAINED = ".safetensors"  # the end of the name of a trained estimator's file


READER = "filters.learned:read_estimator"  # of trained estimators' files; it needs torch, and knows this package


def is_trained(argument) -> bool:
    """Whether something is the name of a file of `thruster train-estimator`."""
    return isinstance(argument, str | Path) and str(argument).endswith(TRAINED)


def is_foreign(argument) -> bool:
    """Whether something stands for an estimator of another package, and is not the name of a filter."""
    return (
        is_trained(argument)
        or is_code(argument)
        or (not isinstance(argument, str) and (is_estimator(argument) or callable(argument)))
    )


def label_of(argument) -> str:
    """The label of a user's estimator: "module:object", its own name, that of its factory, or of its file."""
    if is_trained(argument):
        return Path(argument).stem
    if isinstance(argument, str):
        return argument
    for name in (getattr(argument, "name", None), getattr(argument, "__name__", None)):
        if isinstance(name, str) and name:
            return name
    return type(argument).__name__


def is_filter_class(argument) -> bool:
    """Whether something is a user's class of filters."""
    return isinstance(argument, type) and issubclass(argument, Filter)


def estimator_named(argument) -> Any:
    """A user's estimator argument: what a trained one's file makes, the object of "module:object", or itself."""
    if is_trained(argument):
        return object_named(READER, "reader")(argument)
    return object_named(argument, "estimator") if isinstance(argument, str) else argument
