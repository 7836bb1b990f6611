"""How commands name built-in and other problems."""

from __future__ import annotations

from tuning.problems.plant_packages import built_in

PROBLEMS = (
    f"{', '.join(built_in())}, a .toml file, or module:object: a tuning.problems.problem.Problem, or a "
    "function that returns one."
)
