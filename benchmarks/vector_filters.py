"""A filter on every copy of a vector env: a copy's step, with its plant, its filter and its share of Gymnasium."""

from __future__ import annotations

from collections.abc import Iterator

import gymnasium as gym

from benchmarks.rates import arithmetic_limit, step_of_filtered
from benchmarks.timing import Row, alone
from benchmarks.vectors import vector_steps
from thruster_env.core.threads import cores

COPIES, STEPS = 1024, 100
ENSEMBLE_SIZE = 50


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    sized = {"filter_arguments": {"ensemble_size": ENSEMBLE_SIZE}}
    for what, name, arguments, goal in (
        ("EKF", "filters:BowThruster-EKF-v0", {}, 16),
        (f"EnKF, N = {ENSEMBLE_SIZE},", "filters:BowThruster-EnKF-v0", sized, 2.9),
    ):
        measure = vector_steps(name, seed, COPIES, STEPS, **arguments)
        timing = alone(measure, 5 if quick else 40)
        limit = arithmetic_limit(step_of_filtered(gym.make(name, **arguments)), cores=cores())
        yield Row(f"{what} on {COPIES} copies", None, timing, limit=limit, limit_goal=goal)
