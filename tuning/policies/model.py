"""The model of Stable-Baselines3 that a training configuration asks for."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from tuning.policies.algorithms import find_algorithm
from tuning.policies.setup import TrainingConfiguration


def new_model(setup: TrainingConfiguration, envs: VecEnv, tensorboard: Path | None = None) -> BaseAlgorithm:
    """A model that has learnt nothing yet, with its envs normalised.

    Args:
        setup: the training configuration.
        envs: from `make_environments`.
        tensorboard: folder of TensorBoard's files; no files without one.
    """
    algorithm = find_algorithm(setup.algo)
    kind = algorithm.load_class()
    numbers: dict[str, Any] = deepcopy(dict(setup.hyperparameters))  # off-policy ones write into policy_kwargs
    rate = numbers["learning_rate"]
    # The last rollout may exceed the requested steps: `remaining` is then negative.
    numbers["learning_rate"] = lambda remaining: rate * max(remaining, 0.0)
    if "noise_std" in numbers:
        deviation = numbers.pop("noise_std")
        numbers["action_noise"] = NormalActionNoise(np.zeros(1), np.full(1, deviation))
    normalised = VecNormalize(envs, gamma=numbers["gamma"])
    log = None if tensorboard is None else str(tensorboard)
    return kind(algorithm.policy, normalised, seed=setup.seed, tensorboard_log=log, device="cpu", **numbers)
