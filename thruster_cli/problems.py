"""How commands name the problems that come with the package, and where others come from."""

from __future__ import annotations

from tuning.problems.rooms import built_in

PROBLEMS = (
    f"{', '.join(built_in())}, a .toml file, or module:object: a tuning.problems.problem.Problem, or a function "
    "that gives one."
)
