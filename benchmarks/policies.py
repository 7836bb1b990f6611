"""Learning a policy on filtered state: our vector env with its batched filter against single envs side by side."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from time import perf_counter

import gymnasium as gym
import numpy as np

from benchmarks.networks import network_limit
from benchmarks.rates import arithmetic_limit
from benchmarks.rows import Row
from benchmarks.timing import Measure, alone, side_by_side
from benchmarks.workloads import step_of_env, step_of_filtered
from tuning.problems.seeds import training_seeds
from tuning.thruster.find import find_scenario

COPIES = 64
GOAL = 0.60  # of the time that Stable-Baselines3 by itself takes
ACTING_GOAL = 0.12  # of the time that the envs alone take with DummyVecEnv


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    rounds, rollouts = (1, 1) if quick else (9, 2)
    ours, one_by_one, peer = (
        training(seed, True, rollouts),
        training(seed, False, rollouts),
        by_hand(seed, rollouts),
    )
    timing = side_by_side(ours, peer, rounds)
    env = gym.make("filters:BowThruster-EKF-v0")
    limit = network_limit(_setup("ekf", seed))
    yield Row(
        f"a step of PPO on an EKF, {COPIES} copies", "Stable-Baselines3", timing, ratio_goal=GOAL, limit=limit
    )
    timing = side_by_side(ours, one_by_one, rounds)
    yield Row("the same, all but the VecEnv equal", "DummyVecEnv", timing, limit=limit)
    stepping = side_by_side(*(acting(seed, "ekf", native) for native in (True, False)), rounds)
    limit = arithmetic_limit(step_of_filtered(env))
    yield Row("of it env and EKF", "DummyVecEnv", stepping, ratio_goal=ACTING_GOAL, limit=limit)
    limit = arithmetic_limit(step_of_env(env))
    yield Row("of it env alone", None, alone(acting(seed, "raw", True), rounds), limit=limit)


def training(seed: int, native: bool, rollouts: int) -> Measure:
    """Seconds a step of a short training, as `thruster train` learns."""
    from training.environments import make_environments
    from training.model import new_model
    from training.torch_settings import learning

    setup = _setup("ekf", seed)
    model = new_model(setup, make_environments(setup, training_seeds(seed, COPIES), native=native))
    return _steps_of(model, lambda: learning(model), rollouts)


def by_hand(seed: int, rollouts: int) -> Measure:
    """The same by Stable-Baselines3 as its documentation has it: single envs one by one, VecNormalize, PPO.

    torch has one thread here, too.
    """
    from stable_baselines3 import PPO
    from stable_baselines3.common.vec_env import VecNormalize

    from training.environments import make_environments
    from training.torch_settings import one_thread

    setup = _setup("ekf", seed)
    numbers = dict(setup.hyperparameters)
    envs = VecNormalize(
        make_environments(setup, training_seeds(seed, COPIES), native=False), gamma=numbers["gamma"]
    )
    return _steps_of(PPO("MlpPolicy", envs, seed=seed, device="cpu", **numbers), one_thread, rollouts)


def _steps_of(model, settings: Callable, rollouts: int) -> Measure:
    steps = rollouts * COPIES * model.n_steps

    def measure() -> float:
        with settings():
            begin = perf_counter()
            model.learn(steps)
            return (perf_counter() - begin) / steps

    return measure


def acting(seed: int, observe: str, native: bool, steps: int = 200) -> Measure:
    """Seconds a copy and step of the envs alone."""
    from training.environments import make_environments

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
    from training.setup import make_configuration

    return make_configuration("manoeuvre", find_scenario("medium_noise"), observe, seed=seed, num_envs=COPIES)
