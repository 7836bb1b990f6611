"""Many copies of a thruster at work in place: what envs step and what `simulate` records."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from numerics.checks import options as checked_options
from numerics.threads import crew
from plants.disturbances.layout import KEY_0, KEY_1
from thruster_env.effects.uncertainty import drawn_parameters
from thruster_env.engine.encoding import encode, is_plain, known_effects
from thruster_env.engine.memory import (
    COMMAND,
    CONSTANT_COUNT,
    FIXED_ROWS,
    REPORTED,
    gathered,
    new_memory,
    scatter,
    set_row,
)
from thruster_env.engine.step import advance, advance_in_parts
from thruster_env.parameters import derive_constants
from thruster_env.plant import Plant
from thruster_env.plant import state as checked_state
from thruster_env.task import Task

THREADED_BLOCKS = 8  # fewer blocks are done before a second thread has woken up


class Copies:
    """N copies of a plant with a task, each with its own key; reports are arrays (REPORTED, N), see `memory`."""

    def __init__(self, plant: Plant, task: Task, count: int):
        """Allocate the memory of `count` copies; `begin` comes next."""
        self.plant, self.task, self.count = plant, task, count
        self.numbers, self._extra_rows = encode(plant, task)
        self.memory = new_memory(count, self._extra_rows)
        self._find_machine_code()

    def _find_machine_code(self) -> None:
        effects = known_effects(self.plant, self.task), is_plain(self.plant, self.task)
        self.advance, self._advance_in_parts = advance(*effects), advance_in_parts(*effects)

    def __getstate__(self) -> dict:
        """All but the machine code, which pickle cannot hold and every process finds for itself."""
        return {key: value for key, value in vars(self).items() if key not in ("advance", "_advance_in_parts")}

    def __setstate__(self, state: dict) -> None:
        """Find the machine code for the memory that was kept."""
        vars(self).update(state)
        self._find_machine_code()

    @property
    def bytes_per_copy(self) -> int:
        """Memory that one copy takes."""
        return self.memory.nbytes // (self.memory.shape[0] * self.memory.shape[2])

    def begin(self, keys: np.ndarray, which: np.ndarray | None = None, numbers=None) -> np.ndarray:
        """Start episodes with keys (count, 2) for all copies, or for those named by `which`; return their report.

        `numbers` may stand in for the plant's own, with another initial state.
        """
        numbers = self.numbers if numbers is None else numbers
        memory = self.memory if which is None else gathered(self.memory, which)
        set_row(memory, KEY_0, keys[:, 0])
        set_row(memory, KEY_1, keys[:, 1])
        if self.plant.uncertainty:
            self._draw_constants(memory, keys)
        out = self._run(memory, numbers, True)
        if which is not None:
            scatter(memory, self.memory, which)
        return out[:, : len(keys)]

    def numbers_from(self, options: Mapping | None) -> np.ndarray | None:
        """Numbers for `begin` with the initial state that a reset's options fix in "state", or None."""
        given = checked_options(options).get("state")
        if given is None:
            return None
        state = checked_state("the state of options", given)
        return encode(self.plant._replace(initial_mean=state, initial_cov=np.zeros((2, 2))), self.task)[0]

    def step(self, voltages: np.ndarray) -> np.ndarray:
        """Apply voltages (N,) [V] for one sample time; return the report."""
        set_row(self.memory, COMMAND, voltages)
        return self._run(self.memory, self.numbers, False)[:, : self.count]

    def report(self) -> np.ndarray:
        """What the last step reported, without a step."""
        reported = self.memory[:, :REPORTED].transpose(1, 0, 2)
        return reported.reshape(REPORTED, -1)[:, : self.count].copy()

    def _run(self, memory: np.ndarray, numbers: np.ndarray, begin: bool) -> np.ndarray:
        blocks, _, width = memory.shape
        # A block more than there are: rows that lie a power of two apart would drive one another out of the cache.
        out = np.empty((REPORTED, blocks + 1, width))
        if blocks < THREADED_BLOCKS:
            self.advance(0, blocks, memory, numbers, out, begin)
        else:
            crew().run(self._advance_in_parts, blocks, memory, numbers, out, begin)
        return out.reshape(REPORTED, -1)

    def _draw_constants(self, memory: np.ndarray, keys: np.ndarray) -> None:
        plant = self.plant
        parameters = drawn_parameters(plant.parameters, plant.uncertainty, keys)
        constants = derive_constants(parameters, plant.ambient_velocity, plant.dt / plant.substeps)
        first = FIXED_ROWS + self._extra_rows - CONSTANT_COUNT
        for i, values in enumerate(constants):
            set_row(memory, first + i, np.broadcast_to(values, len(keys)))
