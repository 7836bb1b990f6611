"""Many copies of a thruster, stepped in place by envs and by `simulate`."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import options as checked_options
from thruster_env.core.compiled import CompiledOrPython
from thruster_env.core.memory import set_row
from thruster_env.env.copies import PlantCopies
from thruster_env.env.record import check_finite, record
from thruster_env.thruster.effects.uncertainty import drawn_parameters
from thruster_env.thruster.engine.encoding import encode, is_plain, known_effects
from thruster_env.thruster.engine.memory import (
    COMMAND,
    CONSTANT_COUNT,
    FIXED_ROWS,
    FLOW,
    OMEGA,
    READINGS,
    REPORTED,
    THRUST,
    VALID,
)
from thruster_env.thruster.engine.simulation import advance, advance_in_parts
from thruster_env.thruster.parameters import derive_constants
from thruster_env.thruster.plant import Plant
from thruster_env.thruster.plant import state as checked_state
from thruster_env.thruster.task import Task


class Copies(PlantCopies):
    """N copies of a thruster with a task; rows of their reports are in `thruster_env.thruster.engine.memory`."""

    commands, reported = (COMMAND,), REPORTED

    def __init__(self, plant: Plant, task: Task, count: int):
        """Allocate the memory of `count` copies; `begin` comes next."""
        self.plant, self.task = plant, task
        numbers, self._extra_rows = encode(plant, task)
        super().__init__(count, numbers, FIXED_ROWS + self._extra_rows)

    def machine_code(self) -> tuple[Callable, CompiledOrPython]:
        """The compiled step of this plant and task."""
        effects = known_effects(self.plant, self.task), is_plain(self.plant, self.task)
        return advance(*effects), advance_in_parts(*effects)

    def numbers_from(self, options: Mapping | None) -> np.ndarray | None:
        """Numbers for `begin` with the initial state that a reset's options fix in "state", or None."""
        start = checked_options(options).get("state")
        if start is None:
            return None
        state = checked_state("the state of options", start)
        return encode(self.plant._replace(initial_mean=state, initial_cov=np.zeros((2, 2))), self.task)[0]

    def prepare(self, memory: np.ndarray, keys: np.ndarray) -> None:
        """Draw uncertain parameters for episodes with keys (count, 2)."""
        plant = self.plant
        if not plant.uncertainty:
            return
        parameters = drawn_parameters(plant.parameters, plant.uncertainty, keys)
        constants = derive_constants(parameters, plant.ambient_velocity, plant.dt / plant.substeps)
        first = FIXED_ROWS + self._extra_rows - CONSTANT_COUNT
        for i, values in enumerate(constants):
            set_row(memory, first + i, np.broadcast_to(values, len(keys)))


# Trajectories of a plant, without an env around it.


class Simulation(NamedTuple):
    """Trajectories of a batch of B plants over K steps."""

    states: np.ndarray  # (B, K + 1, 2)
    thrusts: np.ndarray  # (B, K + 1) [N]
    measurements: np.ndarray  # (B, K + 1, m)
    valid: np.ndarray  # (B, K + 1, m), false where a measurement is missing and the last one repeated

    def checked(self, what: str = "a simulation") -> Simulation:
        """The same; ValueError that names the first step at which a number is not finite."""
        check_finite(what, self.states, self.thrusts[..., None], self.measurements)
        return self


def simulate(plant: Plant, keys: np.ndarray, voltages: np.ndarray) -> Simulation:
    """Run a plant from its initial state for every key (B, 2) under voltages (B, K) [V].

    The same key and voltages give the same numbers as an env that is stepped through Gymnasium.

    Raises:
        ValueError: if shapes do not fit or a number is not finite.
    """
    reports = record(lambda count: Copies(plant, Task(), count), keys, voltages, "voltages", 1)
    m = len(plant.channels)
    readings = reports[..., READINGS : READINGS + m]
    valid = reports[..., VALID : VALID + m] > 0 if plant.dropping_channels else np.ones(readings.shape, dtype=bool)
    return Simulation(reports[..., OMEGA : FLOW + 1], reports[..., THRUST], readings, valid)
