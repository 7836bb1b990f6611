"""Classical policies for the same table: PI on raw or estimated thrust, LQG with each estimator, LQR.

Each observes what an arm of `training.arms` does, so it stands beside the policy that learnt on that arm.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product

import numpy as np

from thruster_env.checks import one_of
from thruster_env.control import LQRController, PIController
from training.arms import find_arm
from training.environments import make_single
from training.score import score
from training.setup import Setup
from tuning.scenarios import training_seeds

CONTROLLERS = ("pi", "lqr")
GAINS = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0)  # factors on the gains of `gains.lambda_gains`, tried for each arm
GAIN_SEEDS = 16


@dataclass(frozen=True)
class ClassicalPolicy:
    """A controller of `thruster_env.control` with the observations and actions of learnt policies."""

    controller: PIController | LQRController
    skipped: int  # entries in front of what the controller reads
    max_voltage: float

    def predict(self, observation, state=None, episode_start=None, deterministic: bool = True):
        """Actions (n, 1) in [-1, 1] for observations (n, d), and what the controller remembers."""
        seen = np.asarray(observation)[..., self.skipped :]
        voltage, state = self.controller.predict(seen, state, episode_start)
        return voltage / self.max_voltage, state


def lqr(setup: Setup) -> ClassicalPolicy:
    """LQR on the true state, or on an estimate: certainty equivalence, so LQG.

    Raises:
        ValueError: if the setup observes no state.
    """
    if not find_arm(setup.observe).shows_state:
        raise ValueError(f"LQR must observe a state, but got observe={setup.observe!r}")
    env = make_single(setup)
    return ClassicalPolicy(LQRController.for_env(env), 1, env.unwrapped.plant.max_voltage)


def pi(setup: Setup) -> ClassicalPolicy:
    """PI with feed-forward on the thrust that an arm shows, with the gains that suit the arm best.

    Factors `GAINS` on both gains of `lambda_gains` are tried on training seeds; the highest mean return wins.
    """
    env = make_single(setup)
    usual, top = PIController.for_env(env), env.unwrapped.plant.max_voltage
    tried = np.array(list(product(GAINS, GAINS))) * [usual.proportional_gain, usual.integral_gain]
    # All pairs of gains at once, each on copies of its own: the controller takes arrays as it takes numbers.
    each = np.repeat(tried, GAIN_SEEDS, axis=0).T
    seeds = list(training_seeds(setup.seed, GAIN_SEEDS)) * len(tried)
    returns = score(ClassicalPolicy(_with_gains(usual, *each), 0, top), setup, seeds).returns
    best = tried[returns.reshape(len(tried), GAIN_SEEDS).mean(axis=1).argmax()]
    return ClassicalPolicy(_with_gains(usual, *best.tolist()), 0, top)


def _with_gains(controller: PIController, proportional, integral) -> PIController:
    return replace(controller, proportional_gain=proportional, integral_gain=integral)


def classical_policy(name: str, setup: Setup) -> ClassicalPolicy:
    """A classical policy by the name of its controller; raises ValueError for an unknown one."""
    return {"pi": pi, "lqr": lqr}[one_of("controller", name, CONTROLLERS)](setup)
