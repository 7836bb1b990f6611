"""`tuning.evaluate`: a filter, tuned or not, beside its baselines on seeds that no study saw."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from tuning.api.held_out import HeldOut, on_held_out
from tuning.api.problems import given_for, is_filter, problem_of
from tuning.api.progress import console_for
from tuning.api.study import Study, is_own, user_choice
from tuning.evaluation.baselines import OWN, TUNED, rule_of_thumb
from tuning.evaluation.tuned import read_choice, read_tuned, suited_to
from tuning.problems.assumed import constants_in, suited
from tuning.problems.problem import Problem
from tuning.search.plan import HELD_OUT_SEEDS
from tuning.search.space import Choice

NOMINAL = "nominal"  # the problem of a filter that is not tuned, where none is named


def evaluate(
    tuned: str | Path | Study,
    problem: Any = None,
    *,
    seeds: int = HELD_OUT_SEEDS,
    seed: int = 0,
    preset: str | Path | None = None,
    model: Any = None,
    progress: bool | None = None,
) -> HeldOut:
    """Run a filter and its baselines on held-out seeds of a problem.

    The rule of thumb takes R from the sensor's data sheet and Q from 1 % of each state's range. The scaled default
    is the same with one factor on Q that brings the mean NIS to 1. The oracle has the plant's own Q and R.

        evaluation = tuning.evaluate("tuned.json", seeds=50)
        evaluation.to_frame()

    Args:
        tuned: a tuned file, a `Study`, or the name of a filter, which gets the rule of thumb. Or your
            own parameters: a filter, as `make_filter("ekf", model)`, or a `StateSpaceModel` with its own Q and R.
        problem: a name, a `Problem`, "module:object" or a pair (model, data); by default that of the
            tuned file, or "nominal" for the name of a filter.
        seeds: number of held-out seeds, for problems that can generate any number.
        seed: of the study to which they belong.
        preset: the problem of another thruster, by name or file; of a tuned file alone its own preset.
        model: of the logs of a tuned file, if it is code: a model, what makes or offers one, or "module:object".
        progress: whether to show progress; by default only in terminals and notebooks.

    Returns:
        `HeldOut`: `evaluations` by name, `ratios`, `bound`, `to_frame()`, `plot_errors()`.

    Raises:
        ValueError: states the rule and the value.
    """
    choice, chosen, is_tuned = subject_of(tuned, problem, preset, model)
    name = OWN if is_own(tuned) else TUNED
    return on_held_out(choice, chosen, seed, seeds, is_tuned=is_tuned, console=console_for(progress), name=name)


def subject_of(
    tuned: Any,
    problem: Any = None,
    preset: str | Path | None = None,
    model: Any = None,
) -> tuple[Choice, Problem, bool]:
    """The choice, the problem, and whether it was tuned; the arguments are those of `evaluate`."""
    if isinstance(tuned, Study):
        chosen = problem_of(tuned.problem if problem is None else problem, preset)
        return tuned.choice, suited(chosen, constants_in(tuned.problem)), True
    if is_own(tuned):
        if problem is None:
            raise ValueError(f"a filter or model must come with a problem, but got {type(tuned).__name__} alone")
        chosen = problem_of(problem, preset)
        return user_choice(tuned, chosen), chosen, True
    if is_filter(tuned):
        chosen = problem_of(NOMINAL if problem is None else problem, preset)
        return rule_of_thumb(tuned, chosen), chosen, False
    if problem is None:
        choice, chosen, _ = read_tuned(tuned, given_for(tuned, model=model, preset=preset))
        return choice, chosen, True
    chosen = suited_to(tuned, problem_of(problem, preset))
    return read_choice(tuned, chosen), chosen, True
