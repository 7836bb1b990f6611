"""Algorithms of Stable-Baselines3 by name, with hyperparameters that suit the thruster.

The voltage sets the thrust of the next step, and a controller with a horizon of one step is as good as one with a
longer horizon (docs/policies.md). So a short horizon (gamma 0.5) suffices, and returns are less noisy.
`hyperparams/` has the same hyperparameters for rl_zoo3.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import one_of
from thruster_env.core.modules import to_install

if TYPE_CHECKING:
    from tuning.policies.controllers import ClassicalPolicy


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
NEEDED = ("torch", "stable_baselines3", "sb3_contrib")


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


def check_installed() -> None:
    """Raise ValueError, with the command to install it, unless the extra `rl` is installed."""
    for package in NEEDED:
        if importlib.util.find_spec(package) is None:
            raise ValueError(f"policies need {package}, which is not installed: {to_install('rl')}")


# Observation sets: the choices of a policy's observation.
#
# Every observation ends with the reference of the next step. What comes before it is, in float32,
#
# | observation set | entries | |---|---| | raw | measured thrust | | raw+action | measured thrust, the last
# voltage | | stack | the last 8 measured thrusts, each with the voltage before it, latest first | | lowpass, kf,
# ekf, ukf, enkf | thrust of the estimate, estimate of omega_m and U_a | | belief | the same of the enkf, then two
# standard deviations | | true | true thrust, omega_m and U_a |
#
# Thrust is a nonlinear function of the state, and the reward compares it with the reference. Raw observations
# contain thrust, so estimates have it added: no policy has to learn the equation of the propeller.


STACKED = 8
MEMBERS = MappingProxyType({"ensemble_size": 50})

# Returns (copies, episodes) of so many copies of a policy, stepped side by side, on the same training seeds.
TrainingReturns = Callable[["ClassicalPolicy", int, int], np.ndarray]


class ObservationSet(NamedTuple):
    """What a policy observes."""

    about: str
    filter: str | None = None  # name in `filters.FILTERS`
    numbers: Mapping = MappingProxyType({})  # default parameters of the filter
    form: str = "estimate"  # as of `filters.EstimateState`
    is_true: bool = False  # whether it is the true state
    pairs: int = 0  # number of last measurements, each with the voltage before it

    @property
    def shows_state(self) -> bool:
        """Whether the observation begins with a state, estimated or true."""
        return self.is_true or self.filter is not None


OBSERVATION_SETS: dict[str, ObservationSet] = {
    "raw": ObservationSet("the measured thrust"),
    "raw+action": ObservationSet("the measured thrust and the last voltage", pairs=1),
    "stack": ObservationSet(f"the last {STACKED} measured thrusts and voltages", pairs=STACKED),
    "lowpass": ObservationSet("the low-passed thrust, and the state that belongs to it", "low-pass"),
    "kf": ObservationSet("the estimate of a Kalman filter", "kf"),
    "ekf": ObservationSet("the estimate of an extended Kalman filter", "ekf"),
    "ukf": ObservationSet("the estimate of an unscented Kalman filter", "ukf"),
    "enkf": ObservationSet("the estimate of an ensemble Kalman filter", "enkf", MEMBERS),
    "belief": ObservationSet("the enkf's estimate with its standard deviations", "enkf", MEMBERS, form="belief"),
    "true": ObservationSet("the true state", is_true=True),
}


def find_observation_set(name: str) -> ObservationSet:
    """The observation set of a name; raises ValueError for an unknown one."""
    return OBSERVATION_SETS[one_of("observe", name, tuple(OBSERVATION_SETS))]


def box_of(space: gym.Space) -> gym.spaces.Box:
    """The same space; ValueError unless it is a Box, for policies observe and act in boxes only."""
    if not isinstance(space, gym.spaces.Box):
        raise ValueError(f"a space must be a Box, but got {space}")
    return space


def size_of(space: gym.Space) -> int:
    """Number of entries of a Box with one axis."""
    return box_of(space).shape[0]
