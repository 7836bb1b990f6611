"""Plants that policies learn on, by the name of a task."""

from __future__ import annotations

from thruster_env.core.checks import one_of
from tuning.policies.plants.auv import AUV
from tuning.policies.plants.plant import TrainingPlant
from tuning.policies.plants.thruster import THRUSTER

PLANTS: dict[str, TrainingPlant] = {"thruster": THRUSTER, "vehicle": AUV}
TASKS = {name: task for plant in PLANTS.values() for name, task in plant.tasks.items()}


def plant_of(task: str) -> TrainingPlant:
    """The plant of a task's name; ValueError for an unknown one."""
    one_of("task", task, tuple(TASKS))
    return next(plant for plant in PLANTS.values() if task in plant.tasks)
