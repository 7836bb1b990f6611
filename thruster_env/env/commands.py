"""Actions of an env as the commands of a plant, checked before the step."""

from __future__ import annotations

import math
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium.vector.utils import batch_space
from numpy import ndarray

from thruster_env.core.checks import as_floats, short_repr
from thruster_env.model.quantities import Quantity


def one_number(action, quantity: Quantity) -> float:
    """The command of a plant with one input; ValueError unless an action is one number and not NaN."""
    if type(action) is ndarray and action.size == 1:  # the frequent case has to be quick
        number = action.item()
        if type(number) is float and number == number:
            return number
    try:
        item = action.item if hasattr(action, "item") else np.asarray(action).item
        entry = item()
        number = math.nan if isinstance(entry, (str, bytes)) else float(entry)
    except (TypeError, ValueError, OverflowError, RuntimeError):  # RuntimeError: a torch tensor of several numbers
        number = math.nan
    if number != number:
        raise ValueError(f"an action must be one {quantity.label} and not NaN, but got {short_repr(action)}")
    return number


def some_numbers(action, quantities: tuple[Quantity, ...]) -> np.ndarray:
    """The commands (p,) of a plant with p inputs; ValueError unless an action is p numbers, none of them NaN."""
    try:
        numbers = as_floats(action)
    except ValueError:
        numbers = np.empty(0)
    if numbers.shape != (len(quantities),) or np.isnan(numbers).any():
        rule = f"{len(quantities)} numbers and not NaN ({_labels(quantities)})"
        raise ValueError(f"an action must be {rule}, but got {short_repr(action)}")
    return numbers


def of_copies(actions, copies: int, quantities: tuple[Quantity, ...], ignored: np.ndarray | None) -> np.ndarray:
    """Commands (copies, p) of many copies, or (copies,) if p is 1.

    Args:
        actions: (copies, p), or (copies,) if p is 1.
        copies: their number.
        quantities: the p inputs.
        ignored: copies (copies,) whose actions are not used, and may be NaN; None if there are none.

    Raises:
        ValueError: for another shape, and for NaN.
    """
    p = len(quantities)
    try:
        commands = as_floats(actions)
    except ValueError:
        commands = np.empty(0)
    if commands.shape != (copies, p) and (p > 1 or commands.shape != (copies,)):
        raise ValueError(f"actions must be {copies} {_rows(quantities)}, but got {short_repr(actions)}")
    wrong = np.isnan(commands)
    if wrong.any():
        lost = wrong.reshape(copies, -1).any(axis=1)
        lost_copies = np.flatnonzero(lost if ignored is None else lost & ~ignored)
        if len(lost_copies):
            raise ValueError(
                f"actions must be {_rows(quantities)} and not NaN, but got NaN in copy {lost_copies[0]}"
            )
    return commands.reshape(-1) if p == 1 else commands


def _rows(quantities: tuple[Quantity, ...]) -> str:
    """The words for one row of actions in messages."""
    if len(quantities) == 1:
        return f"{quantities[0].name}s [{quantities[0].unit}]"
    return f"rows of {len(quantities)} numbers ({_labels(quantities)})"


def _labels(quantities: tuple[Quantity, ...]) -> str:
    return ", ".join(quantity.label for quantity in quantities)


# The true state as observation: the reference for policies that must work with estimates.


class ObserveState(gym.Wrapper, gym.utils.RecordConstructorArgs):
    """Observe the true state of a plant instead of the measurement.

    Entries that the env appends to its measurement (validity flags, a reference signal) stay at the end.

    Args:
        env: an env of a plant.
    """

    def __init__(self, env: gym.Env):
        """Wrap the env; see the class."""
        gym.utils.RecordConstructorArgs.__init__(self)
        gym.Wrapper.__init__(self, env)
        base: Any = env.unwrapped
        self._appended = base.appended_entries
        self.observation_space = _space(base.report_rows.states + self._appended)

    def reset(self, *, seed: int | None = None, options: dict | None = None):
        """Reset the env."""
        observation, info = self.env.reset(seed=seed, options=options)
        return _observed(info["state"], observation, self._appended), info

    def step(self, action):
        """Step the env."""
        observation, *outcome, info = self.env.step(action)
        return _observed(info["state"], observation, self._appended), *outcome, info


class ObserveStateVector(gym.vector.VectorWrapper):
    """`ObserveState` for vector envs, in all three autoreset modes.

    Args:
        env: a vector env of a plant.
    """

    def __init__(self, env: gym.vector.VectorEnv):
        """Wrap the envs; see the class."""
        super().__init__(env)
        base: Any = env.unwrapped
        self._appended = base.appended_entries
        self.single_observation_space = _space(base.report_rows.states + self._appended)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)

    def reset(self, *, seed: int | list[int | None] | None = None, options: dict | None = None):
        """Reset the envs."""
        seeds: Any = seed  # Gymnasium takes a list of them, too, but its annotation does not say so
        observations, info = self.env.reset(seed=seeds, options=options)
        return _observed(info["state"], observations, self._appended), info

    def step(self, actions):
        """Step the envs."""
        observations, *outcome, info = self.env.step(actions)
        if "final_obs" in info:
            for i in np.flatnonzero(info["_final_obs"]):
                last = info["final_info"]["state"][i]
                info["final_obs"][i] = _observed(last, info["final_obs"][i], self._appended)
        return _observed(info["state"], observations, self._appended), *outcome, info


def _space(entries: int) -> gym.spaces.Box:
    return gym.spaces.Box(-np.inf, np.inf, shape=(entries,), dtype=np.float32)


def _observed(state: np.ndarray, observation: np.ndarray, appended: int) -> np.ndarray:
    """State (..., n), then the last entries of an observation (..., d), in float32."""
    last_entries = observation[..., observation.shape[-1] - appended :]
    with np.errstate(over="ignore"):  # beyond 3.4e38 lies infinity
        return np.concatenate([state.astype(np.float32), last_entries], axis=-1)
