"""The mechanics of a plant's Gymnasium env: seeds, steps, observations, infos, copies, pickles and its spec."""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import seed as checked_seed
from thruster_env.core.direct import direct
from thruster_env.core.memory import REWARD, TERMINATED
from thruster_env.core.streams import draw_key
from thruster_env.env.commands import one_number, some_numbers
from thruster_env.env.copies import PlantCopies
from thruster_env.env.rendered import RenderedEnv
from thruster_env.env.report import FLOAT32_ENDS, ReportRows, info_maker, observation_of, views_of
from thruster_env.model.quantities import Quantity

# What `_set_views` makes.
VIEWS = ("_memory", "_command", "_arguments", "_advance", "_report", "_outcome", "_views", "_info")


class PlantEnv(RenderedEnv):
    """An env of one copy of a plant, whose compiled step does all the computation.

    A plant's env has `inputs`, makes `copies_of` the plant, and calls `_set_up` from its `__init__`. `RenderedEnv`
    renders it, and `thruster_env.env.modelled` offers its model to filters. The vector env is then a
    class of two lines, see `thruster_env.env.vector_env`.

    Attributes:
        inputs: the quantities of the p entries of an action.
        plant: the plant; it has `dt`, its sample time [s].
        task: the reward and the end of episodes, if these are a value.
    """

    inputs: tuple[Quantity, ...]
    plant: Any
    task: Any = None

    def copies_of(self, count: int) -> PlantCopies:
        """Return `count` copies of the plant, with the env's task."""
        raise NotImplementedError

    def _set_up(
        self,
        action_space: gym.spaces.Box,
        rows: ReportRows,
        render_mode: str | None = None,
        render_size: Sequence[int] | None = None,
    ) -> None:
        """Make spaces and memory; `plant`, and what `copies_of` needs, must be there.

        Args:
            action_space: of shape (p,).
            rows: what a report holds, and which of it is shown.
            render_mode: None, or one of the modes in `metadata`.
            render_size: of pictures, (width, height) [px]; 640 x 400 if None.

        Raises:
            ValueError: if there is no such mode, or the size is none.
        """
        self._prepare_rendering(render_mode, render_size)
        self._rows, self._observed = rows, rows.observed
        self._readings = rows.observed[0]
        self._single = len(rows.observed) == 1  # the frequent case, which has to be quick
        self._one_input = len(self.inputs) == 1
        self.action_space = action_space
        shape = (len(rows.observed),)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, shape=shape, dtype=np.float32)
        self._copies = self.copies_of(1)
        self._out = np.zeros((self._copies.reported, 1, 1))
        self._observation_buffer = np.zeros(1, dtype=np.float32)
        self._set_views()

    def _set_views(self) -> None:
        """Short ways into the memory of the one copy, for a step has to be quick."""
        copies = self._copies
        self._advance: Callable = copies.advance
        self._memory = copies.memory
        self._arguments = (0, 1, self._memory, copies.numbers, self._out, False)
        self._command = self._memory[0, copies.commands[0] : copies.commands[-1] + 1, 0]
        self._report = self._out.reshape(-1)
        self._outcome = self._report[REWARD : TERMINATED + 1]
        self._views, self._info = views_of(self._report, self._rows), info_maker(self._rows)

    def __getstate__(self) -> dict:
        """The state without its views, for copies and pickles, which continue with the same numbers."""
        return {key: value for key, value in vars(self).items() if key not in VIEWS}

    def __setstate__(self, state: dict) -> None:
        """Make the views on the memory that was kept."""
        vars(self).update(state)
        self._set_views()

    def __copy__(self) -> PlantEnv:
        """A deep copy: two envs with one memory would move one another."""
        return copy.deepcopy(self)

    @property
    def report_rows(self) -> ReportRows:
        """The contents of a report, and its rows for observation and info."""
        return self._rows

    @property
    def appended_entries(self) -> int:
        """Entries of the observation after the measurement: validity flags and what the plant appends."""
        return len(self._rows.flags) + len(self._rows.appended)

    @property
    def spec(self):
        """The specification that made this env; its objects are stored as mappings for JSON."""
        return self._spec

    @spec.setter
    def spec(self, spec) -> None:
        if spec is not None:
            spec.kwargs.update({key: as_json(value) for key, value in spec.kwargs.items()})
        self._spec = spec

    _spec = None

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Start an episode: a key from the env's generator, an initial state and a first measurement.

        `options={"state": [..]}` fixes the initial state of this episode.
        """
        numbers = self._copies.numbers_from(options)
        super().reset(seed=checked_seed(seed))
        self._report[:] = self._copies.begin(draw_key(self.np_random)[None], numbers=numbers)[:, 0]
        self._advance = direct(self._copies.advance, *self._arguments)  # `step` has to be quick
        if self.render_mode is not None:
            self._show(self._report.tolist(), begin=True)
        return self._observation(), self._info(self._report, self._views)

    def step(self, action):
        """Apply an action for one sample time.

        Raises ValueError for an action that does not have one number for each input, or contains NaN.
        """
        if self._one_input:
            self._command[0] = one_number(action, self.inputs[0])
        else:
            self._command[:] = some_numbers(action, self.inputs)
        self._advance(*self._arguments)
        if self.render_mode is not None:
            self._show(self._report.tolist())
        reward, terminated = self._outcome.tolist()
        return self._observation(), reward, terminated > 0.0, False, self._info(self._report, self._views)

    def _observation(self) -> np.ndarray:
        if self._single:
            reading = self._report.item(self._readings)
            if -FLOAT32_ENDS < reading < FLOAT32_ENDS:
                self._observation_buffer[0] = reading
                return self._observation_buffer.copy()  # twice as fast as a new array of one number
        report = self._report.tolist()
        return observation_of([report[row] for row in self._observed])


def as_json(value):
    """An argument of an env for JSON, effects and parameters as mappings of plain numbers."""
    if hasattr(value, "as_mapping"):
        return value.as_mapping()
    if hasattr(value, "_asdict"):
        return value._asdict()
    if isinstance(value, Mapping):
        return {key: as_json(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [as_json(entry) for entry in value]
    return value
