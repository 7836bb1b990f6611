"""Classical policies on the observation sets of `training.observations`, for comparison with learnt policies."""

from __future__ import annotations

from numerics.checks import one_of
from training.controllers import ClassicalPolicy
from training.plants.find import plant_of
from training.setup import TrainingConfiguration


def classical_policy(name: str, setup: TrainingConfiguration) -> ClassicalPolicy:
    """A classical policy by the name of its controller, on the observation set of a training configuration.

    Raises:
        ValueError: for an unknown name, or a controller of states on an observation set without states.
    """
    plant = plant_of(setup.task)
    one_of("controller", name, plant.controllers)
    plant.check_observes(name, setup.observe)
    return plant.classical(name, setup)
