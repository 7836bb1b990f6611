"""Which filters can run on all problems of a comparison, and why others cannot."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

from filters.estimators.find import label_of
from tuning.evaluation.baselines import rule_of_thumb
from tuning.problems.problem import Problem


def fitting(names: Iterable[Any], problems: Sequence[Problem]) -> tuple[list[Any], dict[str, str]]:
    """The filters that accept the models of all problems, and by label why the others do not.

    Args:
        names: of filters, or estimators.
        problems: the problems of the comparison.
    """
    kept: list[Any] = []
    left_out: dict[str, str] = {}
    for name in names:
        try:
            for problem in problems:
                rule_of_thumb(name, problem).filter(problem)
            kept.append(name)
        except ValueError as error:
            left_out[label_of(name)] = str(error)
    return kept, left_out
