"""What is seen on a bench for use elsewhere: a tuned file, Python lines, the command."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from thruster_env.core.checks import short_repr
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import write_tuned
from tuning.exploring.disturbed import AMPLIFIER, SENSORS
from tuning.problems.log_problem import LogProblem
from tuning.problems.plain import plain
from tuning.problems.plant_packages import built_in
from tuning.problems.problem import Problem
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
        files = [one["file"] for one in content["logs"]]
        options = f", {_arguments(content['options'])}" if content["options"] else ""
        return f"from tuning.logs.problem import log_problem\n\nproblem = log_problem({files!r}{options})"
    if base.name not in built_in() and not base.name.endswith(".toml") and ":" not in base.name:
        return f"\nproblem = ...  # {short_repr(base.name)}"
    found = f"from tuning.problems.find import find_problem\n\nproblem = find_problem({base.name!r})"
    if problem is base:
        return found
    changes = {name: plain(getattr(problem, name)) for name in CHANGED if _differs(base, problem, name)}
    return f"{found}.replace({_arguments(changes)})"


def _differs(base: Problem, problem: Problem, name: str) -> bool:
    return hasattr(problem, name) and getattr(problem, name) != getattr(base, name)


def _arguments(values: Mapping[str, Any]) -> str:
    return ", ".join(f"{name}={value!r}" for name, value in values.items())
