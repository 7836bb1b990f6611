"""Policies of an `EnvProblem`: functions of the observation that choose the same actions for the same seed."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import gymnasium as gym
import numpy as np

from thruster_env.core.checks import short_repr
from thruster_env.core.streams import POLICY, RANDOM_ACTIONS, derived_generator, derived_seed
from tuning.problems.excitation import Excitation, excitation_of

Policy = str | Mapping | Excitation | Callable
RANDOM = "random"
LARGEST = 1e3  # random action, where the action space has no limit


def checked_policy(given: Policy) -> str | Excitation | Callable:
    """A policy unchanged, an excitation for a mapping with its name; ValueError for anything else."""
    if isinstance(given, Excitation | Mapping):
        return excitation_of(given)
    if given != RANDOM and not callable(given) and not hasattr(given, "predict"):
        rule = "policy must be 'random', a function of the observation, an object with predict, or an excitation"
        raise ValueError(f"{rule}, but got {short_repr(given)}")
    return given


def chooser(policy: Any, space: gym.spaces.Box, seed: int) -> Callable:
    """The policy, or given actions (K, p), as a function of the observation, as the episode of a seed begins.

    A policy with `reset` is reset, with its own seed if it takes `seed`. What has `predict` is asked for its
    `deterministic` action, and gets its `state` and `episode_start` where it takes them, as the policies of
    Stable-Baselines3 do.
    """
    if isinstance(policy, str):
        generator = derived_generator(seed, RANDOM_ACTIONS)
        low, high = (np.clip(end, -LARGEST, LARGEST) for end in (space.low, space.high))
        return lambda observation: generator.uniform(low, high)
    if isinstance(policy, np.ndarray):
        rows = iter(policy)
        return lambda observation: next(rows)
    _begin(policy, seed)
    return _predicted(policy) if hasattr(policy, "predict") else policy


def _begin(policy: Any, seed: int) -> None:
    """Reset what remembers something: the object, or that of a method."""
    while isinstance(policy, partial):
        policy = policy.func
    owner = getattr(policy, "__self__", policy)
    reset = getattr(owner, "reset", None)
    if not callable(reset) or isinstance(owner, gym.Env | type):
        return
    own = {"seed": derived_seed(seed, POLICY)} if "seed" in _names(reset) else {}
    try:
        inspect.signature(reset).bind(**own)
    except (TypeError, ValueError):  # it asks for more: it is no beginning of an episode
        return
    reset(**own)


def _predicted(policy: Any) -> Callable:
    known = _names(policy.predict)
    fixed = {"deterministic": True} if "deterministic" in known else {}
    remembers = {"state", "episode_start"} <= known
    state, first = None, True

    def choose(observation):
        nonlocal state, first
        if not remembers:
            return policy.predict(observation, **fixed)[0]
        start = np.array([first])
        action, state = policy.predict(observation, state=state, episode_start=start, **fixed)
        first = False
        return action

    return choose


def _names(function: Callable) -> set[str]:
    """Names of the arguments of a function; none where it does not tell them."""
    try:
        return set(inspect.signature(function).parameters)
    except (TypeError, ValueError):
        return set()
