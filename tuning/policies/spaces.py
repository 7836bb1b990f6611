"""Spaces of envs: policies here observe and act in boxes only."""

from __future__ import annotations

import gymnasium as gym


def box_of(space: gym.Space) -> gym.spaces.Box:
    """The same space; ValueError unless it is a Box."""
    if not isinstance(space, gym.spaces.Box):
        raise ValueError(f"a space must be a Box, but got {space}")
    return space


def size_of(space: gym.Space) -> int:
    """Number of entries of a Box with one axis."""
    return box_of(space).shape[0]
