"""Sessions: a filter that runs in place on one belief, and one that rejects measurements beyond a gate."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from math import inf, isfinite, prod
from typing import TYPE_CHECKING, Protocol

import numpy as np

from filters.engine.belief import (
    Belief,
    Innovation,
    LostBelief,
    OwnBelief,
    check_belief,
    checked_key,
    filter_offset,
    vector_like,
)
from filters.engine.compile import PREDICT, REFUSED, START, UPDATE, new_memory, operation_on
from thruster_env.core.checks import at_least, covariance, finite, positive
from thruster_env.logs.log import sample_time_place
from thruster_env.model.continuous import same_dt
from thruster_env.model.shape import with_root
from thruster_env.model.turns import of_channels, unit_mean

if TYPE_CHECKING:
    from filters.filter import Filter

STEP = PREDICT + UPDATE
NO_EXTRAS, FEW = np.empty(0), 100  # numbers, whose sum Python finds as fast as NumPy
FLAWS = TypeError, ValueError, LookupError, OverflowError  # of what are no numbers of float64
TASKS = {"start": START, "predict": PREDICT, "update": UPDATE}


class Running(Protocol):
    """A filter, or an estimator of another package, that runs in place on one trajectory.

    Attributes:
        mean, cov, innovation, innovation_cov: of the last step, (n,), (n, n), (m,), (m, m).
        divergences: restarts from the prior, so far.
    """

    mean: np.ndarray
    cov: np.ndarray
    innovation: np.ndarray
    innovation_cov: np.ndarray
    divergences: int

    def start(self, key, z) -> None:
        """Start with a random key (2,) and a first measurement z (m,)."""

    def step(self, u, z) -> None:
        """Predict with input u (p,), then update with measurement z (m,); NaN marks a missing channel."""


class Session:
    """A filter that runs in place on its own memory: wrappers step it, and `Filter.predict` uses one.

    Attributes:
        mean, cov, innovation, innovation_cov: views on the memory, (n,), (n, n), (m,), (m, m); cov is that of
            the errors, (t, t), if the state has rotations.
        divergences: restarts from the prior, so far, after an estimate that was not finite.
    """

    def __init__(self, filter_: Filter):
        """Allocate the memory of a filter; `start` or `load` comes next."""
        self._filter = filter_
        kernels, model, size = filter_.kernels(), filter_.kernel_model, filter_.size
        n, m = kernels.n, kernels.m
        t, layout = kernels.t, kernels.layout
        self._name, self._kernels = filter_.name, kernels
        self._numbers, self._size, self._places = filter_.numbers, size, layout
        self._kept_rows, self._noise_places = kernels.kept_rows, kernels.offsets
        self._memory = new_memory(kernels, size)
        self._row, self._table, _ = self._memory
        self._extras = self._row[layout.extras : layout.extras + kernels.extras]
        values = np.append(np.zeros(model.inputs), np.full(kernels.channels, np.nan))
        self._u, self._z, self._values = values[: model.inputs], values[model.inputs :], values
        self._p, self._m = model.inputs, kernels.channels
        self._scalar = self._p == self._m == 1
        self._prior_variances = model.prior_cov.diagonal()
        self._first_values = values.copy()
        self._noise_was: np.ndarray | None = None  # numbers before another Q or R
        arrays = model.process_noise_cov, model.measurement_noise_cov, model.prior_mean, model.prior_cov
        self._source, self._source_bytes = arrays, b"".join(map(np.ndarray.tobytes, arrays))
        self.divergences = 0
        self._moments = self._row[layout.mean : layout.key_0]  # mean and covariance, which are neighbours
        self._has_extras, self._has_belief = kernels.extras > 0, False
        self._latest: OwnBelief | None = None
        self._given = (*self._memory, size, values, self._numbers)
        self._operate: Callable[[int], int] = self._operate_first
        self.mean = self._row[layout.mean : layout.mean + n]
        self.cov = self._row[layout.cov : layout.cov + t * t].reshape(t, t)
        self.innovation = self._row[layout.innovation : layout.innovation + m]
        self.innovation_cov = self._row[layout.innovation_cov : layout.innovation_cov + m * m].reshape(m, m)

    def __getstate__(self) -> tuple:
        """The filter and its memory; machine code and views are rebuilt from these."""
        restarts = self.divergences if self._has_belief else None
        return self._filter, restarts, (*self._memory, self._values, self._numbers)

    def __setstate__(self, state: tuple) -> None:
        filter_, divergences, arrays = state
        type(self).__init__(self, filter_)
        self._go_on(divergences, arrays)

    def _go_on(self, divergences: int | None, arrays: tuple) -> None:
        if not np.array_equal(self._numbers, arrays[-1]):
            self._remember_noise()
        for array, stored in zip((*self._memory, self._values, self._numbers), arrays, strict=True):
            array[...] = stored
        self._has_belief, self.divergences = divergences is not None, divergences or 0

    def _operate_first(self, task: int) -> int:
        """Operate for the first time, which may compile."""
        if not (task & START or self._has_belief):
            raise ValueError("a session must begin with start(key, z) or load(belief), but got neither")
        self._operate, self._has_belief = operation_on(self._kernels, self._given), True
        return self._operate(task)

    def _do(self, task: int) -> None:
        self.divergences = self._operate(task)

    @property
    def numbers(self) -> np.ndarray:
        """The numbers that the kernels read, with all that was set: a view, laid out as `Filter.numbers`."""
        return self._numbers

    def clear(self) -> None:
        """Reset the memory to that of a new session."""
        for part in self._memory:
            part.fill(0.0)
        self._values[:] = self._first_values
        if self._noise_was is not None:
            self._numbers[:] = self._noise_was
            self._noise_was = None
        self.divergences, self._latest = 0, None

    def set_key(self, key) -> None:
        """Set the key (2,) on which the belief's randomness depends: two whole numbers below 2^32."""
        self._row[self._places.key_0], self._row[self._places.key_1] = checked_key(key)

    def set_input(self, u) -> None:
        """Set the input u (p,) on which the next measurement depends, in place of that of the last step.

        Raises ValueError if the model's h takes no input, or u is not p finite numbers.
        """
        offsets = list(self._kernels.acting)
        if not offsets:
            raise ValueError(
                f"u of a measurement needs a model with h(x, u, c), but that of {self._name!r} has h(x, c)"
            )
        u = vector_like("u", u, self._u, missing_allowed=False)
        self._row[offsets] = np.tile(u, len(offsets) // len(u))

    def set_noise(self, *, process_noise_cov=None, measurement_noise_cov=None) -> None:
        """Use another Q or R from now on, as a filter of a model with these would.

        Raises ValueError for a matrix that is no covariance, and for one that the filter cannot change:
        `Filter.fixed_noise`.
        """
        self._filter.check_noise(process_noise_cov, measurement_noise_cov)
        n, m, at = len(self.cov), len(self.innovation), self._noise_places
        self._remember_noise()
        if process_noise_cov is not None:
            q = covariance("process_noise_cov", process_noise_cov, n)
            self._numbers[at.q : at.q + 2 * n * n] = with_root(q)
        if measurement_noise_cov is not None:
            r = covariance("measurement_noise_cov", measurement_noise_cov, m, positive_definite=True)
            self._numbers[at.r : at.r + 2 * m * m] = with_root(r)

    def set_dt(self, dt: float) -> None:
        """Use another sample time from now on; the model needs a constant named "dt", or "substep", a part of dt.

        Q does not change: covariances are per step and do not scale with dt; `set_noise` sets another.

        Raises ValueError for a model without such a constant, a filter of several models or of an affine
        approximation, or another number.
        """
        index, parts = self._dt_place
        self._numbers[index] = positive("dt", dt) / parts

    @property
    def sample_time(self) -> float:
        """The sample time [s]; ValueError for a model without a constant for it."""
        index, parts = self._dt_place
        return float(self._filter.numbers[index]) * parts

    @cached_property
    def _dt_place(self) -> tuple[int, int]:
        """Index of the constant among the numbers, and how many substeps a step has."""
        self._check_one_model("set_dt")
        model = self._filter.model
        index, parts = sample_time_place(model, "set_dt")
        if self._filter.kernel_model.constants is not model.constants:  # A and B, which are those of one dt
            raise ValueError(
                f"set_dt needs a filter that evaluates f(x, u) at each step, but {self._name!r} has the A and B "
                "of one dt: 'ekf' is the Kalman filter at any dt where f and h are affine"
            )
        return self._noise_places.constants + index, parts

    def set_numbers(self, numbers: np.ndarray) -> None:
        """Use the numbers of `Filter.of_length` from now on."""
        self._remember_noise()
        self._numbers[:] = numbers

    def set_parameter(self, name: str, value: float) -> None:
        """Use another value of one of the filter's parameters from now on; ValueError for one that it lacks."""
        offset, names = filter_offset(self._filter.kernel_model.any_shape), []
        page = getattr(self._filter, "written_page", None)
        for known, shape in () if page is None else page.own:
            if known == name and not shape:
                self._remember_noise()
                self._numbers[offset] = finite(name, value)
                return
            names.append(known)
            offset += prod(shape)
        raise ValueError(f"a number of {self._name!r} must be one of {', '.join(names)}, but got {name!r}")

    def scale_process_noise(self, factor: float) -> None:
        """Use Q of the model times a factor above zero from now on.

        Raises ValueError for a filter of several models, and if the filter cannot change Q, unless the factor is 1
        to rounding.
        """
        self._check_one_model("scale_process_noise")
        if "Q" in self._filter.fixed_noise and same_dt(factor, 1.0):
            return
        self._filter.check_noise(process_noise_cov=factor)
        n, at = len(self.cov), self._noise_places.q
        self._remember_noise()
        scales = self._q_scales
        scales[: n * n], scales[n * n :] = factor, factor**0.5
        np.multiply(self._given_q, scales, out=self._numbers[at : at + 2 * n * n])

    def _check_one_model(self, name: str) -> None:
        if not self._filter.one_model:
            raise ValueError(f"{name} needs a filter with one model, but got {self._name!r}")

    def _remember_noise(self) -> None:
        if self._noise_was is None:
            self._noise_was = self._numbers.copy()

    @cached_property
    def _q_scales(self) -> np.ndarray:
        return np.empty(2 * len(self.cov) ** 2)

    @cached_property
    def _given_q(self) -> np.ndarray:
        n, at = len(self.cov), self._noise_places.q
        return self._filter.numbers[at : at + 2 * n * n]

    def start(self, key=(0, 0), z=None) -> None:
        """Set the prior with a random key (2,) and update it with a first measurement z (m,), if there is one."""
        self.read_functions()
        self.set_key(key)
        if z is None:
            self._do(START)
            return
        self._z[:] = vector_like("z", z, self._z, missing_allowed=True)
        self._do(START + UPDATE)

    def read_functions(self) -> None:
        """Use the model's functions as they are now: values that they have from outside may be others since."""
        if not self._filter.kernel_model.reads_from_outside:
            return
        kernels = self._filter.kernels()
        if kernels is not self._kernels:
            self._kernels, self._operate = kernels, self._operate_first

    def predict(self, u=()) -> None:
        """Predict one step ahead under input u (p,); ValueError for one that is not finite numbers."""
        try:
            if hasattr(u, "filled") or len(u) != self._p:
                raise TypeError
            self._u[:] = u
        except FLAWS:
            self._u[:] = vector_like("u", u, self._u, missing_allowed=False)
        divergences = self._operate(PREDICT)
        if divergences == REFUSED:
            vector_like("u", u, self._u, missing_allowed=False)  # raises ValueError with the reason
        self.divergences = divergences

    def update(self, z) -> None:
        """Update with measurement z (m,); NaN marks a missing channel. ValueError for an infinite one."""
        try:
            if hasattr(z, "filled") or len(z) != self._m:
                raise TypeError
            self._z[:] = z
        except FLAWS:
            self._z[:] = vector_like("z", z, self._z, missing_allowed=True)
        divergences = self._operate(UPDATE)
        if divergences == REFUSED:
            vector_like("z", z, self._z, missing_allowed=True)  # raises ValueError with the reason
        self.divergences = divergences

    def step(self, u, z) -> None:
        """Predict with input u (p,), then update with measurement z (m,); NaN marks a missing channel.

        Raises ValueError, before anything changes, for an input that is not finite and an infinite measurement.
        """
        try:  # inlined `_set`: its call would take a tenth of the step
            if hasattr(z, "filled") or hasattr(u, "filled"):  # numbers that are masked are not valid
                raise TypeError
            if len(z) != self._m or self._p and len(u) != self._p:  # NumPy would repeat a single number
                raise TypeError
            if self._scalar:  # the frequent case: an assignment to a slice takes twice as long
                self._values[0], self._values[1] = u[0], z[0]
            else:
                self._u[:], self._z[:] = u, z
        except FLAWS:  # `_set` checks only if this fails: a step has to be quick
            self._set(u, z)
        divergences = self._operate(STEP)
        if divergences == REFUSED:
            self._set(u, z)  # raises ValueError with the reason
        self.divergences = divergences

    def _set(self, u, z) -> None:
        self._u[:] = vector_like("u", u, self._u, missing_allowed=False)
        self._z[:] = vector_like("z", z, self._z, missing_allowed=True)

    def run(self, operation: str, u=None, z=None, count: int = 1) -> None:
        """Do only "start", "predict" or "update", with checked arguments; repeat a prediction `count` times."""
        if operation == "predict":
            self._u[:] = vector_like("u", u, self._u, missing_allowed=False)
        if operation == "update":
            self._z[:] = vector_like("z", z, self._z, missing_allowed=True)
        for _ in range(count):
            self._do(TASKS[operation])

    def load(self, belief: Belief) -> None:
        """Put a belief into the memory; ValueError if it does not fit the filter or is no belief."""
        shapes = {
            "mean": self.mean.shape,
            "cov": self.cov.shape,
            "members": (self._kept_rows, self._size),
            "extras": self._extras.shape,
        }
        for name, shape in shapes.items():
            part = getattr(belief, name)
            part_shape = part.shape if type(part) is np.ndarray else np.shape(part)
            if part_shape != shape:
                whose = f"a belief that the filter {self._name!r} can take"
                raise ValueError(f"{name} of {whose} must have shape {shape}, but got {part_shape}")
        check_belief(belief, self._prior_variances)
        unit_mean(belief.mean, self._filter.kernel_model.turns)
        self._remember(belief)
        self._has_belief = True
        self.set_key(belief.key)
        self._latest = None

    def _remember(self, belief: Belief) -> None:
        """Put a belief into the memory."""
        self.mean[:], self.cov[:] = belief.mean, belief.cov
        if self._size:
            self._table[: self._kept_rows] = belief.members[:, :1]  # the padding is copies of a member
            self._table[: self._kept_rows, : self._size] = belief.members
        self._extras[:] = belief.extras
        self._row[self._places.step], self._row[self._places.divergences] = belief.step, belief.divergences

    @property
    def is_current(self) -> bool:
        """Whether nobody has written to the arrays of the model since the session was made."""
        q, r, mean, cov = self._source
        return q.tobytes() + r.tobytes() + mean.tobytes() + cov.tobytes() == self._source_bytes

    def quickly(self, belief: OwnBelief, task: int, signal) -> OwnBelief | tuple[OwnBelief, Innovation] | None:
        """A belief that a session made, after a prediction under u (p,), or an update with z (m,).

        An update also returns the innovation. The result is None if `load` and `run` must find out what is wrong:
        a belief that was written to, a signal that is not as many numbers, finite or, of z, NaN, or a result that
        is not finite.
        """
        mean, cov, members, key, step, _, extras = belief
        if belief.origin is None:
            return None
        kernels, moments, rest = belief.origin
        if kernels is not self._kernels or mean.tobytes() + cov.tobytes() != moments or not self.is_current:
            return None
        if self._has_extras and extras.tobytes() != rest:
            return None
        target = self._u if task == PREDICT else self._z
        try:
            if type(signal) is np.ndarray:
                if signal.dtype.kind != "f" or signal.shape != target.shape:
                    return None
            elif type(signal) not in (list, tuple) or len(signal) != len(target) or sum(signal) is None:
                return None  # texts, which NumPy takes for numbers, have no sum
            target[:] = signal
        except FLAWS:
            return None
        if self._noise_was is not None:
            self._numbers[:] = self._noise_was
            self._noise_was = None
        if belief is not self._latest:  # else the memory holds it
            self._remember(belief)
        self._latest = None
        divergences = self._operate(task)
        if divergences == REFUSED:
            return None
        if task == PREDICT:
            step, numbers = step + 1, self._moments
            if not isfinite(sum(numbers.tolist()) if numbers.size < FEW else numbers.sum()):
                return None
            return self._own_belief(members, key, step, divergences)
        return self._own_belief(members, key, step, divergences), self.innovation_copy()

    def _own_belief(self, members, key, step: int, divergences: int) -> OwnBelief:
        """A copy of the belief in the memory."""
        extras, rest = NO_EXTRAS, b""
        if self._has_extras:
            extras, rest = self._extras.copy(), self._extras.tobytes()
        parts = self.mean.copy(), self.cov.copy(), members, key, step, divergences, extras
        belief = tuple.__new__(OwnBelief, parts)
        belief.origin = self._kernels, self._moments.tobytes(), rest
        self._latest = belief
        return belief

    def belief(self) -> Belief:
        """A copy of the belief in the memory."""
        row, layout = self._row, self._places
        key = int(row[layout.key_0]), int(row[layout.key_1])
        if not self._size and isfinite(self._moments.sum()):
            return self._own_belief(self._table[:, :0].copy(), key, int(row[layout.step]), self.divergences)
        members = self._table[: self._kept_rows, : self._size].copy()
        step, extras = int(row[layout.step]), self._extras.copy()
        # The sum is NaN or infinite if one of the numbers is.
        total = np.add.reduce(np.abs(row[: layout.key_0]))
        if self._size:
            total += np.abs(members[: len(self.mean)]).sum()
        kind = Belief if total < np.inf else LostBelief
        return kind(self.mean.copy(), self.cov.copy(), members, key, step, self.divergences, extras)

    def latest(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, float]:
        """Copies of mean, covariance and the last innovation with its covariance, and its log-likelihood."""
        return self.mean.copy(), self.cov.copy(), *self.innovation_copy()

    def innovation_copy(self) -> Innovation:
        """A copy of the last update's innovation."""
        log_likelihood = self._row.item(self._places.log_likelihood)
        return Innovation(self.innovation.copy(), self.innovation_cov.copy(), log_likelihood)


class GatedSession(Session):
    """A session whose steps leave out channels with |v_i| > gate sqrt(S_ii), as if they were missing.

    With `most`, the next measurements of a channel count after so many in a row were left out: it has jumped.

    Attributes:
        rejected: how often each channel was left out so far, (m,).

    Source: Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation, 3.6.
    """

    def __init__(self, filter_: Filter, gate: float, most: int | None = None):
        super().__init__(filter_)
        self.gate, self.most = positive("gate", gate), inf if most is None else at_least("most", most, 1)
        if not filter_.has_covariance:
            raise ValueError(f"a gate needs a filter with a covariance, but {filter_.name!r} has none")
        self.rejected = np.zeros(len(self.innovation), dtype=int)
        self._in_a_row = np.zeros(len(self.innovation), dtype=int)
        self._kept = tuple(part.copy() for part in self._memory)

    def step(self, u, z) -> None:
        """Predict with input u (p,), then update with the channels of z (m,) that are within the gate."""
        self._set(u, z)
        self.divergences = self._operate(PREDICT)
        for saved, part in zip(self._kept, self._memory, strict=True):
            saved[...] = part
        self.divergences = self._operate(UPDATE)
        far = np.abs(self.innovation) > self.gate * np.sqrt(self.innovation_cov.diagonal())
        self._in_a_row[:] = np.where(far, self._in_a_row + 1, np.where(self.innovation == 0.0, self._in_a_row, 0))
        far &= self._in_a_row <= self.most
        if far.any():
            for saved, part in zip(self._kept, self._memory, strict=True):
                part[...] = saved
            self._z[of_channels(far, self._filter.kernel_model.measured_turns)] = np.nan
            self.rejected += far
            self.divergences = self._operate(UPDATE)

    def __getstate__(self) -> tuple:
        """The state of a session, the gate, and the counts."""
        return super().__getstate__(), self.gate, self.most, self.rejected, self._in_a_row

    def __setstate__(self, state: tuple) -> None:
        of_session, gate, most, rejected, in_a_row = state
        filter_, divergences, arrays = of_session
        GatedSession.__init__(self, filter_, gate, None if most == inf else most)
        self._go_on(divergences, arrays)
        self.rejected[:], self._in_a_row[:] = rejected, in_a_row
