"""A short training by PPO: as `thruster train` learns, and by Stable-Baselines3 as its documentation has it."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from time import perf_counter
from typing import TYPE_CHECKING

from benchmarks.timing import Measure
from tuning.problems.seeds import training_seeds

if TYPE_CHECKING:
    from tuning.policies.setup import TrainingConfiguration


def training(setup: TrainingConfiguration, native: bool, rollouts: int) -> Measure:
    """Seconds a step of a short training, as `thruster train` learns."""
    from tuning.policies.environments import make_environments
    from tuning.policies.model import new_model
    from tuning.policies.torch_settings import learning

    model = new_model(setup, make_environments(setup, training_seeds(setup.seed, setup.num_envs), native=native))
    return _steps_of(model, lambda: learning(model), rollouts)


def by_hand(setup: TrainingConfiguration, rollouts: int) -> Measure:
    """The same by Stable-Baselines3 as its documentation has it: single envs one by one, VecNormalize, PPO.

    torch has one thread here, too.
    """
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    from thruster_env.core.threads import one_thread
    from tuning.policies.environments import make_environments

    numbers = dict(setup.hyperparameters)
    envs = VecNormalize(
        make_environments(setup, training_seeds(setup.seed, setup.num_envs), native=False), gamma=numbers["gamma"]
    )
    return _steps_of(PPO("MlpPolicy", envs, seed=setup.seed, device="cpu", **numbers), one_thread, rollouts)


def _steps_of(model, settings: Callable[[], AbstractContextManager], rollouts: int) -> Measure:
    steps = rollouts * model.n_envs * model.n_steps

    def measure() -> float:
        with settings():
            begin = perf_counter()
            model.learn(steps)
            return (perf_counter() - begin) / steps

    return measure
