"""Classical policies on the sets of `thruster_env.training.observations`, beside learnt ones."""

from __future__ import annotations

import numpy as np

from thruster_env.numerics.checks import one_of
from thruster_env.training.controllers import ClassicalPolicy
from thruster_env.training.environments import make_single
from thruster_env.training.plants.find import plant_of
from thruster_env.training.score import score
from thruster_env.training.setup import TrainingConfiguration
from tuning.problems.seeds import training_seeds


def classical_policy(name: str, setup: TrainingConfiguration) -> ClassicalPolicy:
    """A classical policy by the name of its controller, on the observation set of a training configuration.

    Raises:
        ValueError: for an unknown name, or a controller of states on an observation set without states.
    """
    plant = plant_of(setup.task)
    one_of("controller", name, plant.controllers)
    plant.check_observes(name, setup.observe)

    def training_returns(policy: ClassicalPolicy, copies: int, episodes: int) -> np.ndarray:
        seeds = list(training_seeds(setup.seed, episodes)) * copies
        return score(policy, setup, seeds).returns.reshape(copies, episodes)

    return plant.classical(name, make_single(setup), training_returns)
