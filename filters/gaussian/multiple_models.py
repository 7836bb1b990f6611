"""What filters that run a filter for each of several models share: the models, and their probabilities."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from filters.embedded import embedded_model, places_within
from filters.engine.belief import Belief, Kernels
from filters.filter import Filter
from filters.gaussian.absent import Absent, absent_states
from filters.gaussian.mixture import parts_of
from filters.gaussian.modes import Mode, mode_kernels
from thruster_env.core.checks import as_floats, one_of, positive, short_repr, vector
from thruster_env.model.state_space import StateSpaceModel

MOST_MODES = 32
SUM_TOLERANCE = 1e-9


@dataclass(frozen=True, kw_only=True, eq=False)
class MultipleModelFilter(Filter):
    """Base of filters that run one filter for each of K models, its modes; see the subclasses.

    Attributes:
        modes: K models with the inputs and measurements of `model` and its states, or some of them by their
            symbols, or changes of it, as `StateSpaceModel.replace` takes them; `usual_modes` if None.
        mode_filter: name of a Gaussian filter for all modes, such as "kf", "ekf" or "ukf", or one for each.
        probabilities: p (K,), of the modes at first; `usual_probabilities` if None.
        absent: mean and variance of a state, by symbol, in modes that lack it; without these it has there the
            moments of the modes that have it (`filters.gaussian.absent`).
    """

    one_model: ClassVar[bool] = False
    any_step: ClassVar[bool] = False
    gaussian_likelihood: ClassVar[bool] = False
    varying_noise: ClassVar[bool] = False  # each mode has Q and R of its own
    mixing: ClassVar[Callable | None] = None  # see `modes.mode_kernels`
    modes: Any = None
    mode_filter: Any = "ekf"
    probabilities: Any = None
    absent: Any = None

    def __post_init__(self):
        """Check the modes; raise ValueError that states the rule and the value."""
        _ = self.p, self.transition_matrix

    @property
    def usual_modes(self) -> Sequence[Mapping[str, Any]]:
        """Changes of the model where no modes are given."""
        raise NotImplementedError

    @property
    def usual_probabilities(self) -> Sequence[float] | np.ndarray:
        """Probabilities of the modes at first, where none are given: all equal."""
        return np.full(len(self.mode_filters), 1.0 / len(self.mode_filters))

    @property
    def transition_matrix(self) -> np.ndarray:
        """Pi (K, K): the probability of mode j a step after mode i."""
        return np.eye(len(self.mode_filters))

    @property
    def p(self) -> np.ndarray:
        """Probabilities (K,) of the modes at first."""
        given = self.usual_probabilities if self.probabilities is None else self.probabilities
        return probabilities_of("probabilities", given, (len(self.mode_filters),))

    @cached_property
    def mode_filters(self) -> tuple[Filter, ...]:
        """The filter of each mode."""
        from filters.registry import make_filter  # where this one is listed, too

        models = self._models
        names = [self.mode_filter] * len(models) if isinstance(self.mode_filter, str) else self.mode_filter
        if not isinstance(names, Sequence) or len(names) != len(models):
            rule = f"mode_filter must be one name, or one for each of {len(models)} modes"
            raise ValueError(f"{rule}, but got {short_repr(names)}")
        free = (model.replace(bounds=()) if model.bounds else model for model in models)
        found = tuple(make_filter(name, model) for name, model in zip(names, free, strict=True))
        for one in found:
            if not one.gaussian_likelihood or one.size or not one.has_covariance:
                rule = "mode_filter must be a filter of one mean and covariance"
                raise ValueError(f"{rule}, such as 'ekf', but got {one.name!r}")
            if self.mixing is not None and not one.mixable:
                rule = f"mode_filter of {self.name!r}, which mixes estimates, must keep no window of steps"
                raise ValueError(f"{rule}, but got {one.name!r}: 'mmae' takes it")
        return found

    @cached_property
    def _given(self) -> list[StateSpaceModel]:
        """The models of the modes, with the states that each has."""
        model, modes = self.model, self.usual_modes if self.modes is None else self.modes
        if not isinstance(modes, Sequence) or not 2 <= len(modes) <= MOST_MODES:
            raise ValueError(f"modes must be a list of 2 to {MOST_MODES} models, but got {short_repr(modes)}")
        models = [self._changed(one) if isinstance(one, Mapping) else one for one in modes]
        for one in models:
            if not isinstance(one, StateSpaceModel):
                raise ValueError(f"a mode must be a model, or changes of one, but got {short_repr(one)}")
            if _sizes(one) != _sizes(model):
                rule = "measurements, inputs and angles of a mode must be those of the model"
                raise ValueError(f"{rule}, {_sizes(model)}, but got {_sizes(one)}")
        return models

    @cached_property
    def _places(self) -> list[tuple[int, ...]]:
        """Places of the states of each mode among the model's."""
        return [places_within(one.states, self.model.states) for one in self._given]

    @cached_property
    def _models(self) -> list[StateSpaceModel]:
        """The models of the modes with all states."""
        every, moments = tuple(range(self.model.n)), self._moments
        return [
            one if places == every else embedded_model(one, self.model, moments)
            for one, places in zip(self._given, self._places, strict=True)
        ]

    @cached_property
    def _moments(self) -> dict[int, tuple[float, float]]:
        """Mean and variance of states in modes that lack them, by place, where these are given."""
        given = {} if self.absent is None else self.absent
        if not isinstance(given, Mapping):
            raise ValueError(f"absent must map symbols to (mean, variance), but got {short_repr(given)}")
        symbols = [one.symbol for one in self.model.states]
        lacking = [name for i, name in enumerate(symbols) if not all(i in own for own in self._places)]
        found = {}
        if given and not lacking:
            raise ValueError("absent needs a mode that lacks states, but all have all")
        for name, value in given.items():
            place = symbols.index(one_of("absent", name, lacking))
            mean, variance = vector(f"absent[{name!r}]", value, 2).tolist()
            found[place] = mean, positive(f"variance of absent[{name!r}]", variance, zero_allowed=True)
        for i, name in enumerate(symbols):
            if i not in found and not any(i in own for own in self._places):
                raise ValueError(f"each state must be one of a mode's, or of absent, but {name!r} is of none")
        return found

    @cached_property
    def absent_states(self) -> tuple[Absent, ...]:
        """States that some modes lack."""
        return absent_states(self._places, self.model.n, tuple(self._moments))

    def _changed(self, changes: Mapping[str, Any]) -> StateSpaceModel:
        names = [one.name for one in dataclasses.fields(self.model) if one.init]
        return self.model.replace(
            **{one_of("a change of a mode", name, names): it for name, it in changes.items()}
        )

    @cached_property
    def own_parameters(self) -> tuple[float, ...]:
        """p, Pi by columns, and the numbers of all modes."""
        of_modes = [one.numbers for one in self.mode_filters]
        return tuple(np.concatenate([self.p, self.transition_matrix.T.ravel(), *of_modes]).tolist())

    def kernels(self) -> Kernels:
        """Kernels for the modes; see `Filter.kernels`."""
        modes = tuple(Mode(one.kernels(), len(one.numbers)) for one in self.mode_filters)
        return mode_kernels(modes, self.model.shape, self.absent_states, self.mixing)

    def mode_probabilities(self, belief: Belief) -> np.ndarray:
        """Probabilities mu (K,) of the modes of a belief."""
        return self.mode_estimates(belief)[2]

    def mode_estimates(self, belief: Belief) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Means (K, n), covariances (K, n, n) and probabilities (K,) of the modes of a belief."""
        means, covs, logs = self.mode_moments(belief)
        return means, covs, np.exp(logs)

    def mode_moments(self, belief: Belief) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """The same with the logarithms of the probabilities, -inf of zero."""
        return parts_of(belief.extras, len(self.mode_filters), self.model.n)


def _sizes(model: StateSpaceModel) -> tuple:
    return model.m, model.inputs, model.shape.measurement_angles


def probabilities_of(name: str, given: Any, shape: tuple[int, ...]) -> np.ndarray:
    """Probabilities, which sum to one over the last axis."""
    try:
        found = as_floats(given)
    except ValueError:
        found = np.empty(0)
    fits = found.shape == shape and (found >= 0.0).all()
    if not fits or not np.allclose(found.sum(axis=-1), 1.0, rtol=0.0, atol=SUM_TOLERANCE):
        rule = f"{name} must be {' x '.join(map(str, shape))} numbers of at least 0 that sum to 1"
        raise ValueError(f"{rule}{' in each row' if len(shape) > 1 else ''}, but got {short_repr(given)}")
    return found
