"""A method on a data set of a case, within a budget, and the best constant numbers that it is held against."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping
from contextlib import suppress
from functools import cache
from typing import Any, NamedTuple

import numpy as np

from tuning.evaluation.baselines import scaled_default
from tuning.evaluation.evaluate import compute_metrics
from tuning.evaluation.runs import metrics_of_all
from tuning.experiments.methods.problems import (
    FROM_NOISE,
    FULL,
    LIDAR_RUNS,
    LIDAR_SETS,
    ORACLE,
    REFERENCE,
    RUNS,
    SCALED,
    SECONDS,
    STARTS,
    STUDY,
    STUDY_LOG_SCORE,
    TRIALS,
    WITH_FULL,
    Case,
    Protocol,
    lidar,
)
from tuning.likelihood.family import DIFFERENTIABLE
from tuning.likelihood.gradient import optimum
from tuning.methods.registry import ALONE, find_method
from tuning.methods.task import Budget, Kept, Task
from tuning.problems.data import Data
from tuning.problems.problem import Problem
from tuning.search.objectives import LOG_SCORE, SCORE
from tuning.search.parameters import MeasurementVariance, ProcessVariance, model_parameters
from tuning.search.plan import Plan
from tuning.search.quiet import quiet_optuna
from tuning.search.space import Choice, oracle_choice, untuned_choice
from tuning.search.study import open_study, run_study

SIMPLEX = 400  # evaluations of a descent to the reference of an ensemble, which has no gradient


class Scored(NamedTuple):
    """A choice on the held-out runs."""

    score: float
    nees: float  # over the number of states
    nis: float  # over the number of channels
    log_likelihood: float  # a run
    log_score: float  # a step


class Result(NamedTuple):
    """A method on a data set: the error that it ended in, and what it would have given for each budget."""

    case: str
    method: str
    set: int
    by_runs: Mapping[str, Scored]
    by_seconds: Mapping[str, Scored]
    last: Scored | None  # None where the method cannot run
    taken_runs: float
    taken_seconds: float
    choice: Mapping[str, Any]
    error: str = ""


def data_set(case: Case, set_index: int) -> Data:
    """The runs of a data set, to learn from."""
    problem = case.make()
    if case.make is lidar:
        data = problem.data(range(32 * set_index, 32 * set_index + case.runs))
    else:
        data = problem.data(problem.training_seeds(set_index, max(case.runs, 2))).slice(0, case.runs)
    return data if case.truth else data._replace(states=None, outputs=None)


@cache
def _held_out(make: Callable[[], Problem], count: int) -> Data:
    problem = make()
    if make is lidar:
        first = 32 * LIDAR_SETS
        return problem.data(range(first, first + min(LIDAR_RUNS, 2 * count)))
    return problem.data(problem.held_out_seeds(0, count))


def scored(choice: Choice, case: Case, count: int) -> Scored:
    """A choice on the held-out runs."""
    problem, data = case.make(), _held_out(case.make, count)
    filter_ = choice.filter(problem)
    runs = metrics_of_all(filter_, data, True, False, problem.scale)
    evaluation = compute_metrics(filter_, runs, data, problem.scale, False, False)
    ratios = evaluation.nees.value / len(evaluation.rmse), evaluation.nis.value / evaluation.expected_nis
    return Scored(evaluation.score.value, *ratios, evaluation.log_likelihood, evaluation.log_score.value)


def start_of(case: Case, set_index: int) -> Choice:
    """Where a data set's methods begin."""
    problem, (on_q, on_r) = case.make(), STARTS[set_index % len(STARTS)]
    choice = untuned_choice(case.filter, problem)
    if case.members is not None:
        choice = choice.with_size(case.members)
    for parameter in model_parameters(problem, hold_r=case.options.get("hold_r", False)):
        factor = {ProcessVariance: on_q, MeasurementVariance: on_r}.get(type(parameter.place), 1.0)
        choice = parameter.set(
            choice, min(max(factor * (parameter.get(choice) or 1.0), parameter.low), parameter.high)
        )
    return choice


def run_method(case: Case, method: str, set_index: int, protocol: Protocol) -> Result:
    """A method on a data set."""
    data, error, label = data_set(case, set_index), "", method
    informed = method.endswith(FROM_NOISE)
    if informed or method.endswith(WITH_FULL):
        if case.options == FULL and not informed:
            return Result(
                case.name, label, set_index, {}, {}, None, 0.0, 0.0, {}, "all methods have full Q and R here"
            )
        method = method.removesuffix(FROM_NOISE).removesuffix(WITH_FULL)
        case = case._replace(options=FULL)
    try:
        _check(case, method, _task(case, data, set_index, Budget()))
    except ValueError as lacking:
        return Result(case.name, label, set_index, {}, {}, None, 0.0, 0.0, {}, str(lacking))
    if method in ALONE:  # so that nothing is left to compile
        with suppress(ValueError):
            find_method(method).run(method, _task(case, data.slice(0, 4), set_index, Budget(60, 5.0)))
    task = _task(case, data, set_index, Budget(protocol.runs, protocol.seconds))
    try:
        if informed:
            find_method("noise-estimation").run("noise-estimation", task)
            task.start = task.best
        _run(case, method, set_index, task)
    except ValueError as problem:
        error = str(problem) or type(problem).__name__
    cost = task.runs, task.seconds  # without that of scoring
    known: dict[int, Scored] = {}

    def at(choice: Choice) -> Scored:
        if id(choice) not in known:
            known[id(choice)] = scored(choice, case, protocol.held_out)
        return known[id(choice)]

    last = task.start if error else task.best
    by_runs = {
        f"{limit:g}": at(last if error else task.best_within(runs=limit))
        for limit in RUNS
        if limit <= protocol.runs
    }
    by_seconds = {
        f"{limit:g}": at(last if error else task.best_within(seconds=limit))
        for limit in SECONDS
        if limit <= protocol.seconds
    }
    return Result(case.name, label, set_index, by_runs, by_seconds, at(last), *cost, _plain(last), error)


def _task(case: Case, data: Data, set_index: int, budget: Budget) -> Task:
    arguments: dict[str, Any] = {"options": case.options, "budget": budget, "seed": set_index}
    return Task(case.filter, case.make(), data, start=start_of(case, set_index), **arguments)


def _check(case: Case, method: str, task: Task) -> None:
    """Raise ValueError if a case lacks what a method needs."""
    if method in ALONE:
        find_method(method).check(method, task)
    elif method == ORACLE and oracle_choice(case.filter, task.problems[0]) is None:
        raise ValueError("the plant's own Q and R are unknown")
    elif method in (STUDY, STUDY_LOG_SCORE) and (case.runs != 32 or case.group in "EG" or case.make is lidar):
        raise ValueError("a study draws its own runs, not these")


def _run(case: Case, method: str, set_index: int, task: Task) -> None:
    """Let a task keep what a method finds."""
    problem = task.problems[0]
    if method in ALONE:
        return find_method(method).run(method, task, guarded=False)
    choice: Choice | None = task.start
    if method == SCALED:
        choice = scaled_default(case.filter, problem, set_index).choice
    elif method == ORACLE:
        choice = oracle_choice(case.filter, problem)
    elif method in (STUDY, STUDY_LOG_SCORE):
        return _study(case, method, set_index, task)
    if choice is None:
        raise ValueError(f"there is no {method}")
    return task.keep(choice if case.members is None else choice.with_size(case.members))


def _study(case: Case, method: str, set_index: int, task: Task) -> None:
    """What `thruster tune` does, which draws runs of its own to choose among its best trials; in one piece."""
    objective = SCORE if method == STUDY else LOG_SCORE
    options: dict[str, Any] = dict(case.options)
    plan = Plan(case.filter, (case.make(),), set_index, (objective,), **options)
    with quiet_optuna():
        with task.uncounted():  # so that nothing is left to compile
            other = plan._replace(seed=set_index + 1000)
            run_study(open_study("first", other), other, 2)
        result = run_study(open_study("methods", plan), plan, TRIALS)
    task.runs += TRIALS * task.passes
    task.kept.append(Kept(task.runs, task.seconds, result.choice))


def reference(case: Case, protocol: Protocol) -> Result:
    """The best constant numbers: those with the least score on many runs, from many starts."""
    problem = case.make()
    if case.make is lidar:
        data = problem.data(range(32 * LIDAR_SETS))
    else:
        data = problem.data(range(10**8, 10**8 + protocol.many))
    start = start_of(case, 0)
    begin = time.process_time()
    task = Task(case.filter, problem, data, options=case.options, start=start)
    if case.filter in DIFFERENTIABLE:
        goal, best = task.goal(SCORE, keeps=False), None
        coordinates, rng = goal.coordinates, np.random.default_rng(0)
        first = coordinates.of(goal.untuned)
        for turn in range(protocol.starts):
            shifted = first + rng.uniform(-np.log(100.0), np.log(100.0), len(first)) * coordinates.log * (turn > 0)
            maximum = optimum(goal, np.clip(shifted, coordinates.low, coordinates.high))
            best = maximum if best is None or maximum.value > best.value else best
        assert best is not None
        choice = goal.choice_at(coordinates.of(best.parameters))
    else:
        least, choice = math.inf, start
        fewer = data.slice(0, min(protocol.many, 200))
        budget = Budget(SIMPLEX * len(fewer.seeds))
        starts = [start_of(case, turn) for turn in range(min(protocol.starts, len(STARTS)))]
        for turn, begun in enumerate(starts):
            if begun in starts[:turn]:
                continue
            simplex = Task(case.filter, problem, fewer, options=case.options, start=begun, budget=budget)
            find_method("nelder-mead").run("nelder-mead", simplex)
            value = simplex.value(simplex.best)
            if value < least:
                least, choice = value, simplex.best
    found_score, seconds = scored(choice, case, protocol.held_out), time.process_time() - begin
    return Result(case.name, REFERENCE, 0, {}, {}, found_score, 0.0, seconds, _plain(choice))


def _plain(choice: Choice) -> dict[str, Any]:
    """A choice as JSON has it."""
    content: dict[str, Any] = json.loads(
        json.dumps(choice._asdict(), default=lambda array: np.asarray(array).tolist())
    )
    return content
