"""Many copies of a vehicle at work in place: what envs step and what `simulate` records."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np

from thruster_env.auv.engine.encoding import encode
from thruster_env.auv.engine.memory import COMMAND, FIXED_ROWS, REPORTED, N
from thruster_env.auv.engine.step import machine_code
from thruster_env.auv.plant import Plant
from thruster_env.auv.plant import state as checked_state
from thruster_env.auv.task import Task
from thruster_env.core.checks import options as checked_options
from thruster_env.core.compiled import CompiledOrPython
from thruster_env.env.copies import PlantCopies


class Copies(PlantCopies):
    """N copies of a vehicle with a task; rows of their reports are in `thruster_env.auv.engine.memory`."""

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
