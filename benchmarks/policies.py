"""Learning a policy on filtered state: our vector env with its batched filter against single envs side by side."""

from __future__ import annotations

from collections.abc import Iterator
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
GOAL, ACTING_GOAL = 0.6, 0.12  # of the time that PPO, or the envs alone, take with DummyVecEnv


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    rounds, rollouts = (1, 1) if quick else (9, 2)
    ours, peer = (learning(seed, native, rollouts) for native in (True, False))
    timing = side_by_side(ours, peer, rounds)
    env = gym.make("filters:BowThruster-EKF-v0")
    limit = network_limit(_setup("ekf", seed))
    yield Row(f"a step of PPO on an EKF, {COPIES} copies", "DummyVecEnv", timing, ratio_goal=GOAL, limit=limit)
    stepping = side_by_side(*(acting(seed, "ekf", native) for native in (True, False)), rounds)
    limit = arithmetic_limit(step_of_filtered(env))
    yield Row("of it env and EKF", "DummyVecEnv", stepping, ratio_goal=ACTING_GOAL, limit=limit)
    limit = arithmetic_limit(step_of_env(env))
    yield Row("of it env alone", None, alone(acting(seed, "raw", True), rounds), limit=limit)


def learning(seed: int, native: bool, rollouts: int) -> Measure:
    """Seconds a step of a short training."""
    from stable_baselines3.common.vec_env import VecNormalize

    from training.algorithms import find_algorithm
    from training.environments import make_environments
    from training.learn import one_thread

    setup = _setup("ekf", seed)
    numbers = dict(setup.hyperparameters)
    steps = rollouts * COPIES * numbers["n_steps"]
    envs = VecNormalize(make_environments(setup, training_seeds(seed, COPIES), native=native))
    algorithm = find_algorithm("ppo")
    model = algorithm.load_class()(algorithm.policy, envs, seed=seed, device="cpu", **numbers)

    def measure() -> float:
        with one_thread():
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
