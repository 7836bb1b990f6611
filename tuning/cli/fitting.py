"""Which filters fit a problem's model, and the memory of a belief of each: `thruster filters --problem`."""

from __future__ import annotations

from typing import NamedTuple

from rich.console import RenderableType

from filters.engine.compile import new_memory
from filters.registry import FILTERS
from thruster_env.core.text_tables import table
from tuning.problems.problem import Problem
from tuning.search.space import untuned_choice


class Fit(NamedTuple):
    """Whether a filter fits a problem's model."""

    name: str
    reason: str  # why it does not; empty if it does
    ensemble_size: int | None = None  # of the rule of thumb; None without an ensemble
    kilobytes: float | None = None  # that a belief keeps from step to step, with its scratch


def fits_of(problem: Problem, names: tuple[str, ...] = tuple(FILTERS)) -> list[Fit]:
    """Each filter with the rule of thumb's parameters on a problem's model; nothing is compiled."""
    found = []
    for name in names:
        try:
            filter_ = untuned_choice(name, problem).filter(problem)
            memory = new_memory(filter_.kernels(), filter_.size)
        except ValueError as error:
            found.append(Fit(name, str(error)))
            continue
        kilobytes = sum(part.nbytes for part in memory) / 1e3
        found.append(Fit(name, "", filter_.size or None, kilobytes))
    return found


def fit_table(problem: Problem, fits: list[Fit]) -> list[RenderableType]:
    """The table of `fits_of`."""
    model = problem.model()
    rows = [
        [
            one.name,
            "no" if one.reason else "yes",
            "" if one.ensemble_size is None else str(one.ensemble_size),
            _size(one.kilobytes),
            one.reason,
        ]
        for one in fits
    ]
    counts = (model.n, "state"), (model.m, "measurement"), (model.inputs, "input")
    sizes = ", ".join(f"{count} {what}{'s' * (count != 1)}" for count, what in counts)
    title = f"Filters on {problem.name}: {sizes}"
    return [
        table(title, ["filter", "fits", "N", "kB", "why not"], rows, words=True),
        "N: members or particles in the rule of thumb. kB: memory of one belief.",
    ]


def _size(kilobytes: float | None) -> str:
    if kilobytes is None:
        return ""
    return f"{kilobytes:.0f}" if kilobytes >= 100 else f"{kilobytes:.3g}"
