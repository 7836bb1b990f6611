"""Classical policies for the same tables: each observes what an arm of `training.observations` does.

So it stands beside the policy that learnt on that arm.
"""

from __future__ import annotations

from numerics.checks import one_of
from training.controllers import ClassicalPolicy
from training.plants.find import plant_of
from training.setup import Setup


def classical_policy(name: str, setup: Setup) -> ClassicalPolicy:
    """A classical policy by the name of its controller, on what a setup observes.

    Raises:
        ValueError: for an unknown name, or where a controller of states observes none.
    """
    plant = plant_of(setup.task)
    one_of("controller", name, plant.controllers)
    plant.check_observes(name, setup.observe)
    return plant.classical(name, setup)
