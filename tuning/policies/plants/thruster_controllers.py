"""The thruster's classical policies: PI, LQR (LQG with an estimator), and the predictive controllers.

They use the observation sets of `tuning.policies.observations`, so that they can be compared with learnt
policies.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from typing import Any

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import one_of
from thruster_env.thruster.control.controllers import LQRController, PIController
from thruster_env.thruster.control.planning import HORIZONS, PredictiveController
from thruster_env.thruster.dynamics import Constants
from tuning.policies.controllers import ClassicalPolicy
from tuning.policies.plants.plant import TrainingReturns

GAINS = (
    0.5,
    1.0,
    2.0,
    3.0,
    4.0,
    6.0,
)  # factors on the gains of `gains.lambda_gains`, tried for each observation set
GAIN_SEEDS = 16


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


def controller_of(name: str, env: gym.Wrapper, training_returns: TrainingReturns) -> ClassicalPolicy:
    """A classical policy of the thruster by name; arguments as of `TrainingPlant.classical`."""
    if name in HORIZONS:
        return predictive(name, env.env)
    return lqr(env) if name == "lqr" else pi(env, training_returns)
