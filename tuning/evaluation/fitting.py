"""Which filters can run on all problems of a comparison, which do so by default, and why others do not."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from filters.estimators.find import label_of
from filters.registry import FILTERS
from tuning.evaluation.baselines import rule_of_thumb
from tuning.problems.problem import Problem

DEFAULT_FILTERS = ("ekf", "enkf", "pf")
PARTICLES = "pf"
MOST_STATES = 6  # to which a thousand particles are spread by default: the number needed grows exponentially


def default_filters(problems: Sequence[Problem]) -> tuple[list[str], dict[str, str]]:
    """The filters of a comparison in which none is named, and by label why one is not among them."""
    n, problem = max(((len(one.quantities.states), one.name) for one in problems), default=(0, ""))
    if n <= MOST_STATES:
        return list(DEFAULT_FILTERS), {}
    why = f"by default particles are for up to {MOST_STATES} states, but {problem} has {n} (--filter {PARTICLES})"
    return [name for name in DEFAULT_FILTERS if name != PARTICLES], {PARTICLES: why}


def fitting(names: Iterable[Any], problems: Sequence[Problem]) -> tuple[list[Any], dict[str, str]]:
    """The filters that accept the models of all problems, and by label why the others do not.

    Args:
        names: of filters, or estimators.
        problems: the problems of the comparison.

    Raises:
        ValueError: for an estimator that does not accept a model, or cannot be read: only filters are left out.
    """
    kept: list[Any] = []
    left_out: dict[str, str] = {}
    for name in names:
        try:
            for problem in problems:
                rule_of_thumb(name, problem).filter(problem)
            kept.append(name)
        except ValueError as error:
            if not isinstance(name, str) or name not in FILTERS:
                raise
            left_out[label_of(name)] = str(error)
    return kept, left_out
