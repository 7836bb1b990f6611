"""Tasks by name: an env, and what it is asked to follow."""

from __future__ import annotations

from typing import NamedTuple


class Task(NamedTuple):
    """An env and what it is asked to follow."""

    about: str
    env_id: str
    arguments: dict


TASKS: dict[str, Task] = {
    "tracking": Task("steps of thrust ahead, as the env has them", "BowThrusterTracking-v0", {}),
    "reversal": Task("ramps of thrust through zero, as the env has them", "BowThrusterReversal-v0", {}),
    "manoeuvre": Task(
        "steps of thrust ahead and astern, every half second",
        "BowThrusterTracking-v0",
        {"reference": [{"name": "steps", "low": -0.6, "high": 0.6, "hold_time": 0.5}]},
    ),
}
