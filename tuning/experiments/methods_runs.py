"""The results of a protocol: each method on each data set of each case, within a budget.

Finished results are stored in files and never repeated. Regrets compare methods with the best constant numbers,
with intervals over data sets.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from filters.consistency.nees import Interval
from thruster_env.core.files import write_whole
from thruster_env.core.parallel import Where, task_map
from tuning.api.result import plain_data
from tuning.evaluation.baselines import scaled_default
from tuning.evaluation.evaluate import compute_metrics
from tuning.evaluation.runs import metrics_of_all
from tuning.experiments.methods_problems import (
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
from tuning.experiments.users import holm
from tuning.likelihood.gradient import optimum
from tuning.likelihood.parametric import DIFFERENTIABLE
from tuning.methods.task import ALONE, ONLY, Answer, Budget, Task, find_method
from tuning.problems.data import Data
from tuning.problems.problem import Problem
from tuning.search.parameters import MeasurementVariance, ProcessVariance, model_parameters
from tuning.search.plan import LOG_SCORE, SCORE, Plan
from tuning.search.space import Choice, oracle_choice, untuned_choice
from tuning.search.storage import quiet_optuna
from tuning.search.study import open_study, run_study

SIMPLEX = 400  # evaluations of a descent to the reference of an ensemble, which has no gradient
OnResult = Callable[[str, int, int], None]  # what is done, results so far, all
LEVEL = 0.05
EQUAL = 0.01  # of log ratios: "equal" is within 1 %


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
    by_runs: Mapping[str, Scored] = {}
    by_seconds: Mapping[str, Scored] = {}
    last: Scored | None = None  # None where the method cannot run
    taken_runs: float = 0.0
    taken_seconds: float = 0.0
    choice: Mapping[str, Any] = {}
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
            return Result(case.name, label, set_index, error="all methods have full Q and R here")
        method = method.removesuffix(FROM_NOISE).removesuffix(WITH_FULL)
        case = case._replace(options=FULL)
    try:
        _check(case, method, _task(case, data, set_index, Budget()))
    except ValueError as lacking:
        return Result(case.name, label, set_index, error=str(lacking))
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

    def by_budget(kind: str, limits: Sequence[float], most: float) -> dict[str, Scored]:
        budgets = [limit for limit in limits if limit <= most]
        return {f"{limit:g}": at(last if error else task.best_within(**{kind: limit})) for limit in budgets}

    by_runs = by_budget("runs", RUNS, protocol.runs)
    by_seconds = by_budget("seconds", SECONDS, protocol.seconds)
    choice = plain_data(last._asdict())
    return Result(case.name, label, set_index, by_runs, by_seconds, at(last), *cost, choice, error)


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
    task.answers.append(Answer(task.runs, task.seconds, result.choice))


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
            maximum = optimum(goal, coordinates.clip(shifted))
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
            simplex.budget = Budget()  # the search may have spent it, and its best is yet to be scored
            value = simplex.value(simplex.best)
            if value < least:
                least, choice = value, simplex.best
    found_score, seconds = scored(choice, case, protocol.held_out), time.process_time() - begin
    plain = plain_data(choice._asdict())
    return Result(case.model, REFERENCE, 0, last=found_score, taken_seconds=seconds, choice=plain)


def jobs_of(protocol: Protocol) -> Iterator[tuple[Case, str, int]]:
    """All that there is to do, one data set after the other, so that an early end leaves whole ones."""
    models = {case.model: case for case in reversed(protocol.cases)}
    yield from ((case, REFERENCE, 0) for case in protocol.cases if models[case.model] is case)
    for set_index in range(protocol.sets):
        yield from ((case, method, set_index) for case in protocol.cases for method in protocol.methods)


def run_protocol(
    protocol: Protocol,
    folder: Path,
    executor: Where = None,
    on_result: OnResult = lambda text, done, count: None,
) -> list[Result]:
    """Do what no file in the folder is there of, and return all results.

    Several hosts may share the folder: nothing in it is done again, and each file is written whole.

    Args:
        protocol: how much is done.
        folder: for a file a result.
        executor: as for `thruster_env.core.parallel.task_map`.
        on_result: called after each result.

    Raises:
        KeyboardInterrupt: on Ctrl-C; finished results are kept.
    """
    wanted = list(jobs_of(protocol))
    missing = [job for job in wanted if not file_of(folder, *job, protocol).is_file()]
    done = len(wanted) - len(missing)
    on_result("", done, len(wanted))
    with task_map(executor) as tasks:
        for index, content in tasks(content_of, [(*job, protocol, folder) for job in missing]):
            done, (case, method, _) = done + 1, missing[index]
            file = file_of(folder, *missing[index], protocol)
            if content is not None:
                file.parent.mkdir(parents=True, exist_ok=True)
                write_whole(file, json.dumps(content, indent=1))
            on_result(f"{case.name}, {method}", done, len(wanted))
    return read(folder, protocol)


def read(folder: Path, protocol: Protocol) -> list[Result]:
    """The results that are there."""
    results = []
    for case, method, set_index in jobs_of(protocol):
        file = file_of(folder, case, method, set_index, protocol)
        if file.is_file():
            result = _result(json.loads(file.read_text(encoding="utf-8")))
            results.append(result._replace(case=case.model) if method == REFERENCE else result)
    return results


def file_of(folder: Path, case: Case, method: str, set_index: int, protocol: Protocol) -> Path:
    """The file of a result, whose name says what it depends on."""

    def plain(text: str) -> str:
        return "".join(letter if letter.isalnum() else "-" for letter in text)

    if method == REFERENCE:
        return folder / plain(case.model) / f"{method}-{protocol.many}-{protocol.starts}-{protocol.held_out}.json"
    budget = f"{protocol.runs:g}-{protocol.seconds:g}-{protocol.held_out}"
    return folder / plain(case.name) / f"{plain(method.removesuffix(ONLY))}-{set_index}-{budget}.json"


def content_of(case: Case, method: str, set_index: int, protocol: Protocol, folder: Path) -> dict[str, Any] | None:
    """The content of a result's file; None if another host has written it meanwhile."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    if file_of(folder, case, method, set_index, protocol).is_file():
        return None
    return _as_data(
        reference(case, protocol) if method == REFERENCE else run_method(case, method, set_index, protocol)
    )


def _as_data(result: Result) -> dict[str, Any]:
    content = result._asdict()
    for name in ("by_runs", "by_seconds"):
        content[name] = {key: list(scored) for key, scored in content[name].items()}
    return content


def _result(content: dict[str, Any]) -> Result:
    """A result as `_as_data` has it; files of 2026 call the method `way`, and samplers have no "-only"."""
    name = content.pop("way", None) or content["method"]
    content["method"] = f"{name}{ONLY}" if f"{name}{ONLY}" in ALONE else name
    for name in ("by_runs", "by_seconds"):
        content[name] = {key: Scored(*map(_float, scored)) for key, scored in content[name].items()}
    last: Sequence[float] | None = content.pop("last")
    return Result(**content, last=None if last is None else Scored(*map(_float, last)))


def _float(value: float | None) -> float:
    return math.nan if value is None else float(value)


def within(kind: str, key: str) -> Callable[[Result], Scored | None]:
    """What of a result counts: what the method gave for a budget of "by_runs" or "by_seconds"."""
    return lambda result: getattr(result, kind).get(key)


class Regret(NamedTuple):
    """A method on the data sets of a case."""

    method: str
    ratio: (
        Interval  # score over that of the best constant numbers: mean of logarithms with Student's 95 % interval
    )
    median: float
    worst: float
    nees: float  # median over data sets, over the number of states
    nis: float
    log_score: float  # mean loss a step against the best constant numbers of least error [nat]
    failures: int
    sets: int
    runs: float  # median of what it took
    seconds: float
    worse: bool = False  # significantly worse than the best method of the case, by Holm's procedure at 5 %

    @property
    def equal(self) -> bool:
        """Whether it is equal to the best constant numbers: within 1 % for sure."""
        return self.ratio.low > math.exp(-EQUAL) and self.ratio.high < math.exp(EQUAL)


def regrets(
    results: Sequence[Result], case: Case, at: Callable[[Result], Scored | None] = lambda result: result.last
) -> list[Regret]:
    """The methods that a case allows, the best first; those with fewer data sets than the others, too.

    Args:
        results: of a protocol.
        case: of it.
        at: what of a result counts, by default what the method gave in the end.
    """
    reference = reference_of(results, case)
    if reference is None:
        return []
    logs: dict[str, dict[int, float]] = {}
    regrets_, by_method = [], _by_method(results, case)
    for method, of_method in by_method.items():
        scores = {result.set: at(result) for result in of_method}
        logs[method] = {
            set_index: math.log(scored.score / reference.score)
            for set_index, scored in scores.items()
            if scored is not None
        }
        values = np.array(list(logs[method].values()))
        if not len(values):
            continue
        valid = [scored for scored in scores.values() if scored is not None]
        ratios = _exp(student(values)), math.exp(float(np.median(values))), math.exp(float(values.max()))
        nees, nis = np.median([(scored.nees, scored.nis) for scored in valid], axis=0).tolist()
        loss = reference.log_score - float(np.mean([scored.log_score for scored in valid]))
        counts = sum(bool(result.error) for result in of_method), len(values)
        cost = np.median([(result.taken_runs, result.taken_seconds) for result in of_method], axis=0).tolist()
        regrets_.append(Regret(method, *ratios, nees, nis, loss, *counts, cost[0], cost[1]))
    regrets_.sort(key=lambda regret: regret.ratio.value)
    worse = holm([chance(logs[regret.method], logs[regrets_[0].method]) for regret in regrets_], LEVEL)
    return [regret._replace(worse=is_worse) for regret, is_worse in zip(regrets_, worse, strict=True)]


def reference_of(results: Sequence[Result], case: Case) -> Scored | None:
    """What the best constant numbers of a case have, which cases that differ in their data share."""
    of_model = (result for result in results if result.method == REFERENCE and result.case == case.model)
    return next((result.last for result in of_model), None)


def _by_method(results: Iterable[Result], case: Case) -> dict[str, list[Result]]:
    by_method: dict[str, list[Result]] = {}
    for result in results:
        if result.case == case.name and result.method != REFERENCE and result.last is not None:
            by_method.setdefault(result.method, []).append(result)
    return by_method


def student(values: np.ndarray) -> Interval:
    """The mean of some values with Student's 95 % interval; without ends for a single one."""
    from scipy.special import stdtrit

    mean = float(values.mean())
    if len(values) < 2:
        return Interval(mean, -math.inf, math.inf)
    half = float(stdtrit(len(values) - 1, 1.0 - LEVEL / 2.0)) * float(values.std(ddof=1)) / math.sqrt(len(values))
    return Interval(mean, mean - half, mean + half)


def chance(logs: dict[int, float], best: dict[int, float]) -> float:
    """One-sided p-value of "no worse than the best", by Student's test of differences paired by data set."""
    from scipy.special import stdtr

    shared = [set_index for set_index in logs if set_index in best]
    differences = np.array([logs[set_index] - best[set_index] for set_index in shared])
    if len(differences) < 2 or not differences.any():
        return 1.0
    error = differences.std(ddof=1) / math.sqrt(len(differences))
    if error == 0.0:
        return 0.0 if differences[0] > 0 else 1.0
    return float(stdtr(len(differences) - 1, -differences.mean() / error))


def _exp(interval: Interval) -> Interval:
    return Interval(*(math.exp(min(end, 700.0)) for end in interval))
