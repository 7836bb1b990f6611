"""Learning a policy on filtered state: our vector env with its batched filter against single envs side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from benchmarks.timing import Measure, Row, alone, side_by_side
from tuning.plants.thruster import find_scenario
from tuning.policies.setup import TrainingConfiguration
from tuning.problems.data import training_seeds

if TYPE_CHECKING:
    from tuning.policies.setup import TrainingConfiguration

NETWORKS = 2  # one of the action, one of the value, which is a single number, too
PASSES = 3  # through them in a step of gradient descent: the output, then slopes over weights and over inputs
COPIES = 64
GOAL = 0.60  # of the time that Stable-Baselines3 by itself takes
ACTING_GOAL = 0.12  # of the time that the envs alone take with DummyVecEnv


def training(setup: TrainingConfiguration, native: bool, rollouts: int) -> Measure:
    """Seconds a step of a short training, as `thruster train` learns."""
    from tuning.policies.environments import make_environments
    from tuning.policies.learn import learning, new_model

    model = new_model(setup, make_environments(setup, training_seeds(setup.seed, setup.num_envs), native=native))
    return _steps_of(model, lambda: learning(model), rollouts)


def by_hand(setup: TrainingConfiguration, rollouts: int) -> Measure:
    """The same by Stable-Baselines3 as its documentation has it: single envs one by one, VecNormalize, PPO.

    torch has one thread here, too.
    """
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    from thruster_env.core.parallel import one_thread
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


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    rounds, rollouts = (1, 1) if quick else (9, 2)
    setup = _setup("ekf", seed)
    ours, one_by_one = (training(setup, native, rollouts) for native in (True, False))
    peer = by_hand(setup, rollouts)
    timing = side_by_side(ours, peer, rounds)
    yield Row(
        f"a step of PPO on an EKF, {COPIES} copies",
        "Stable-Baselines3, DummyVecEnv",
        timing,
        ratio_goal=GOAL,
    )
    timing = side_by_side(ours, one_by_one, rounds)
    yield Row("the same, all but the VecEnv equal", "DummyVecEnv", timing)
    stepping = side_by_side(*(acting(seed, "ekf", native) for native in (True, False)), rounds)
    yield Row("of it env and EKF", "DummyVecEnv", stepping, ratio_goal=ACTING_GOAL)
    yield Row("of it env alone", None, alone(acting(seed, "raw", True), rounds))


def acting(seed: int, observe: str, native: bool, steps: int = 200) -> Measure:
    """Seconds a copy and step of the envs alone."""
    from tuning.policies.environments import make_environments

    envs = make_environments(_setup(observe, seed), training_seeds(seed, COPIES), native=native)
    actions = np.random.default_rng(seed).uniform(-1, 1, (steps, COPIES, 1)).astype(np.float32)

    def measure() -> float:
        envs.reset()
        begin = perf_counter()
        for action in actions:
            envs.step(action)
        return (perf_counter() - begin) / (steps * COPIES)

    return measure


def _setup(observe: str, seed: int):
    from tuning.policies.setup import make_configuration

    return make_configuration("manoeuvre", find_scenario("medium_noise"), observe, seed=seed, num_envs=COPIES)
