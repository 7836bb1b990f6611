"""Classical policies on the sets of `tuning.policies.observations`, beside learnt ones."""

from __future__ import annotations

import numpy as np

from thruster_env.core.checks import one_of
from tuning.policies.controllers import ClassicalPolicy
from tuning.policies.environments import make_single
from tuning.policies.plants.find import plant_of
from tuning.policies.score import score
from tuning.policies.setup import TrainingConfiguration
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
