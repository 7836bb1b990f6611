"""Learning a policy on filtered state: our vector env with its batched filter against single envs side by side."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter

import gymnasium as gym
import numpy as np

from benchmarks.rates import arithmetic_limit
from benchmarks.rows import Row
from benchmarks.timing import Measure, alone, seconds_a_call, side_by_side
from benchmarks.workloads import step_of_env, step_of_filtered
from numerics.threads import cores
from tuning.problems.seeds import training_seeds
from tuning.thruster.find import find_scenario

COPIES = 64
GOAL, ACTING_GOAL = 0.6, 0.12  # of the time that PPO, or the envs alone, take with DummyVecEnv
PASSES = 3  # of the network in a step of gradient descent: its output, and slopes over weights and over inputs


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    rounds, rollouts = (1, 1) if quick else (9, 2)
    ours, peer = (ppo(seed, native) for native in (True, False))
    timing = side_by_side(learning(ours, rollouts), learning(peer, rollouts), rounds)
    what, limit = f"a step of PPO on an EKF, {COPIES} copies", network_limit(ours)
    yield Row(what, "DummyVecEnv", timing, ratio_goal=GOAL, limit=limit)
    stepping = side_by_side(*(acting(seed, "ekf", native) for native in (True, False)), rounds)
    env = gym.make("filters:BowThruster-EKF-v0")
    limit = arithmetic_limit(step_of_filtered(env), cores=cores())
    yield Row("of it env and EKF", "DummyVecEnv", stepping, ratio_goal=ACTING_GOAL, limit=limit)
    limit = arithmetic_limit(step_of_env(env), cores=cores())
    yield Row("of it env alone", None, alone(acting(seed, "raw", True), rounds), limit=limit)


def ppo(seed: int, native: bool):
    """The algorithm with its envs, before it learns."""
    from stable_baselines3.common.vec_env import VecNormalize

    from training.algorithms import find_algorithm
    from training.environments import make_environments

    setup = _setup("ekf", seed)
    envs = VecNormalize(make_environments(setup, training_seeds(seed, COPIES), native=native))
    algorithm = find_algorithm("ppo")
    return algorithm.load_class()(algorithm.policy, envs, seed=seed, device="cpu", **dict(setup.hyperparameters))


def learning(model, rollouts: int) -> Measure:
    """Seconds a step of a short training."""
    from training.learn import one_thread

    steps = rollouts * COPIES * model.n_steps

    def measure() -> float:
        with one_thread():
            begin = perf_counter()
            model.learn(steps)
            return (perf_counter() - begin) / steps

    return measure


def network_limit(model) -> float:
    """Seconds a step of the products with the networks' weights alone, at torch's rate in one thread."""
    import torch

    from training.learn import one_thread

    layers = [layer for layer in model.policy.modules() if isinstance(layer, torch.nn.Linear)]
    width = max(layer.out_features for layer in layers)
    batch, weights = torch.ones(model.batch_size, width), torch.ones(width, width)
    multiply = seconds_a_call(torch.mm, 50 * [(batch, weights)])
    with one_thread(), torch.no_grad():
        seconds = alone(multiply, 100).ours / (batch.numel() * width)
    return seconds * sum(layer.weight.numel() for layer in layers) * (1 + PASSES * model.n_epochs)


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
