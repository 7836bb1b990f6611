"""`LearnedEstimator`: the base of estimators with a network."""

from __future__ import annotations

from typing import ClassVar, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn

from filters.estimators.estimator import Output
from filters.learned.equations import Equations
from thruster_env.core.checks import as_floats, at_least, one_of
from thruster_env.core.threads import one_thread
from thruster_env.model.state_space import StateSpaceModel

MOST = 10_000  # members, or hidden states


class Track(NamedTuple):
    """An estimator's results for a batch after a step, with its memory.

    Attributes:
        mean: of the states, (B, n).
        cov: (B, n, n); None of an estimator that has none.
        innovation: (B, m), zero in missing channels; None of one that has none.
        innovation_cov: (B, m, m), or None.
        memory: further input of the next step: tensors, or objects with a method `detach`.
    """

    mean: Tensor
    cov: Tensor | None
    innovation: Tensor | None
    innovation_cov: Tensor | None
    memory: tuple

    def detach(self) -> Self:
        """The same numbers, detached from their derivatives."""
        known = {name: tensor.detach() for name, tensor in self._asdict().items() if isinstance(tensor, Tensor)}
        return self._replace(**known, memory=tuple(tensor.detach() for tensor in self.memory))


class Scales(NamedTuple):
    """Sizes of a filter's quantities on some runs, by which a network's inputs and outputs are scaled.

    They are those of an extended Kalman filter, so that a network begins with numbers of the order of one, and
    with that filter's mean gain.

    Attributes:
        state_mean, state: mean and standard deviation of the true states, (n,).
        moved: root mean square of the change of an estimate over a step, (n,).
        corrected: that of a correction, (n,).
        error: that of an estimate's error, (n,).
        measurement_mean, measurement: mean and standard deviation of measurements, (m,).
        measured: root mean square of the change of a measurement over a step, (m,).
        innovation: that of innovations, (m,).
        input_mean, input: mean and standard deviation of inputs, (p,).
        gain: K (n, m) of the corrections K v that are nearest to the filter's.
    """

    state_mean: np.ndarray
    state: np.ndarray
    moved: np.ndarray
    corrected: np.ndarray
    error: np.ndarray
    measurement_mean: np.ndarray
    measurement: np.ndarray
    measured: np.ndarray
    innovation: np.ndarray
    input_mean: np.ndarray
    input: np.ndarray
    gain: np.ndarray


class LearnedEstimator(nn.Module):
    """An estimator with a network, with the interface of `filters.estimators.Estimator`, in float64.

    A subclass makes its layers in `build` and defines the first step in `begin`, the others in `advance`. If an
    estimate is not finite, its trajectory restarts from the prior.

    Attributes:
        kind: its name.
        needs_model: whether it uses the equations of the model.
        options: their defaults, by name.
        scale_state_mean, ...: the `Scales`.
    """

    kind: ClassVar[str]
    has_covariance: ClassVar[bool] = False
    gaussian_likelihood: ClassVar[bool] = False
    needs_model: ClassVar[bool] = True
    options: ClassVar[dict[str, int]] = {}
    prior_mean: Tensor
    prior_cov: Tensor
    scale_state_mean: Tensor
    scale_state: Tensor
    scale_moved: Tensor
    scale_corrected: Tensor
    scale_error: Tensor
    scale_measurement_mean: Tensor
    scale_measurement: Tensor
    scale_measured: Tensor
    scale_innovation: Tensor
    scale_input_mean: Tensor
    scale_input: Tensor
    scale_gain: Tensor

    def __init__(self, model: StateSpaceModel, scales: Scales | None = None, **options: int):
        """Make an estimator that is not trained.

        Args:
            model: of states, inputs and measurements, with their equations.
            scales: of its quantities; ones and zeros if None, for a file that brings its own.
            **options: in place of the defaults.

        Raises:
            ValueError: for an unknown or wrong option, or a model that it cannot use.
        """
        super().__init__()
        for name in options:
            one_of(f"an option of {self.kind}", name, tuple(self.options))
        self.chosen = {name: at_least(name, value, 2, MOST) for name, value in {**self.options, **options}.items()}
        self.equations = Equations(model)
        self.name = self.kind
        for name, value in (unit_scales(model) if scales is None else scales)._asdict().items():
            self.register_buffer(f"scale_{name}", torch.tensor(value, dtype=torch.float64))
        self.register_buffer("prior_mean", torch.tensor(model.prior_mean, dtype=torch.float64))
        self.register_buffer("prior_cov", torch.tensor(model.prior_cov, dtype=torch.float64))
        self.build()
        self.double()
        self._track: Track | None = None

    def build(self) -> None:
        """Make the layers, with the options that are `chosen`."""
        raise NotImplementedError

    def begin(self, keys: np.ndarray, z: Tensor) -> Track:
        """The estimates at the first measurements z (B, m), NaN where missing; keys (B, 2) of random numbers."""
        raise NotImplementedError

    def advance(self, track: Track, u: Tensor, z: Tensor) -> Track:
        """The estimates a step later, after inputs u (B, p) and measurements z (B, m)."""
        raise NotImplementedError

    @property
    def model(self) -> StateSpaceModel:
        """The model that it assumes."""
        return self.equations.model

    def reset(self, key, z) -> Output:
        """Begin a trajectory with a key and its first measurement (m,)."""
        with torch.no_grad():
            self._track = self.begin(np.array([key]), self._row(z))
        return self._output()

    def step(self, u, z) -> Output:
        """The estimate one step later, after input u (p,) and measurement z (m,), NaN where missing."""
        if self._track is None:
            raise ValueError("step must come after reset, but there was none")
        with torch.no_grad():
            self._track = self.advance(self._track, self._row(u), self._row(z))
        return self._output()

    def run(self, keys: np.ndarray, inputs: np.ndarray, measurements: np.ndarray) -> Output:
        """All estimates of trajectories at once: keys (B, 2), inputs (B, K, p), measurements (B, K + 1, m)."""
        u, z = (torch.tensor(as_floats(array), dtype=torch.float64) for array in (inputs, measurements))
        with torch.no_grad(), one_thread():
            track = self.begin(keys, z[:, 0])
            tracks = [track]
            for k in range(u.shape[1]):
                track = self.advance(track, u[:, k], z[:, k + 1])
                tracks.append(track)
        parts = zip(*(results[:4] for results in tracks), strict=True)
        return Output(*(None if part[0] is None else torch.stack(part, 1).numpy() for part in parts))

    def _row(self, values) -> Tensor:
        return torch.tensor(as_floats(values), dtype=torch.float64)[None]

    def _output(self) -> Output:
        assert self._track is not None
        return Output(*(None if tensor is None else tensor[0].numpy() for tensor in self._track[:4]))


def unit_scales(model: StateSpaceModel) -> Scales:
    """Scales of one about means of zero, and a gain of zero."""
    n, m, p = np.ones(model.n), np.ones(model.m), np.ones(model.inputs)
    return Scales(0 * n, n, n, n, n, 0 * m, m, m, m, 0 * p, p, np.zeros((model.n, model.m)))
