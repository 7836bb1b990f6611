"""Many copies of a vehicle at work in place: what envs step and what `simulate` records."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from auv_env.engine.encoding import encode
from auv_env.engine.memory import COMMAND, FIXED_ROWS, REPORTED, N
from auv_env.engine.step import machine_code
from auv_env.plant import Plant
from auv_env.plant import state as checked_state
from auv_env.task import Task
from thruster_env.numerics.checks import options as checked_options
from thruster_env.numerics.compiled import CompiledOrPython
from thruster_env.plants.copies import PlantCopies


class Copies(PlantCopies):
    """N copies of a vehicle with a task; rows of their reports are in `auv_env.engine.memory`."""

    reported = REPORTED

    def __init__(self, plant: Plant, task: Task, count: int):
        """Allocate the memory of `count` copies; `begin` comes next."""
        self.plant, self.task = plant, task
        self.commands = tuple(range(COMMAND, COMMAND + len(plant.inputs)))
        numbers, rows = encode(plant, task)
        super().__init__(count, numbers, FIXED_ROWS + rows)

    def machine_code(self) -> tuple[Callable, CompiledOrPython]:
        """The compiled step, the same for every plant and task."""
        return machine_code()

    def numbers_from(self, options: Mapping | None) -> np.ndarray | None:
        """Numbers for `begin` with the initial state that a reset's options fix in "state", or None."""
        given = checked_options(options).get("state")
        if given is None:
            return None
        state = checked_state("the state of options", given)
        return encode(self.plant._replace(initial_mean=state, initial_cov=np.zeros((N, N))), self.task)[0]
