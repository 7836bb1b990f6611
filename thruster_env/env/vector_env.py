"""The mechanics of a plant's vector env: all copies advanced by one compiled call, noise included."""

from __future__ import annotations

import copy
from typing import Any, ClassVar

import gymnasium as gym
import numpy as np
from gymnasium.utils.seeding import np_random
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from thruster_env.core.checks import at_least
from thruster_env.core.keys import EpisodeKeys, reset_mask
from thruster_env.core.memory import REWARD, TERMINATED, TIME
from thruster_env.env.commands import of_copies
from thruster_env.env.env import PlantEnv, ReportRows, infos_of, observations_of

MOST_ENVS = 1_000_000  # of some kilobytes each


class PlantVectorEnv(gym.vector.VectorEnv):
    """N copies of an env in one compiled step: copy i after `reset(seed=s)` equals a single env with seed s + i.

    Its j-th later episode equals that env's j-th unseeded reset, in all three autoreset modes. Random parameters
    of an episode are drawn for each copy. Info holds arrays with one row per copy, and a mask `_key` for each key,
    as Gymnasium's own vector envs do. Actions of copies that are about to be reset are ignored.

    Args:
        num_envs: number of copies.
        max_episode_steps: steps after which an episode is truncated; None for never.
        autoreset_mode: "NextStep" (default), "SameStep" or "Disabled", or the `AutoresetMode`.
        **arguments: those of the single env.

    Raises:
        ValueError: if an argument is wrong; the message states the rule and the value.
    """

    single_env: ClassVar[type[PlantEnv]]

    def __init__(
        self,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        **arguments,
    ):
        """Build one env, for its plant and spaces, and the memory of all copies."""
        self.num_envs = at_least("num_envs", num_envs, 1, MOST_ENVS)
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        if arguments.get("render_mode") is not None:
            raise ValueError(f"render_mode must be None in a vector env, but got {arguments['render_mode']!r}")
        env = self.single_env(**arguments)
        self.metadata = {**env.metadata, "autoreset_mode": self.autoreset_mode}
        self.plant, self.task, self._rows = env.plant, env.task, env.report_rows
        self.inputs = env.inputs
        self._observed = self._rows.observed
        self.appended_entries = env.appended_entries  # of an observation, after the measurement
        self.single_action_space, self.single_observation_space = env.action_space, env.observation_space
        self.action_space = batch_space(env.action_space, self.num_envs)
        self.observation_space = batch_space(env.observation_space, self.num_envs)
        steps = np.inf if max_episode_steps is None else at_least("max_episode_steps", max_episode_steps, 1)
        self._last_time = steps * self.plant.dt
        self._copies = env.copies_of(self.num_envs)
        self._keys = EpisodeKeys(self.num_envs)
        self._done = np.zeros(self.num_envs, dtype=bool)

    def __copy__(self) -> PlantVectorEnv:
        """A deep copy, because envs that share a memory would step each other."""
        return copy.deepcopy(self)

    @property
    def report_rows(self) -> ReportRows:
        """The contents of a report, and its rows for observation and info."""
        return self._rows

    @property
    def bytes_per_copy(self) -> int:
        """Memory of one copy while it is stepped [bytes], without its generator and next keys."""
        return self._copies.bytes_per_copy

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict | None = None):
        """Start an episode of every copy, or of those where `options["reset_mask"]` (num_envs,) is true.

        `options={"state": [..]}` fixes the initial state of these episodes.
        """
        numbers = self._copies.numbers_from(options)
        mask = reset_mask(options, self._keys)
        self._keys.seeds(seed)  # a wrong one changes nothing
        if isinstance(seed, (int, np.integer)):
            self._np_random, self._np_random_seed = np_random(int(seed))
        self._keys.seed(seed, np.ones(self.num_envs, dtype=bool) if mask is None else mask)
        report = self._copies.report()
        which = np.arange(self.num_envs) if mask is None else np.flatnonzero(mask)
        self._restart(which, report, numbers)
        return observations_of(report, self._observed), self._info(report, mask)

    def step(self, actions):
        """Apply one action per copy, (num_envs, p), or (num_envs,) if p is 1, for one sample time.

        Raises ValueError for actions of another shape, and for NaN in a copy that is not about to be reset.
        """
        if not self._keys.seeded:
            raise gym.error.ResetNeeded("call reset() before step()")
        ignored = self._done if self.autoreset_mode == AutoresetMode.NEXT_STEP else None
        report = self._copies.step(of_copies(actions, self.num_envs, self.inputs, ignored))
        if self.autoreset_mode == AutoresetMode.NEXT_STEP and self._done.any():
            self._restart(np.flatnonzero(self._done), report)
        terminated, truncated = report[TERMINATED] > 0.0, report[TIME] >= self._last_time
        rewards = report[REWARD]
        self._done = terminated | truncated
        ends = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._done.any():
            rewards = rewards.copy()
            ends = self._endings(report)
            self._restart(np.flatnonzero(self._done), report)
        observations = observations_of(report, self._observed)
        return observations, rewards, terminated, truncated, self._info(report) | ends

    def _restart(self, which: np.ndarray, report: np.ndarray, numbers: np.ndarray | None = None) -> None:
        keys = self._keys.draw(which)
        if len(which) == self.num_envs:
            report[:] = self._copies.begin(keys, numbers=numbers)
        else:
            report[:, which] = self._copies.begin(keys, which, numbers)
        report[TERMINATED, which] = 0.0  # a reset ends nothing: what begins beyond limits ends with its first step
        self._done[which] = False

    def _endings(self, report: np.ndarray) -> dict[str, Any]:
        done = self._done.copy()
        observations = observations_of(report, self._observed)
        final = np.full(self.num_envs, None, dtype=object)
        for i in np.flatnonzero(done):
            final[i] = observations[i]
        info = self._info(report.copy(), done)
        return {"final_obs": final, "_final_obs": done, "final_info": info, "_final_info": done.copy()}

    def _info(self, report: np.ndarray, mask: np.ndarray | None = None) -> dict[str, Any]:
        return infos_of(report, self._rows, np.ones(self.num_envs, dtype=bool) if mask is None else mask)


def _autoreset_mode(mode_or_name) -> AutoresetMode:
    try:
        return AutoresetMode(mode_or_name)
    except ValueError:
        names = ", ".join(repr(mode.value) for mode in AutoresetMode)
        raise ValueError(f"autoreset_mode must be one of {names}, but got {mode_or_name!r}") from None
