"""Algorithms of Stable-Baselines3 by name, with hyperparameters that suit the thruster.

The voltage sets the thrust of the next step, and a controller with a horizon of one step is as good as one with a
longer horizon (docs/policies.md). So a short horizon (gamma 0.5) suffices, and returns are less noisy.
`hyperparams/` has the same hyperparameters for rl_zoo3.

The packages for learning policies, which are not in a plain installation.

Settings of torch while a policy learns: the fastest for such small networks on a CPU.

torch's comes from Intel's library, and takes ten times as long on an AMD: longer than a layer's product.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Generator, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.type_aliases import RolloutBufferSamples
from torch import Tensor, nn
from torch.distributions import Distribution

from thruster_env.core.checks import one_of
from thruster_env.core.modules import to_install
from thruster_env.core.threads import PASSIVE, one_thread, waiting

NEEDED = ("torch", "stable_baselines3", "sb3_contrib")


def check_installed() -> None:
    """Raise ValueError, with the command to install it, unless the extra `rl` is installed."""
    for package in NEEDED:
        if importlib.util.find_spec(package) is None:
            raise ValueError(f"policies need {package}, which is not installed: {to_install('rl')}")


PPO_STEPS = 98 * 64 * 64  # complete rollouts of 64 steps of 64 copies: the learning rate ends at zero
LAYERS = {"net_arch": [64, 64, 64]}
ON_POLICY = {"gamma": 0.5, "gae_lambda": 0.9, "n_epochs": 5, "policy_kwargs": {**LAYERS, "log_std_init": -1.0}}
OFF_POLICY = {
    "gamma": 0.5,
    "learning_rate": 1e-3,
    "batch_size": 256,
    "buffer_size": 200_000,
    "learning_starts": 2_000,
    "train_freq": 1,
    "gradient_steps": 8,
    "policy_kwargs": LAYERS,
}

# Hyperparameters that may be given, all plain data: neither output paths nor classes or functions.
HYPERPARAMETERS = (
    *("learning_rate", "gamma", "gae_lambda", "n_steps", "n_epochs", "batch_size", "policy_kwargs", "noise_std"),
    *("clip_range", "clip_range_vf", "normalize_advantage", "ent_coef", "vf_coef", "max_grad_norm", "target_kl"),
    *("use_sde", "sde_sample_freq", "use_sde_at_warmup", "buffer_size", "learning_starts", "tau", "train_freq"),
    *("gradient_steps", "target_update_interval", "target_entropy", "policy_delay", "stats_window_size"),
    *("target_policy_noise", "target_noise_clip", "optimize_memory_usage"),
)
POLICY_ARGUMENTS = (
    *(
        "net_arch",
        "log_std_init",
        "ortho_init",
        "full_std",
        "use_expln",
        "squash_output",
        "n_critics",
    ),
    *("share_features_extractor", "lstm_hidden_size", "n_lstm_layers", "shared_lstm", "enable_critic_lstm"),
)


class Algorithm(NamedTuple):
    """An algorithm and its defaults."""

    about: str
    module: str
    policy: str
    steps: int
    num_envs: int
    hyperparameters: Mapping  # learning_rate: the initial one; it falls linearly to zero

    @property
    def name(self) -> str:
        """Name of its class."""
        return self.module.partition(":")[2]

    def load_class(self):
        """The class itself; raises ValueError if the extra `rl` is not installed."""
        check_installed()
        module, _, name = self.module.partition(":")
        return getattr(importlib.import_module(module), name)


ALGORITHMS: dict[str, Algorithm] = {
    "ppo": Algorithm(
        "proximal policy optimisation, on-policy; the shortest training time",
        "stable_baselines3:PPO",
        "MlpPolicy",
        PPO_STEPS,
        64,
        {**ON_POLICY, "n_steps": 64, "batch_size": 256, "learning_rate": 1e-3},
    ),
    "sac": Algorithm(
        "soft actor-critic, off-policy; few steps, but each one is slow",
        "stable_baselines3:SAC",
        "MlpPolicy",
        40_000,
        16,
        OFF_POLICY,
    ),
    "td3": Algorithm(
        "twin delayed deep deterministic policy gradient, off-policy",
        "stable_baselines3:TD3",
        "MlpPolicy",
        40_000,
        16,
        {**OFF_POLICY, "noise_std": 0.1},  # of actions: its only exploration
    ),
    "recurrent-ppo": Algorithm(
        "PPO with an LSTM, which can learn its own filter; very slow",
        "sb3_contrib:RecurrentPPO",
        "MlpLstmPolicy",
        PPO_STEPS,
        64,
        {
            **ON_POLICY,
            "n_steps": 64,
            "batch_size": 512,
            "learning_rate": 1e-3,
            "policy_kwargs": {"net_arch": [64], "log_std_init": -1.0, "lstm_hidden_size": 32},
        },
    ),
}


def find_algorithm(name: str) -> Algorithm:
    """The algorithm of a name; raises ValueError for an unknown one."""
    return ALGORITHMS[one_of("algo", name, tuple(ALGORITHMS))]


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
