"""Classical controllers as policies: PI, LQR, LQG and predictive ones.

They use the observation sets of `tuning.policies.algorithms`, so they can be compared with learnt policies.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Protocol

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import one_of
from thruster_env.thruster.controllers import HORIZONS, LQRController, PIController, PredictiveController
from thruster_env.thruster.dynamics import Constants
from tuning.policies.algorithms import TrainingReturns

# Factors on the gains of `gains.lambda_gains`, tried for each observation set.
GAINS = (0.5, 1.0, 2.0, 3.0, 4.0, 6.0)
GAIN_SEEDS = 16


class Controller(Protocol):
    """A controller that acts on observations (n, d) of the env, in the units of its inputs."""

    def predict(self, observation, state=None, episode_start=None):
        """Inputs (n, p), and the controller's state."""


@dataclass(frozen=True)
class ClassicalPolicy:
    """A controller of a plant with the observations and actions of learnt policies."""

    controller: Controller
    skipped: int  # entries before those that the controller reads
    half: float | np.ndarray  # half of the range of each input, in its unit: the voltage's is max_voltage ...
    middle: float | np.ndarray = 0.0  # ... about this
    keeps_input: bool = False  # whether its state begins with its last input

    def predict(self, observation, state=None, episode_start=None, deterministic: bool = True):
        """Actions (n, p) in [-1, 1] for observations (n, d), and the controller's state."""
        observed = np.asarray(observation)[..., self.skipped :]
        inputs, state = self.controller.predict(observed, state, episode_start)
        return (inputs - self.middle) / self.half, state

    def replace_last_actions(self, state: np.ndarray, actions: np.ndarray) -> None:
        """Replace the last actions in a state by those that were applied, (n, p)."""
        if self.keeps_input:
            state[:, 0] = self.middle + self.half * actions[:, 0]


def predictive(name: str, env: gym.Env) -> ClassicalPolicy:
    """A predictive controller by name, with the model that the filter of an env assumes.

    Args:
        name: one of `HORIZONS`.
        env: with the filter, if there is one, as its outermost wrapper.

    Raises:
        ValueError: for an unknown name.
    """
    horizon = HORIZONS[one_of("controller", name, tuple(HORIZONS))]
    believed = getattr(getattr(env, "filter", None), "model", None)
    constants = believed.constants if believed is not None and isinstance(believed.constants, Constants) else None
    controller = PredictiveController.for_env(env, horizon, constants)
    return ClassicalPolicy(controller, 1, _max_voltage(env), keeps_input=True)


def lqr(env: gym.Env) -> ClassicalPolicy:
    """LQR on the true state, or on an estimate: certainty equivalence, so LQG."""
    return ClassicalPolicy(LQRController.for_env(env), 1, _max_voltage(env))


def pi(env: gym.Env, training_returns: TrainingReturns) -> ClassicalPolicy:
    """PI with feed-forward on the thrust of an observation set, with the best gains for it.

    Factors `GAINS` on both gains of `lambda_gains` are tried on training seeds; the highest mean return wins.
    """
    usual, top = PIController.for_env(env), _max_voltage(env)
    tried = np.array(list(product(GAINS, GAINS))) * [usual.proportional_gain, usual.integral_gain]
    # All pairs of gains at once, each on its own copies: gains may be arrays.
    each = np.repeat(tried, GAIN_SEEDS, axis=0).T
    returns = training_returns(ClassicalPolicy(_with_gains(usual, *each), 0, top), len(tried), GAIN_SEEDS)
    best = tried[returns.mean(axis=1).argmax()]
    return ClassicalPolicy(_with_gains(usual, *best.tolist()), 0, top)


def _max_voltage(env: gym.Env) -> float:
    base: Any = env.unwrapped
    return base.plant.max_voltage


def _with_gains(controller: PIController, proportional, integral) -> PIController:
    return replace(controller, proportional_gain=proportional, integral_gain=integral)
