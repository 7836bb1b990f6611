"""`LearnedEstimator`: the base of estimators with a network, and `Equations`, a model on batches of tensors.

The equations hold over whole steps, by machine code with the model's own Jacobians.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache, partial
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from filters.estimators.foreign import Output
from filters.tensors.stages import wrapped_where
from thruster_env.core.checks import as_floats, at_least, one_of
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.derivatives import jacobian
from thruster_env.core.parallel import one_thread
from thruster_env.core.sources import matrix_writer, vector_reader, vector_writer
from thruster_env.logs.log import AnyStepModel
from thruster_env.model.shape import Functions, Shape, constants_reader, number_offsets
from thruster_env.model.state_space import StateSpaceModel, refuse_feed

MOST = 10_000  # members, or hidden states


class Equations:
    """f over a step and h, of states (B, n), inputs (B, p), with derivatives along the states; in float64.

    Angles are in (-pi, pi].
    """

    def __init__(self, model: StateSpaceModel):
        if isinstance(model, AnyStepModel):
            raise ValueError("a learned estimator must have steps of one length, but got a model of any step")
        refuse_feed(model, "the model of a learned estimator")
        self.model = model

    def moved(self, x: Tensor, u: Tensor) -> Tensor:
        """f(x, u) over a whole step, (B, n)."""
        return self.moved_with_jacobian(x, u)[0]

    def moved_with_jacobian(self, x: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        """f(x, u) over a whole step, (B, n), and df/dx, (B, n, n), along which nothing is differentiated."""
        propagated, slopes = _WithSlopes.apply(x, u.numpy(), self._propagate)
        return self.of_state(propagated), slopes

    def measured(self, x: Tensor) -> Tensor:
        """h(x), (B, m)."""
        return self.measured_with_jacobian(x)[0]

    def measured_with_jacobian(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """h(x), (B, m), and dh/dx, (B, m, n), along which nothing is differentiated."""
        return _WithSlopes.apply(x, np.zeros((len(x), self.model.inputs)), self._observe)

    def transition(self, x: tuple[Tensor, ...], u: tuple[Tensor, ...], c: Any) -> tuple[Tensor, ...]:
        """The model's `transition` of components (...), for `filters.torch`."""
        return self._evaluate_components(0, x, u)

    def observe(self, x: tuple[Tensor, ...], c: Any) -> tuple[Tensor, ...]:
        """The model's `observe` of components (...), for `filters.torch`."""
        return self._evaluate_components(1, x, (x[0],) * self.model.inputs)

    def _evaluate_components(self, which: int, x: tuple[Tensor, ...], u: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
        empty = x[0].new_zeros(x[0].numel(), 0)
        rows, inputs = (torch.stack(tuple(a), -1).flatten(0, -2) if len(a) else empty for a in (x, u))
        result = _WithSlopes.apply(rows, inputs.detach().numpy(), partial(self._at, which))[0]
        return result.unflatten(0, x[0].shape).unbind(-1)

    def of_state(self, x: Tensor) -> Tensor:
        """A state or a difference of states, its angles in (-pi, pi]."""
        return wrapped_where(x, self.model.shape.state_angles)

    def of_measurement(self, z: Tensor) -> Tensor:
        """A difference of measurements, its angles in (-pi, pi]."""
        return wrapped_where(z, self.model.shape.measurement_angles)

    def _propagate(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x, jacobian = self._at(0, x, u)
        for _ in range(self.model.substeps - 1):
            x, slopes = self._at(0, x, u)
            jacobian = slopes @ jacobian
        return x, jacobian

    def _observe(self, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return self._at(1, x, u)

    def _at(self, which: int, x: np.ndarray, u: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """The value and the Jacobian of f, in one of its substeps, or of h."""
        rows = (self.model.n, self.model.m)[which]
        out = np.empty((len(x), rows)), np.empty((len(x), rows, self.model.n))
        evaluate = _evaluations(self.model.functions, self.model.shape, is_interpreting())[which]
        evaluate(np.ascontiguousarray(x), np.ascontiguousarray(u), self.model.numbers, *out)
        return out


class _WithSlopes(torch.autograd.Function):
    """A function of states (B, n), with its Jacobian; derivatives go back along the value alone."""

    @staticmethod
    def forward(ctx, x: Tensor, u: np.ndarray, function) -> tuple[Tensor, Tensor]:
        value, slopes = map(torch.from_numpy, function(x.numpy(), u))
        ctx.save_for_backward(slopes)
        ctx.mark_non_differentiable(slopes)
        return value, slopes

    @staticmethod
    @once_differentiable
    def backward(ctx, *gradients: Tensor) -> tuple[Any, ...]:
        (slopes,) = ctx.saved_tensors
        return (gradients[0][:, None, :] @ slopes)[:, 0], None, None


@cache
def _evaluations(functions: Functions, shape: Shape, interpreting: bool) -> tuple[Callable, ...]:
    from thruster_env.graphs.loops import Loops

    n, m, (f, by_f, h, by_h) = shape.n, shape.m, functions
    f_slopes = jacobian(f, by_f, n, n, "u, c", shape.state_angles)
    h_slopes = jacobian(h, by_h, m, n, "c", shape.measurement_angles)
    state, control, constants = vector_reader(n), vector_reader(shape.inputs), constants_reader(shape)
    scales = vector_reader(n, number_offsets(n, m).scales)
    store_state, store_measurement = vector_writer(n), vector_writer(m)
    store_f_slopes, store_h_slopes = matrix_writer(n, n), matrix_writer(m, n)

    def move(x, u, numbers, values, slopes):
        c, size = constants(numbers), scales(numbers)
        for b in range(x.shape[0]):
            at, v = state(x[b]), control(u[b])
            store_state(values[b], f(at, v, c))
            store_f_slopes(slopes[b].reshape(-1), f_slopes(at, size, v, c))

    def measure(x, u, numbers, values, slopes):
        c, size = constants(numbers), scales(numbers)
        for b in range(x.shape[0]):
            at = state(x[b])
            store_measurement(values[b], h(at, c))
            store_h_slopes(slopes[b].reshape(-1), h_slopes(at, size, c))

    arguments = (None, n), (None, shape.inputs), (None,)
    of_rows = [((None, rows), (None, rows, n)) for rows in (n, m)]
    return tuple(Loops(work, (*arguments, *out)) for work, out in zip((move, measure), of_rows, strict=True))


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
