"""A model's equations over whole steps, on batches of tensors, by machine code with the model's own Jacobians."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from filters.tensors.stages import wrapped_where
from thruster_env.core.compiled import CompiledOrPython, function_fingerprint, is_interpreting
from thruster_env.core.derivatives import jacobian
from thruster_env.core.sources import matrix_writer, vector_reader, vector_writer
from thruster_env.logs.steps import AnyStepModel
from thruster_env.model.shape import Functions, Shape, constants_reader, number_places
from thruster_env.model.state_space import StateSpaceModel


class Equations:
    """f over a step and h, of states (B, n), inputs (B, p), with derivatives along the states; in float64.

    Angles are in (-pi, pi].
    """

    def __init__(self, model: StateSpaceModel):
        if isinstance(model, AnyStepModel):
            raise ValueError("a learned estimator must have steps of one length, but got a model of any step")
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
def _evaluations(functions: Functions, shape: Shape, interpreting: bool) -> tuple[CompiledOrPython, ...]:
    n, m, (f, by_f, h, by_h) = shape.n, shape.m, functions
    f_slopes = jacobian(f, by_f, n, n, "u, c", shape.state_angles)
    h_slopes = jacobian(h, by_h, m, n, "c", shape.measurement_angles)
    state, control, constants = vector_reader(n), vector_reader(shape.inputs), constants_reader(shape)
    scales = vector_reader(n, number_places(n, m).scales)
    store_state, store_measurement = vector_writer(n), vector_writer(m)
    store_f_slopes, store_h_slopes = matrix_writer(n, n), matrix_writer(m, n)
    fingerprint = function_fingerprint(f, f_slopes, h, h_slopes, within=__name__)

    def move(x, u, numbers, values, slopes):
        fingerprint  # noqa: B018 - part of the cache's key
        c, size = constants(numbers), scales(numbers)
        for b in range(x.shape[0]):
            at, v = state(x[b]), control(u[b])
            store_state(values[b], f(at, v, c))
            store_f_slopes(slopes[b].reshape(-1), f_slopes(at, size, v, c))

    def measure(x, u, numbers, values, slopes):
        fingerprint  # noqa: B018 - part of the cache's key
        c, size = constants(numbers), scales(numbers)
        for b in range(x.shape[0]):
            at = state(x[b])
            store_measurement(values[b], h(at, c))
            store_h_slopes(slopes[b].reshape(-1), h_slopes(at, size, c))

    return CompiledOrPython(move), CompiledOrPython(measure)
