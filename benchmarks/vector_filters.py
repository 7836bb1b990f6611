"""A filter on every copy of a vector env: a copy's step, with its plant, its filter and its share of Gymnasium."""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks.rows import Row
from benchmarks.timing import alone
from benchmarks.vectors import vector_steps

COPIES, STEPS = 1024, 100
ENSEMBLE_SIZE = 50


def rows(seed: int, quick: bool) -> Iterator[Row]:
    """Measure, one row after the other."""
    sized = {"filter_arguments": {"ensemble_size": ENSEMBLE_SIZE}}
    for what, name, arguments, goal in (
        ("EKF", "filters:BowThruster-EKF-v0", {}, 0.3e-6),
        (f"EnKF, N = {ENSEMBLE_SIZE},", "filters:BowThruster-EnKF-v0", sized, 1e-6),
    ):
        measure = vector_steps(name, seed, COPIES, STEPS, **arguments)
        timing = alone(measure, 5 if quick else 40)
        yield Row(f"{what} on {COPIES} copies", None, timing, time_goal=goal)
