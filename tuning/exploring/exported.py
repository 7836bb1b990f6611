"""What is seen on a bench for use elsewhere: a tuned file, Python lines, the command."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

from filters.filter import Filter
from thruster_env.core.checks import short_repr
from tuning.evaluation.evaluate import values_of
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import write_tuned
from tuning.exploring.knobs import AMPLIFIER, SENSORS, Knob
from tuning.problems.data import Data
from tuning.problems.log_problem import LogProblem
from tuning.problems.plant_packages import built_in
from tuning.problems.problem import Problem
from tuning.problems.scenario import plain
from tuning.search.objectives import LIKELIHOOD, SCORE, find_objective, nis_ratio
from tuning.search.plan import Plan
from tuning.search.space import Choice
from tuning.search.study import StudyResult

CHANGED = (SENSORS, AMPLIFIER)  # fields of a scenario that a bench changes
BY_HAND = "by hand"  # the method of a tuned file whose numbers a person chose
LINES = """from filters import make_filter
{problem}
model = problem.model({model})
filter_ = make_filter({numbers})
"""


def file_of(choice: Choice, plan: Plan) -> str:
    """The tuned file of numbers that were chosen by hand, with their held-out evaluation."""
    result = StudyResult(choice, float("nan"), [], [], 0.0, False)
    comparisons = [evaluate_held_out(choice, problem, plan.seed) for problem in plan.scenarios]
    with TemporaryDirectory() as folder:
        path = Path(folder) / "tuned.json"
        write_tuned(path, plan, result, comparisons, BY_HAND, BY_HAND)
        return path.read_text(encoding="utf-8")


def command_of(problem: Problem, file: str) -> str:
    """The command that evaluates a tuned file on held-out seeds or blocks."""
    model = (
        (problem.as_mapping() or {}).get("options", {}).get("model") if isinstance(problem, LogProblem) else None
    )
    return f"thruster evaluate {file}" + (f" --model {model}" if model else "")


def lines_of(choice: Choice, base: Problem, problem: Problem) -> str:
    """Python lines that make a filter of some numbers.

    Args:
        choice: the numbers.
        base: the problem as it is found.
        problem: the same with other disturbances.
    """
    return LINES.format(
        problem=_found(base, problem),
        model=_arguments(choice.model),
        numbers=", ".join(part for part in (repr(choice.name), "model", _arguments(choice.numbers)) if part),
    )


def _found(base: Problem, problem: Problem) -> str:
    """Lines that find a problem."""
    if isinstance(base, LogProblem):
        content = base.as_mapping()
        if content is None:
            return "\nproblem = ...  # of these logs"
        files = [log["file"] for log in content["logs"]]
        options = f", {_arguments(content['options'])}" if content["options"] else ""
        return f"from tuning.logs.problem import log_problem\n\nproblem = log_problem({files!r}{options})"
    if base.name not in built_in() and not base.name.endswith(".toml") and ":" not in base.name:
        return f"\nproblem = ...  # {short_repr(base.name)}"
    lines = f"from tuning.problems.find import find_problem\n\nproblem = find_problem({base.name!r})"
    if problem is base:
        return lines
    changes = {name: plain(getattr(problem, name)) for name in CHANGED if _differs(base, problem, name)}
    return f"{lines}.replace({_arguments(changes)})"


def _differs(base: Problem, problem: Problem, name: str) -> bool:
    return hasattr(problem, name) and getattr(problem, name) != getattr(base, name)


def _arguments(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in values.items())


# A map: score and NIS of a filter over two of its numbers.


class Map(NamedTuple):
    """Score and NIS at each pair of values of two knobs."""

    x: str  # name of the knob
    y: str
    xs: np.ndarray  # (size,), of a whole number its different values, which may be fewer
    ys: np.ndarray  # (size,)
    score: np.ndarray  # (y, x); negative log-likelihood of a run where there is no truth
    nis: np.ndarray  # (y, x), the mean NIS over its expected value: 1 is right; NaN without a covariance


def values_along(knob: Knob, size: int) -> np.ndarray:
    """Values over the range of a knob, on its scale."""
    values = (np.geomspace if knob.log else np.linspace)(knob.low, knob.high, size)
    return np.unique(np.rint(values)) if knob.integer else np.clip(values, knob.low, knob.high)


def map_of(x: Knob, y: Knob, size: int, case: Callable[[float, float], tuple[Filter, Data]], scale) -> Map:
    """Run a filter at each point of the map.

    Args:
        x: the knob along the rows.
        y: the other one.
        size: number of values of each.
        case: the filter at a value of each, and its data.
        scale: of the score, (n,); None without truth.
    """
    xs, ys = values_along(x, size), values_along(y, size)
    figures = np.empty((2, len(ys), len(xs)))
    objective = find_objective(LIKELIHOOD if scale is None else SCORE)

    for row, column in np.ndindex(len(ys), len(xs)):
        evaluation = values_of(*case(xs[column].item(), ys[row].item()), scale)
        figures[:, row, column] = objective.value(evaluation, np.nan), nis_ratio(evaluation)
    return Map(x.name, y.name, xs, ys, *figures)
