"""Settings of torch while a policy learns: the fastest for such small networks on a CPU.

torch's comes from Intel's library, and takes ten times as long on an AMD: longer than a layer's product.
"""

from __future__ import annotations

from collections.abc import Generator, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from torch import Tensor, nn
from torch.distributions import Distribution

from thruster_env.core.threads import PASSIVE, one_thread, waiting

# `EpochBuffer`: rollouts that are put into random order once an epoch, and handed out as views.


class EpochBuffer(RolloutBuffer):
    """A `RolloutBuffer` with the same minibatches, to the bit, in a third of the time.

    Stable-Baselines3 gathers and copies six arrays for each minibatch. Here all samples of an epoch are gathered
    at once, in the same random order, and a minibatch is a part of that.
    """

    def get(self, batch_size: int | None = None) -> Generator[RolloutBufferSamples, None, None]:
        """The minibatches of one epoch; all samples in one without `batch_size`."""
        (epoch,) = super().get()
        size = len(epoch.actions) if batch_size is None else int(batch_size)  # torch refuses NumPy's integers
        for parts in zip(*(tensor.split(size) for tensor in epoch), strict=True):
            yield RolloutBufferSamples(*parts)


@contextmanager
def epoch_minibatches(model: BaseAlgorithm) -> Iterator[None]:
    """Within this context a model with a `RolloutBuffer` has an `EpochBuffer` in its place."""
    holder: Any = model
    before = getattr(holder, "rollout_buffer", None)
    if type(before) is not RolloutBuffer:
        yield
        return
    names = ("buffer_size", "observation_space", "action_space", "device", "gae_lambda", "gamma", "n_envs")
    holder.rollout_buffer = EpochBuffer(**{name: getattr(before, name) for name in names})
    try:
        yield
    finally:
        holder.rollout_buffer = before


# tanh, the activation of a policy's hidden layers, by NumPy, whose vector code serves processors of all makers.


TAKEN = torch.float32, torch.float64


class _Tanh(torch.autograd.Function):
    """y = tanh(x), dy/dx = 1 - y^2."""

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        y = _evaluate(x)
        ctx.save_for_backward(y)
        return y

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (y,) = ctx.saved_tensors
        return torch.ops.aten.tanh_backward(gradient, y)


class NumpyTanh(nn.Module):
    """tanh(x), equal to `torch.nn.Tanh` except for rounding; torch's own for types that NumPy does not have."""

    def forward(self, x: Tensor) -> Tensor:
        """Return tanh(x)."""
        if x.dtype not in TAKEN or not x.is_cpu or not x.ndim:
            return torch.tanh(x)
        return _Tanh.apply(x) if x.requires_grad else _evaluate(x)


def _evaluate(x: Tensor) -> Tensor:
    return torch.from_numpy(np.tanh(x.detach().numpy()))


@contextmanager
def numpys_tanh(network: nn.Module) -> Iterator[None]:
    """Within this context each `torch.nn.Tanh` of a network is NumPy's; saved files do not record it."""
    activations = [
        (parent, name, child)
        for parent in network.modules()
        for name, child in parent.named_children()
        if type(child) is nn.Tanh
    ]
    quick = NumpyTanh()
    try:
        for parent, name, _ in activations:
            setattr(parent, name, quick)
        yield
    finally:
        for parent, name, child in activations:
            setattr(parent, name, child)


@contextmanager
def unchecked_distributions() -> Iterator[None]:
    """Within this context distributions do not look for NaN in every argument.

    A policy that has become NaN is still noticed, in the same step: the envs refuse its actions.
    """
    before = Distribution._validate_args
    Distribution.set_default_validate_args(False)
    try:
        yield
    finally:
        Distribution.set_default_validate_args(before)


def fuse_optimizers(model: BaseAlgorithm) -> None:
    """Have each Adam optimizer of a model update all parameters in one call, equal to rounding.

    Stable-Baselines3 leaves torch's default, a dozen calls for each parameter, which take longer than the numbers.
    """
    parameters: Any = model.get_parameters()  # that of optimizers, too, of which its annotation does not know
    for state in parameters.values():
        for group in state.get("param_groups", ()):
            group["fused"] = True
    model.set_parameters(parameters)


@contextmanager
def learning(model: BaseAlgorithm) -> Iterator[None]:
    """Within this context a model of Stable-Baselines3 learns as quickly as it can on one core.

    The result is the same except for rounding, of its optimizers and of tanh. torch has one thread and checks no
    arguments of distributions, minibatches are parts of an epoch's samples, and worker threads of vector envs
    sleep while torch works.

    Args:
        model: on the CPU.
    """
    fuse_optimizers(model)
    with (
        waiting(PASSIVE),
        one_thread(),
        unchecked_distributions(),
        epoch_minibatches(model),
        numpys_tanh(model.policy),
    ):
        yield
