"""Filters of several models: the interacting multiple model filter, and static model probabilities.

Each mode has a filter with its own model. All lie in one row of numbers, and are mixed, run, weighted and merged.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from filters.algebra.matrices import input_matrix
from filters.algebra.points import dot
from filters.augmented import embedded_model, places_within
from filters.engine.belief import Belief, Kernels, filter_offset, memory_offsets, restart_if_lost
from filters.filter import Filter
from filters.gaussian.blending import (
    Absent,
    Parts,
    absent_states,
    blender,
    completer,
    log_weigher,
    logarithm,
    nothing,
    parts_of,
)
from filters.pages.kernels import anything_measured, nothing_to_summarise, stored, works_of
from thruster_env.core.checks import as_floats, between, one_of, positive, short_repr, vector
from thruster_env.graphs.programs import Place
from thruster_env.logs.log import in_steps_of, sample_time_of
from thruster_env.model.continuous import same_dt
from thruster_env.model.shape import Shape, starts_of
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import refuse_rotations, tangent_flags

LOST = 700.0  # log-likelihood of a mode whose filter restarts: this much below the least of the other modes
MOST_MODES = 32
SUM_TOLERANCE = 1e-9
SINGULAR = 1e-12  # determinant of a transition matrix without a logarithm
USUAL_FACTORS = (0.1, 1.0, 10.0)  # on Q


class Mode(NamedTuple):
    """The filter of a mode, and how many numbers it and its model have."""

    kernels: Kernels
    length: int


@lru_cache(maxsize=64)
def mode_kernels(
    modes: tuple[Mode, ...], shape: Shape, absent: tuple[Absent, ...] = (), mixing: Callable | None = None
) -> Kernels:
    """Kernels for filters with the states, inputs and measurements of `shape`; modes may lack states (`absent`).

    The filter's parameters are p (K,), Pi (K, K) by columns, and the numbers of each mode. Extras: the memory of
    each mode's filter, then the logarithms of the probabilities. For a column of Pi `mixing(p, mu)` returns the
    weights of all modes in the mixture with which one mode begins a step, and its probability; without `mixing`
    the filters do not mix.
    """
    n, m, count, belief = shape.n, shape.m, len(modes), shape.n + shape.t**2
    at, first_parameter = memory_offsets(n, m, shape.t), filter_offset(shape)
    first, stride = at.extras, at.extras + max(mode.kernels.extras + mode.kernels.scratch for mode in modes)
    parts, logs = Parts(first, stride, count), first + count * stride
    probabilities = logs + count  # scratch from here on
    completing = probabilities + count * (3 + belief)  # after the scratch of `_mixer`
    end = completing + (count + belief) * bool(absent)
    of_states = blender(parts, n, at.mean, at.cov, shape.state_angles, turns=shape.turns)
    angles = tangent_flags(shape.measurement_angles, shape.measured_turns)
    of_innovations = blender(parts, m, at.innovation, at.innovation_cov, angles, wraps=False)
    innovation, level, step, lost = at.innovation, at.log_likelihood, at.step, at.divergences
    of_modes = [
        first_parameter + count + count * count + start for start in starts_of(*(mode.length for mode in modes))
    ]
    start_all, predict_all, update_all = _of_all(modes, parts, of_modes)
    model = shape.offsets
    priors = [(offset + model.prior_mean, offset + model.prior_cov) for offset in of_modes[:-1]]
    complete = completer(absent, parts, n, of_states, priors, completing)
    weigh = log_weigher(parts, level)

    def blend(row, weights, numbers, target):
        complete(row, weights, numbers)
        of_states(row, weights, target)

    mix = nothing if mixing is None else _mixer(mixing, parts, belief, logs, first_parameter + count, blend)

    def recall(row):
        for j in range(count):
            row[probabilities + j] = math.exp(row[logs + j])

    def start(memory, numbers, size):
        row, _, _ = memory
        for i in range(first, end):
            row[i] = 0.0
        for j in range(count):
            row[logs + j] = logarithm(numbers[first_parameter + j])
        recall(row)
        start_all(memory, numbers, numbers)
        blend(row, probabilities, numbers, 0)

    def predict(memory, u, numbers, size):
        row, _, _ = memory
        mix(memory, u, numbers)
        recall(row)
        predict_all(memory, u, numbers)
        blend(row, probabilities, numbers, 0)
        row[step] += 1.0

    def update(memory, z, numbers, size):
        row, _, _ = memory
        recall(row)
        begun = 0.0
        for j in range(count):
            begun -= row[first + j * stride + lost]
        update_all(memory, z, numbers)
        for j in range(count):
            begun += row[first + j * stride + lost]
        of_innovations(row, probabilities, innovation)
        row[level], least = 0.0, -math.inf
        if anything_measured(z):
            least = math.inf
            for j in range(count):
                part = first + j * stride
                if not row[part + lost] > 0.0:
                    least = min(least, row[part + level])
            for j in range(count):
                part = first + j * stride
                if row[part + lost] > 0.0:  # it has restarted: its likelihood is not that of this measurement
                    row[part + lost], row[part + level] = 0.0, least - LOST if least < math.inf else -math.inf
            row[level] = weigh(row, logs, probabilities)
        if begun > 0.0 and least < math.inf:
            row[lost] += 1.0  # some modes restart; if all do, the likelihood is 0 and the whole belief restarts
        blend(row, probabilities, numbers, 0)

    extras = probabilities - first
    acting = (first + j * stride + at for j, mode in enumerate(modes) for at in mode.kernels.acting)
    works = start, predict, update, nothing_to_summarise
    return Kernels(
        *(n, m, n, 0, *works),
        extras=extras,
        scratch=end - first - extras,
        acting=tuple(acting),
        turns=len(shape.turns),
        measured_turns=len(shape.measured_turns),
    )


def _mixer(mixing: Callable, parts: Parts, belief: int, logs: int, transitions: int, blend: Callable) -> Callable:
    """Return `mix(memory, u, numbers)`: each filter begins a step with a mixture of all beliefs.

    To avoid underflow `mixing` gets, for each column of Pi, mu divided by the largest one that leads to its mode.
    """
    first, stride, count = parts
    ratios, foreseen, shares, mixed = (logs + k * count for k in (1, 2, 3, 4))
    p, mu = input_matrix(Place("numbers", 0), (count,)), input_matrix(Place("rows", ratios), (count,))
    (share,) = works_of(stored(mixing(p, mu), (Place("rows", shares), Place("given", 0))))

    def mix(memory, u, numbers):
        row, _, _ = memory
        for j in range(count):
            column, top = transitions + j * count, -math.inf
            for i in range(count):
                if numbers[column + i] > 0.0:
                    top = max(top, row[logs + i])
            if top > -math.inf:
                for i in range(count):
                    row[ratios + i] = math.exp(row[logs + i] - top) if numbers[column + i] > 0.0 else 0.0
                share(row, row[foreseen + j :], numbers[column:])
                row[foreseen + j] = top + logarithm(row[foreseen + j])
            else:  # no mode leads to this one: its filter continues unmixed
                row[foreseen + j] = -math.inf
                for i in range(count):
                    row[shares + i] = 1.0 if i == j else 0.0
            blend(row, shares, numbers, mixed + j * belief)
        for j in range(count):
            row[logs + j] = row[foreseen + j]
            for i in range(belief):
                row[first + j * stride + i] = row[mixed + j * belief + i]

    return mix


def _of_all(modes: tuple[Mode, ...], parts: Parts, numbers: Sequence[int]) -> tuple[Callable, ...]:
    """Functions (memory, given, numbers) that start, predict and update the filters of all modes."""
    at: dict[Kernels, list[tuple[int, int, int]]] = {}
    for j, mode in enumerate(modes):
        at.setdefault(mode.kernels, []).append((parts.first + j * parts.stride, numbers[j], numbers[j + 1]))
    works: tuple[Callable, ...] = nothing, nothing, nothing
    for kernels, offsets in at.items():
        works = _then(works, kernels, tuple(offsets), parts.stride)
    return works


def _then(before: tuple, kernels: Kernels, offsets: tuple, stride: int) -> tuple[Callable, ...]:
    """Functions that run those of `before`, then modes with equal kernels, by offsets of rows and numbers."""
    start_others, predict_others, update_others = before
    begin, move, correct, restart = kernels.start, kernels.predict, kernels.update, restart_if_lost(kernels)

    def start(memory, inputs, numbers):
        start_others(memory, inputs, numbers)
        row, table, draws = memory
        for offset, first, last in offsets:
            begin((row[offset : offset + stride], table, draws), numbers[first:last], 0)

    def predict(memory, u, numbers):
        predict_others(memory, u, numbers)
        row, table, draws = memory
        for offset, first, last in offsets:
            move((row[offset : offset + stride], table, draws), u, numbers[first:last], 0)

    def update(memory, z, numbers):
        update_others(memory, z, numbers)
        row, table, draws = memory
        for offset, first, last in offsets:
            mode, of_mode = (row[offset : offset + stride], table, draws), numbers[first:last]
            correct(mode, z, of_mode, 0)
            restart(mode, of_mode, 0)

    return start, predict, update


@dataclass(frozen=True, kw_only=True, eq=False)
class MultipleModelFilter(Filter):
    """Base of filters that run one filter for each of K models, its modes; see the subclasses.

    Attributes:
        modes: K models with the inputs and measurements of `model` and its states, or some of them by their
            symbols, or changes of it, as `StateSpaceModel.replace` takes them; `usual_modes` if None.
        mode_filter: name of a Gaussian filter for all modes, such as "kf", "ekf" or "ukf", or one for each.
        probabilities: initial probabilities p (K,) of the modes; `usual_probabilities` if None.
        absent: mean and variance of a state, by symbol, in modes that lack it; by default modes that lack a state
            get the moments of the modes that have it (`filters.gaussian.blending`).
    """

    one_model: ClassVar[bool] = False
    any_step: ClassVar[bool] = False
    by_length: ClassVar[bool] = True
    gaussian_likelihood: ClassVar[bool] = False
    varying_noise: ClassVar[bool] = False  # each mode has Q and R of its own
    mixing: ClassVar[Callable | None] = None  # see `mode_kernels`
    modes: Any = None
    mode_filter: Any = "ekf"
    probabilities: Any = None
    absent: Any = None

    def __post_init__(self):
        _ = self.p, self.transition_matrix

    @property
    def usual_modes(self) -> Sequence[Mapping[str, Any]]:
        """Changes of the model, the default of `modes`."""
        raise NotImplementedError

    @property
    def usual_probabilities(self) -> Sequence[float] | np.ndarray:
        """Initial probabilities of the modes, the default of `probabilities`: all equal."""
        return np.full(len(self.mode_filters), 1.0 / len(self.mode_filters))

    @property
    def transition_matrix(self) -> np.ndarray:
        """Pi (K, K): the probability of mode j a step after mode i."""
        return np.eye(len(self.mode_filters))

    @property
    def p(self) -> np.ndarray:
        """Initial probabilities (K,) of the modes."""
        probabilities = self.usual_probabilities if self.probabilities is None else self.probabilities
        return probabilities_of("probabilities", probabilities, (len(self.mode_filters),))

    @cached_property
    def mode_filters(self) -> tuple[Filter, ...]:
        """The filter of each mode."""
        from filters.registry import make_filter  # here, because that module imports this one

        models = self._models
        names = [self.mode_filter] * len(models) if isinstance(self.mode_filter, str) else self.mode_filter
        if not isinstance(names, Sequence) or len(names) != len(models):
            rule = f"mode_filter must be one name, or one for each of {len(models)} modes"
            raise ValueError(f"{rule}, but got {short_repr(names)}")
        free = (model.replace(bounds=()) if model.bounds else model for model in models)
        filters = tuple(make_filter(name, model) for name, model in zip(names, free, strict=True))
        for filter_ in filters:
            if not filter_.gaussian_likelihood or filter_.size or not filter_.has_covariance:
                rule = "mode_filter must be a filter of one mean and covariance"
                raise ValueError(f"{rule}, such as 'ekf', but got {filter_.name!r}")
            if self.mixing is not None and not filter_.mixable:
                rule = f"mode_filter of {self.name!r}, which mixes estimates, must keep no window of steps"
                raise ValueError(f"{rule}, but got {filter_.name!r}: 'mmae' takes it")
        return filters

    @cached_property
    def _mode_models(self) -> list[StateSpaceModel]:
        """The models of the modes, with the states that each has."""
        model, modes = self.model, self.usual_modes if self.modes is None else self.modes
        if not isinstance(modes, Sequence) or not 2 <= len(modes) <= MOST_MODES:
            raise ValueError(f"modes must be a list of 2 to {MOST_MODES} models, but got {short_repr(modes)}")
        models = [self._changed(mode) if isinstance(mode, Mapping) else mode for mode in modes]
        for mode in models:
            if not isinstance(mode, StateSpaceModel):
                raise ValueError(f"a mode must be a model, or changes of one, but got {short_repr(mode)}")
            if _sizes(mode) != _sizes(model):
                rule = "measurements, inputs and angles of a mode must be those of the model"
                raise ValueError(f"{rule}, {_sizes(model)}, but got {_sizes(mode)}")
        return models

    @cached_property
    def _places(self) -> list[tuple[int, ...]]:
        """Indices of each mode's states among the model's."""
        return [places_within(mode.states, self.model.states) for mode in self._mode_models]

    @cached_property
    def _models(self) -> list[StateSpaceModel]:
        every, moments = tuple(range(self.model.n)), self._moments
        if any(indices != every for indices in self._places):
            refuse_rotations(self.model)
        return [
            mode if indices == every else embedded_model(mode, self.model, moments)
            for mode, indices in zip(self._mode_models, self._places, strict=True)
        ]

    @cached_property
    def _moments(self) -> dict[int, tuple[float, float]]:
        """Mean and variance of states in modes that lack them, by index, from the argument `absent`."""
        moments = {} if self.absent is None else self.absent
        if not isinstance(moments, Mapping):
            raise ValueError(f"absent must map symbols to (mean, variance), but got {short_repr(moments)}")
        symbols = [state.symbol for state in self.model.states]
        lacking = [name for i, name in enumerate(symbols) if not all(i in indices for indices in self._places)]
        moments_by_index = {}
        if moments and not lacking:
            raise ValueError("absent needs a mode that lacks states, but all have all")
        for name, value in moments.items():
            index = symbols.index(one_of("absent", name, lacking))
            mean, variance = vector(f"absent[{name!r}]", value, 2).tolist()
            moments_by_index[index] = mean, positive(f"variance of absent[{name!r}]", variance, zero_allowed=True)
        for i, name in enumerate(symbols):
            if i not in moments_by_index and not any(i in indices for indices in self._places):
                raise ValueError(f"each state must be one of a mode's, or of absent, but {name!r} is of none")
        return moments_by_index

    @cached_property
    def sample_time(self) -> float:
        """That of all modes [s]; ValueError if they differ, or a mode's filter has the gain of one."""
        what = f"steps of any length of {self.name!r}"
        of_modes = [sample_time_of(model, what) for model in (self.model, *self._mode_models)]
        if not all(same_dt(dt, of_modes[0]) for dt in of_modes):
            raise ValueError(f"modes must have one sample time for steps of any length, but got {of_modes}")
        for mode in self.mode_filters:
            if not (mode.any_step or mode.by_length):
                raise ValueError(f"a mode's filter must take steps of any length, but got {mode.name!r}")
        return of_modes[0]

    def of_length(self, length: float) -> Self:
        """The filter with the modes of another sample time [s], and their transitions within it."""
        ratio = length / self.sample_time
        if same_dt(ratio, 1.0):
            return self
        modes = [in_steps_of(model, length) for model in self._mode_models]
        changes: dict[str, Any] = {
            "model": in_steps_of(self.model, length),
            "modes": modes,
            "probabilities": self.p,
        }
        return dataclasses.replace(self, **changes, **self._transitions(ratio))

    def _transitions(self, ratio: float) -> dict[str, Any]:
        """The field that has Pi of a part of a step, if there is one."""
        return {}

    @cached_property
    def absent_states(self) -> tuple[Absent, ...]:
        """States that some modes lack."""
        return absent_states(self._places, self.model.n, tuple(self._moments))

    def _changed(self, changes: Mapping[str, Any]) -> StateSpaceModel:
        names = [field.name for field in dataclasses.fields(self.model) if field.init]
        return self.model.replace(
            **{one_of("a change of a mode", name, names): it for name, it in changes.items()}
        )

    @cached_property
    def own_parameters(self) -> tuple[float, ...]:
        """p, Pi by columns, and the numbers of all modes."""
        of_modes = [filter_.numbers for filter_ in self.mode_filters]
        return tuple(np.concatenate([self.p, self.transition_matrix.T.ravel(), *of_modes]).tolist())

    def kernels(self) -> Kernels:
        """Kernels for the modes; see `Filter.kernels`."""
        modes = tuple(Mode(filter_.kernels(), len(filter_.numbers)) for filter_ in self.mode_filters)
        return mode_kernels(modes, self.model.any_shape, self.absent_states, self.mixing)

    @property
    def takes_rotations(self) -> bool:
        """Whether the filters of all modes take models with rotations."""
        return all(getattr(filter_, "takes_rotations", False) for filter_ in self.mode_filters)

    def mode_probabilities(self, belief: Belief) -> np.ndarray:
        """Probabilities mu (K,) of the modes of a belief."""
        return self.mode_estimates(belief)[2]

    def mode_estimates(self, belief: Belief) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means (K, n), covariances (K, t, t) and probabilities (K,) of the modes of a belief."""
        means, covs, logs = self.mode_moments(belief)
        return means, covs, np.exp(logs)

    def mode_moments(self, belief: Belief) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """`mode_estimates` with the logarithms of the probabilities, -inf of zero."""
        return parts_of(belief.extras, len(self.mode_filters), self.model.n, self.model.t)


def _sizes(model: StateSpaceModel) -> tuple:
    return model.m, model.inputs, model.any_shape.measurement_angles, model.turns, model.measured_turns


def probabilities_of(name: str, user_value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Return probabilities as floats; raise ValueError unless they sum to one over the last axis."""
    try:
        probabilities = as_floats(user_value)
    except ValueError:
        probabilities = np.empty(0)
    fits = probabilities.shape == shape and (probabilities >= 0.0).all()
    if not fits or not np.allclose(probabilities.sum(axis=-1), 1.0, rtol=0.0, atol=SUM_TOLERANCE):
        rule = f"{name} must be {' x '.join(map(str, shape))} numbers of at least 0 that sum to 1"
        raise ValueError(f"{rule}{' in each row' if len(shape) > 1 else ''}, but got {short_repr(user_value)}")
    return probabilities


def mixing(p, mu):
    """Weights mu_i|j with which mode j begins a step, and its probability c_j; p is column j of Pi."""
    c = dot(p, mu)
    return p * mu / c, c


@dataclass(frozen=True, kw_only=True, eq=False)
class InteractingMultipleModelFilter(MultipleModelFilter):
    """Interacting multiple models (IMM): the plant is in one of K modes, each with its own model and filter.

        mix:     c_j = sum over i of Pi_ij mu_i,  mu_i|j = Pi_ij mu_i/c_j; the filter of mode j begins with
                 x0_j = sum of mu_i|j x_i,  P0_j = sum of mu_i|j (P_i + (x_i - x0_j)(x_i - x0_j)')
        predict: each filter with its model
        update:  each filter; L_j = N(v_j; 0, S_j),  mu_j = c_j L_j/L,  L = sum of c_j L_j
        merge:   mean = sum of mu_j x_j,  P = sum of mu_j (P_j + (x_j - mean)(x_j - mean)')

    mu are the probabilities of the modes (`mode_probabilities`), Pi_ij that of mode j a step after mode i. By
    default Pi = stay I + (1 - stay) 1 p': the mode stays with probability `stay`; otherwise the step draws a mode
    with the probabilities p of the first step. The log-likelihood is log L; innovation and S are those of the
    mixture before the measurement.

    Modes are models, or changes of `model`, such as `{"measurement_noise_cov": 100 * R}`. By default there are
    two, the model and the model with R times `outlier_scale`, with probabilities 1 - `outlier_rate` and
    `outlier_rate`: a filter for outliers. A mode that lacks one of the model's states gets its moments from the
    modes that have it (unbiased mixing, `filters.gaussian.multiple_models`), or from `absent`.

    Probabilities are kept as logarithms, so that a mode whose probability is below the least float64 regains
    weight if measurements support it. `Belief.extras` holds the memory of the modes' filters, then these
    logarithms: see `mode_estimates`.

    Attributes:
        stay: probability that a step keeps its mode without a draw, within 0 and 1.
        transition: Pi (K, K), whose rows sum to 1, in place of `stay`.
        outlier_scale: factor on R in the second mode of the default modes.
        outlier_rate: probability of that mode.

    Raises:
        ValueError: if models are of other sizes, probabilities do not sum to 1, or a filter is no Gaussian one.

    Source: Blom, Bar-Shalom (1988), "The interacting multiple model algorithm for systems with Markovian switching
    coefficients"; Bar-Shalom, Li, Kirubarajan (2001), Estimation with Applications to Tracking and Navigation,
    section 11.6.6; unequal states: Granstrom, Willett, Bar-Shalom (2015).
    """

    name: ClassVar[str] = "imm"
    mixing: ClassVar[Callable] = staticmethod(mixing)
    stay: float = 0.9
    transition: Any = None
    outlier_scale: float = 100.0
    outlier_rate: float = 0.05

    def __post_init__(self):
        for name, check in (("stay", between), ("outlier_rate", between), ("outlier_scale", positive)):
            ends = (0.0, 1.0) if check is between else ()
            object.__setattr__(self, name, check(name, getattr(self, name), *ends))
        super().__post_init__()

    @property
    def usual_modes(self) -> Sequence[Mapping[str, Any]]:
        """The model, and the model with a larger R."""
        return {}, {"measurement_noise_cov": self.outlier_scale * self.model.measurement_noise_cov}

    @property
    def usual_probabilities(self) -> Sequence[float] | np.ndarray:
        """Those of outliers for the default modes; for others all equal."""
        return (
            super().usual_probabilities if self.modes is not None else (1.0 - self.outlier_rate, self.outlier_rate)
        )

    @property
    def transition_matrix(self) -> np.ndarray:
        """Pi (K, K): the probability of mode j a step after mode i."""
        count, transition = len(self.mode_filters), self.transition
        transition = self.stay * np.eye(count) + (1.0 - self.stay) * self.p if transition is None else transition
        return probabilities_of("transition", transition, (count, count))

    def _transitions(self, ratio: float) -> dict[str, Any]:
        """Pi of a part of a step, exp(ratio log Pi): of `stay` it is stay^ratio I + (1 - stay^ratio) 1 p'."""
        if self.transition is None:
            stay = self.stay**ratio
            return {"transition": stay * np.eye(len(self.p)) + (1.0 - stay) * self.p}
        from scipy.linalg import expm, logm  # which take long to import

        matrix = self.transition_matrix
        rates = logm(matrix) if np.linalg.det(matrix) > SINGULAR else np.full(matrix.shape, np.nan)
        between = np.where(np.eye(len(matrix)), 0.0, rates.real)
        if np.abs(np.imag(rates)).max() > SUM_TOLERANCE or not between.min() >= -SUM_TOLERANCE:
            rule = "transition must be that of a chain in continuous time for steps of different lengths"
            raise ValueError(f"{rule}, with rates log(Pi) of no negative sign, but got {matrix.tolist()}")
        powers = np.maximum(expm(ratio * rates.real), 0.0)
        return {"transition": powers / powers.sum(axis=1, keepdims=True)}


@dataclass(frozen=True, kw_only=True, eq=False)
class MultipleModelAdaptiveEstimator(MultipleModelFilter):
    """Multiple model adaptive estimation (MMAE): one of K models is right at all times; the data determine which.

        mu_j is proportional to mu_j L_j,  L_j = N(v_j; 0, S_j); each filter runs by itself
        mean = sum of mu_j x_j,  P = sum of mu_j (P_j + (x_j - mean)(x_j - mean)')

    By default the modes are the model with Q times 0.1, 1 and 10. Log-likelihood, innovation and S are those of
    the mixture; `mode_probabilities` and `mode_estimates` return those of the modes. Probabilities are kept as
    logarithms: a model whose probability has vanished regains it if as much evidence supports it. Measurements of
    the whole run have equal weight, so take `imm` if the plant switches between models.

    Raises:
        ValueError: if models are of other sizes, probabilities do not sum to 1, or a filter is no Gaussian one.

    Source: Magill (1965), "Optimal adaptive estimation of sampled stochastic processes".
    """

    name: ClassVar[str] = "mmae"

    @property
    def usual_modes(self) -> Sequence[Mapping[str, Any]]:
        """The model with a smaller Q, its own, and a larger one."""
        return [{"process_noise_cov": factor * self.model.process_noise_cov} for factor in USUAL_FACTORS]
