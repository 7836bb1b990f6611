"""Numbers of a filter in words, each with its unit."""

from __future__ import annotations

from collections.abc import Iterable

from tuning.problems.problem import Problem
from tuning.search.space import parameters


def labels(names: Iterable[str], kind: str, problem: Problem, square: str = "^2") -> dict[str, str]:
    """What tables call the numbers of a filter: Q11 of the thruster is "Q11 [(rad/s)^2]".

    Args:
        names: of trial parameters.
        kind: name of the filter.
        problem: whose parameters have the units.
        square: what stands for "squared".
    """
    everything = {} if problem.parameters is not None else {"full_q": True, "prior": True}
    units = {one.name: one.unit.replace("^2", square) for one in parameters(kind, problem, **everything)}
    said = {name: name.replace("_", " ") for name in names}
    return {name: f"{words} [{units[name]}]" if units.get(name) else words for name, words in said.items()}
