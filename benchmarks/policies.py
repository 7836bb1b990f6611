"""Learning a policy on filtered state: our vector env with its batched filter against single envs side by side."""

from __future__ import annotations

from collections.abc import Iterator
from time import perf_counter

import gymnasium as gym
import numpy as np

from benchmarks.learning import by_hand, training
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
    setup = _setup("ekf", seed)
    ours, one_by_one = (training(setup, native, rollouts) for native in (True, False))
    peer = by_hand(setup, rollouts)
    timing = side_by_side(ours, peer, rounds)
    env, limit = gym.make("filters:BowThruster-EKF-v0"), network_limit(setup)
    yield Row(
        f"a step of PPO on an EKF, {COPIES} copies",
        "Stable-Baselines3, DummyVecEnv",
        timing,
        ratio_goal=GOAL,
        limit=limit,
    )
    timing = side_by_side(ours, one_by_one, rounds)
    yield Row("the same, all but the VecEnv equal", "DummyVecEnv", timing, limit=limit)
    stepping = side_by_side(*(acting(seed, "ekf", native) for native in (True, False)), rounds)
    limit = arithmetic_limit(step_of_filtered(env))
    yield Row("of it env and EKF", "DummyVecEnv", stepping, ratio_goal=ACTING_GOAL, limit=limit)
    limit = arithmetic_limit(step_of_env(env))
    yield Row("of it env alone", None, alone(acting(seed, "raw", True), rounds), limit=limit)


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
