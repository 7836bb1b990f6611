"""`tuning.evaluate` and `thruster evaluate`: a filter, tuned or not, on seeds that no study saw."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from rich.console import Console

from filters.consistency.nees import Interval, rmse_ratios
from filters.estimators.foreign import label_of
from filters.registry import filter_type
from thruster_env.core.checks import short_repr
from thruster_env.core.files import check_target
from thruster_env.core.parallel import IN_PROCESS, TaskMap, task_map
from thruster_env.logs.write import check_picture
from tuning.api.held_out import CovarianceCheck, HeldOut
from tuning.api.markers import (
    FILTER,
    RUNS,
    ExecutorOption,
    FilterOption,
    Model,
    OneProblem,
    Option,
    Preset,
    Progress,
    Seed,
    TunedArgument,
    WrittenFile,
)
from tuning.api.problems import given_for, is_filter, problem_of
from tuning.api.progress import console_for, working
from tuning.api.study import DEFAULT_FILTER, Study, is_own, user_choice
from tuning.evaluation.baselines import GIVEN, ORACLE, OWN, TUNED, given_noise, rule_of_thumb
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import read_choice, read_tuned, suited_to
from tuning.problems.assumed import constants_in, suited
from tuning.problems.problem import Problem
from tuning.search.plan import HELD_OUT_SEEDS
from tuning.search.space import Choice

NOMINAL = "nominal"  # the problem of a filter that is not tuned, where none is named


def evaluate(
    tuned: Annotated[str | Path | Study | None, TunedArgument] = None,
    problem: OneProblem = None,
    *,
    filter: Annotated[Any, FilterOption] = None,
    given: Annotated[bool, Option(FILTER)] = False,
    seeds: Annotated[int, Option(RUNS)] = HELD_OUT_SEEDS,
    consistency: WrittenFile = None,
    preset: Preset = None,
    model: Model = None,
    seed: Seed = 0,
    executor: ExecutorOption = None,
    progress: Progress = None,
) -> HeldOut:
    """Run a filter on held-out seeds of a problem and compare it with its baselines.

    The rule of thumb takes R from the sensor's data sheet and Q from 1 % of each state's range. The scaled default
    is the same with one factor on Q that brings the mean NIS (normalised innovation squared) to 1. The oracle has
    the plant's own Q and R.

        evaluation = tuning.evaluate("tuned.json", seeds=50)
        evaluation.to_frame()

    `consistency` compares a filter's errors and innovations with its covariances: NEES, NIS, whiteness, coverage,
    CRPS and, for ensembles, rank histograms, with a sentence on each and one picture.

    Example: thruster evaluate out/enkf-mismatch-seed0.json

    Example: thruster evaluate --filter enkf --scenario mismatch --consistency calibrated.png

    Args:
        tuned: tuned file, which names filter, parameters and problem. In Python also a `Study`, the name of a
            filter, or your own parameters: a filter, as `make_filter("ekf", model)`, or a `StateSpaceModel` with
            its own Q and R.
        problem: name of a problem, by default that of the tuned file, or nominal. In Python also a `Problem`,
            `tuning.read_logs(...)` or a pair (model, data).
        filter: without a tuned file, the name of a filter, as `thruster filters` lists them.
        given: use the Q and R of the problem's model instead of the rule of thumb, in an ekf unless `filter` names
            another one.
        seeds: number of held-out seeds.
        consistency: also check whether the filter's covariance is consistent, and draw it: .png, .svg or .pdf.
        preset: the problem of another thruster, or the present place of a tuned file's preset.
        model: the model of the logs that it was tuned on, if that is code. In Python also what makes or offers
            one.
        seed: seed of all randomness; the same seed gives the same results.
        executor: where parts run: in N processes, in those of `mpirun`, or on a Dask scheduler's workers; in this
            process by default. In Python also any `concurrent.futures.Executor`.
        progress: whether to show progress; by default only in terminals and notebooks.

    Returns:
        `HeldOut`: `evaluations` by name, `ratios`, `bound`, `to_frame()`, `plot_errors()`.

    Raises:
        ValueError: states the rule and the value.
    """
    if given and tuned is not None:
        raise ValueError(f"given (--given) must come without a tuned file, but got both, with {short_repr(tuned)}")
    filter = DEFAULT_FILTER if given and filter is None else filter
    if (tuned is None) == (filter is None):
        got = "none" if tuned is None else f"both, {short_repr(tuned)} and {short_repr(filter)}"
        raise ValueError(f"give either a tuned file or a filter (--filter NAME), but got {got}")
    choice, chosen, is_tuned = subject_of(filter if tuned is None else tuned, problem, preset, model)
    choice = with_given(choice.name, chosen) if given else choice
    if consistency is not None:
        check_picture(consistency, "--consistency")
        if not choice.filter(chosen).has_covariance:
            rule = "consistency (--consistency) must be of a filter with a covariance"
            raise ValueError(f"{rule}, but got {choice.name!r}")
        check_target(consistency)
    name, console = OWN if is_own(tuned) else TUNED, console_for(progress)
    with task_map(executor) as tasks:
        options: dict[str, Any] = {"is_tuned": is_tuned, "console": console, "name": name, "tasks": tasks}
        evaluation = on_held_out(choice, chosen, seed, seeds, **options)
    if consistency is None:
        return evaluation
    label = evaluation.name if is_tuned else GIVEN if given else evaluation.comparison.rule
    with working("checking the covariance", console):
        return replace(evaluation, covariance=covariance_check(evaluation, label, consistency))


def with_given(name: str, problem: Problem) -> Choice:
    """The filter with the given Q and R of the problem's model; ValueError if there are none."""
    if not filter_type(name).has_covariance:
        raise ValueError(f"given (--given) must be used with a filter that has a Q and R, but got {name}")
    choice = given_noise(name, problem)
    if choice is None:
        rule = "given (--given) must be used with a problem whose model has a given Q and R"
        raise ValueError(f"{rule}, but got {problem.name}")
    return choice


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


def covariance_check(evaluation: HeldOut, label: str, path: str | Path) -> CovarianceCheck:
    """Check the covariance of an evaluated filter, called `label`, and draw the checks."""
    from thruster_env.core.files import save_figure
    from tuning.reporting.search_figures import draw_consistency

    report, comparison = evaluation.check_consistency(), evaluation.comparison
    ratios: Sequence[Interval] | None = None
    against: dict[str, Any] = {}
    if report.has_truth and comparison.true is not None:
        ratios = rmse_ratios(comparison.tuned.mean_squares, comparison.true.mean_squares, comparison.tuned.weights)
        against[f"{label}\nover {ORACLE}"] = ratios
    title = f"{evaluation.choice.name}, {label}, on {report.runs} seeds of {evaluation.problem.name}"
    save_figure(draw_consistency(report, title, against, comparison.tuned.scored or None), path)
    return CovarianceCheck(label, report, ratios, str(path))


def on_held_out(
    choice: Choice,
    problem: Problem,
    seed: int = 0,
    seeds: int = HELD_OUT_SEEDS,
    *,
    is_tuned: bool,
    console: Console,
    name: str = TUNED,
    tasks: TaskMap = IN_PROCESS,
) -> HeldOut:
    """Run a choice and its baselines on held-out seeds; arguments as in `HeldOut` and `evaluate_held_out`."""
    with working(f"{label_of(choice.name)} on {seeds} seeds of {problem.name}", console):
        comparison = evaluate_held_out(choice, problem, seed, seeds, tasks)
    return HeldOut(choice, problem, comparison, is_tuned, seed, name)
