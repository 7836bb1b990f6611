"""One trial of a study: the same seeds for all trials, in blocks, and pruning.

In order: the pruner, which ends trials that are significantly worse than the best one; the cost of a filter's step
against a budget; the run of a trial; its outcome.
"""

from __future__ import annotations

import importlib.util
import io
import math
import pickle
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from numbers import Real
from statistics import geometric_mean
from types import MappingProxyType
from typing import Any

import numpy as np
import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution
from optuna.trial import FrozenTrial, TrialState

from filters.engine.batch import run
from filters.filter import Filter
from thruster_env.core.checks import one_of
from thruster_env.core.modules import to_install
from thruster_env.core.streams import LOCAL_TRIALS, derived_generator
from tuning.evaluation.evaluate import Evaluation, compute_metrics, run_scores
from tuning.evaluation.runs import RunMetrics, joined, metrics_of_all
from tuning.problems.data import Data
from tuning.search.plan import (
    LARGEST,
    LOG_SCORES,
    NEES,
    SCORE,
    VARIANCES,
    Plan,
    nis_ratio,
    nis_violation,
    penalised,
)
from tuning.search.space import FILTER_TYPE, Choice, suggest

BLOCK = 8  # seeds between two decisions whether to prune
RUNS, STEPS = 32, 200  # of each timed call
FEWEST, MOST = 3, 15  # timed calls, of which the median is taken ...
ENOUGH_SECONDS = 0.1  # ... and which end early after this time
BUDGET = "cost a step over the budget"  # name of the constraint; at most zero within
COST = "microseconds a step"  # trial attribute
CONSISTENCY = "mean NIS outside its band"  # name of the constraint; at most zero is inside
NIS = "mean NIS over the number of channels"
NEAR = 2e-5  # relative difference of parameters, above which trials are certainly not equal


def microseconds_a_step(filter_: Filter, data: Data) -> float:
    """Time of one core for a step of one run [us/step]: the median of several calls over a batch.

    It is processor time, summed over the cores that the batch uses: waiting for other processes and workers is
    not included. A first short call, which may compile, is not timed.
    """
    run(filter_, *_part(data, 2, 2))
    part = _part(data, RUNS, STEPS)
    seconds: list[float] = []
    while len(seconds) < FEWEST or (len(seconds) < MOST and sum(seconds) < ENOUGH_SECONDS):
        begin = time.process_time()
        run(filter_, *part)
        seconds.append(time.process_time() - begin)
    return 1e6 * float(np.median(seconds)) / part[2][..., 0].size


def _part(data: Data, runs: int, steps: int) -> tuple[np.ndarray, ...]:
    data = data.slice(0, runs).seen
    return data.filter_keys[:runs], data.inputs[:runs, :steps], data.measurements[:runs, : steps + 1]


def over_budget(microseconds: float, budget: float) -> float:
    """Logarithm of the cost over the budget; at most zero within the budget, as Optuna expects it."""
    return math.log(microseconds / budget)


def run_trial(
    trial: optuna.Trial,
    plan: Plan,
    data: Sequence[Data],
    space: Mapping[str, BaseDistribution],
    on_choice: Callable[[Choice], None] = lambda choice: None,
) -> list[float]:
    """Values of a trial, one for each objective.

    Args:
        trial: from Optuna.
        plan: of the study.
        data: the plan's training data.
        space: the plan's space.
        on_choice: called with the choice of the trial.

    Raises:
        optuna.TrialPruned: if it is over the plan's budget, or significantly worse than the best one on the seeds
            so far.
    """
    choice = plan.forgetting(suggest(trial, plan.filter, plan.scenarios[0], space, plan.where))
    on_choice(choice)
    microseconds = math.nan
    if plan.asks_for_cost:
        microseconds = cost_of(choice, plan, data)
        trial.set_user_attr(COST, microseconds)
    if plan.budget is not None:
        trial.set_constraint(BUDGET, over_budget(microseconds, plan.budget))
        if microseconds > plan.budget:
            raise optuna.TrialPruned
    prunes = plan.prune and plan.objectives == (SCORE,) and not plan.worst
    evaluations = measure(choice, plan, data, trial if prunes else None)
    if plan.is_constrained:
        outside = max(map(nis_violation, evaluations))
        trial.set_constraint(CONSISTENCY, outside)
        if outside < LARGEST:  # otherwise there is no finite NIS
            trial.set_user_attr(NIS, geometric_mean(map(nis_ratio, evaluations)))
    of_all = max if plan.worst else np.mean
    return [
        float(of_all([penalised(objective.value(e, microseconds), e) for e in evaluations]))
        for objective in plan.found_objectives()
    ]


def cost_of(choice: Choice, plan: Plan, data: Sequence[Data]) -> float:
    """Cost of a choice [us/step], on the scenario where it is largest."""
    pairs = zip(plan.scenarios, data, strict=True)
    return max(microseconds_a_step(choice.filter(scenario), problem_data) for scenario, problem_data in pairs)


def measure(
    choice: Choice, plan: Plan, data: Sequence[Data], trial: optuna.Trial | None = None
) -> list[Evaluation]:
    """Run a choice on all data; with a trial, report each seed's score to it and stop if it should be pruned.

    All runs of all problems count. If problems have different numbers of runs, each reported score is of
    equal shares of the problems' runs: one run of the smallest problem, and the mean of several of the others'.

    The NEES and errors of outputs are computed if an objective needs them, intervals never.
    """
    objectives = plan.found_objectives()
    needs = {need for objective in objectives for need in objective.needs}
    nees, outputs = NEES in needs, any(objective.output for objective in objectives)
    scales = [scenario.scale if LOG_SCORES in needs else None for scenario in plan.scenarios]
    filters = [choice.filter(scenario) for scenario in plan.scenarios]
    count = min(len(problem_data.seeds) for problem_data in data)
    size = count if trial is None else BLOCK
    ends = [shares(len(problem_data.seeds), count) for problem_data in data]
    parts: list[list[RunMetrics]] = [[] for _ in filters]
    for first in range(0, count, size):
        last = min(first + size, count)
        for runs, filter_, problem_data, bounds, scale in zip(parts, filters, data, ends, scales, strict=True):
            runs.append(
                metrics_of_all(filter_, problem_data.slice(bounds[first], bounds[last]), nees, outputs, scale)
            )
        if trial is not None:
            _report(trial, first, last, [runs[-1] for runs in parts], ends, plan)
            if last < count and trial.should_prune():
                raise optuna.TrialPruned
    rows = zip(filters, map(joined, parts), data, plan.scenarios, strict=True)
    return [
        compute_metrics(filter_, runs, problem_data, scenario.scale, False, VARIANCES in needs)
        for filter_, runs, problem_data, scenario in rows
    ]


def shares(runs: int, count: int) -> list[int]:
    """Ends of `count` nearly equal shares of some runs: share i is ends[i] up to, but without, ends[i + 1]."""
    return [i * runs // count for i in range(count + 1)]


def _report(
    trial: optuna.Trial, first: int, last: int, parts: list[RunMetrics], ends: list[list[int]], plan: Plan
) -> None:
    """Report the mean over problems of the scores of their shares `first` up to, without, `last`."""
    scores = []
    for runs, scenario, bounds in zip(parts, plan.scenarios, ends, strict=True):
        begin = np.subtract(bounds[first:last], bounds[first])
        sizes = np.diff(bounds[first : last + 1])
        scores.append(np.add.reduceat(run_scores(runs, scenario.scale), begin) / sizes)
    for index, score in enumerate(np.mean(scores, axis=0)):
        trial.report(float(score), first + index)


def best_trial(trials: Sequence[FrozenTrial]) -> FrozenTrial | None:
    """The complete trial with the lowest first objective, among the consistent ones if there are any.

    A trial over the budget is never complete. If no trial is consistent, the distance of the mean NIS from its
    band is ignored: an estimate that is many times worse can be closer to it.
    """
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    complete.sort(key=lambda trial: trial.values[0])  # so that few are asked for their constraints
    return next(filter(is_consistent, complete), complete[0] if complete else None)


def is_consistent(trial: FrozenTrial) -> bool:
    """Whether a trial's mean NIS is inside its band; true without a band."""
    return violation(trial) <= 0


def violation(trial: FrozenTrial) -> float:
    """Logarithmic distance of a trial's mean NIS from its band; at most zero inside, or without a band."""
    return trial.constraints.get(CONSISTENCY, 0.0)


def is_over_budget(trial: FrozenTrial) -> bool:
    """Whether a trial ended because its filter is over the budget."""
    return trial.constraints.get(BUDGET, 0.0) > 0


def enqueue_new(study: optuna.Study, parameters: dict, attributes: dict) -> None:
    """Enqueue a trial unless there is one with these parameters.

    Optuna compares it with all trials, one parameter at a time by NumPy: so it is asked only where one is near.
    """
    trials = study.get_trials(deepcopy=False)
    near = any(not trial.state.is_finished() or is_near(trial.params, parameters) for trial in trials)
    study.enqueue_trial(parameters, user_attrs=attributes, skip_if_exists=near)


def is_near(parameters: dict, other: dict) -> bool:
    """Whether no parameter that both have differs by more than what Optuna takes as equal, 1e-5."""
    for name, value in other.items():
        if isinstance(value, Real) and isinstance(parameters.get(name, ""), Real):
            if not math.isclose(value, parameters[name], rel_tol=NEAR):
                return False
        elif name in parameters and parameters[name] != value:
            return False
    return True


# Optuna's samplers by name, for ranges so wide that they contain any truth and mostly implausible values.
#
# They draw Q and R within a box about the best trial, and every second trial of the default sampler is near that
# trial. The state of CMA-ES, a pickle in the study, is read safely.


MARGIN = 10.0  # factor by which the box reaches beyond the best trial
SAMPLERS = {
    "tpe": "tree-structured Parzen estimator, all parameters together; good from some ten trials on",
    "gp": "Gaussian process; the fewest trials, but 0.1 to 0.4 s for each proposal (needs torch)",
    "cma-es": "covariance matrix adaptation; good for many trials of a smooth error (needs cmaes)",
    "nsga-ii": "genetic, made for two objectives",
    "random": "independent draws, which every other sampler should beat",
    "grid": "every combination of some values of each parameter, in random order",
}
WITHOUT_FILTER_TYPES = ("cma-es", "grid")  # cannot choose among filter types with parameters of their own
GRID_VALUES = 5  # of each parameter
NOTHING: Mapping = MappingProxyType({})
NEEDS = {"gp": ("torch", "rl"), "cma-es": ("cmaes", "samplers")}

# Of a trial near the best one.
LARGEST_STEP = (
    0.1  # step over the width of a linear range; over a decade of a logarithmic one it is ten times this ...
)
DECADES = 1.5  # ... and the smallest step is so many powers of ten below
MOVED = 0.5  # probability that a number is moved
_OPTIMIZERS = ("CMA", "SepCMA", "CMAwM")


def box(
    space: Mapping[str, BaseDistribution], first: Mapping[str, tuple[float, float]], best: Mapping[str, Any]
) -> dict[str, BaseDistribution]:
    """The distributions of a space, those of Q and R within their box.

    A side is the initial one or ten times beyond the best trial, whichever is farther, within the range.

    Args:
        space: distributions by name.
        first: the part of a range in which the search begins, by name, for those that have one.
        best: parameters of the best trial; empty before there is one.
    """
    limited = dict(space)
    for name, (low, high) in first.items():
        distribution = space.get(name)
        if isinstance(distribution, FloatDistribution):
            if name in best:
                low, high = min(low, best[name] / MARGIN), max(high, best[name] * MARGIN)
            limited[name] = FloatDistribution(
                max(low, distribution.low), min(high, distribution.high), log=distribution.log
            )
    return limited


class InBox:
    """A sampler that draws within the box, which does not limit enqueued trials and those near the best one."""

    def __init__(self, first: Mapping[str, tuple[float, float]], **options):
        """Remember where the search begins."""
        super().__init__(**options)
        self._first = first

    def infer_relative_search_space(self, study: optuna.Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        """The parameters sampled together, within the box."""
        space = super().infer_relative_search_space(study, trial)  # type: ignore[misc]  # of the sampler
        return self._box(study, space)

    def sample_independent(
        self, study: optuna.Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        """A value of one parameter, within the box."""
        within = self._box(study, {param_name: param_distribution})[param_name]
        return super().sample_independent(study, trial, param_name, within)  # type: ignore[misc]

    def _box(self, study: optuna.Study, space: Mapping[str, BaseDistribution]) -> dict[str, BaseDistribution]:
        best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
        return box(space, self._first, {} if best is None else best.params)


class TpeInBox(InBox, optuna.samplers.TPESampler):
    """The tree-structured Parzen estimator, within the box."""


class GpInBox(InBox, optuna.samplers.GPSampler):
    """The Gaussian process, within the box."""


class RandomInBox(InBox, optuna.samplers.RandomSampler):
    """Independent draws, within the box."""


# The classes in the state of an optimizer of `cmaes`. Any pickle may name any function of any module, and call it.
_ARRAYS = {("numpy", "ndarray"), ("numpy", "dtype")} | {
    (f"numpy.{core}.{module}", name)
    for core in ("_core", "core")  # of NumPy 2 and 1
    for module, name in (("multiarray", "_reconstruct"), ("multiarray", "scalar"), ("numeric", "_frombuffer"))
}


class CmaEsSampler(optuna.samplers.CmaEsSampler):
    """`optuna.samplers.CmaEsSampler` that reads only its own state from a journal or database.

    Optuna unpickles the state in a study's trials, so another person's study could run code.
    """

    def _restore_optimizer(self, completed_trials: list[FrozenTrial]):
        key = self._attr_key_optimizer
        for trial in reversed(completed_trials):
            parts = {name: value for name, value in trial.system_attrs.items() if name.startswith(key)}
            if parts:
                return read_state(self._concat_optimizer_attrs(parts))
        return None


def read_state(text: str):
    """The optimizer stored in a study, a pickle as hexadecimal digits.

    Raises:
        ValueError: if it is not such a state, or names anything but an optimizer of `cmaes` and arrays of NumPy.
    """
    try:
        return _Unpickler(io.BytesIO(bytes.fromhex(text))).load()
    except ValueError:
        raise
    except Exception as error:  # a damaged pickle raises nearly anything
        raise ValueError(f"the state of CMA-ES must be whole, but a trial's is not: {error}") from None


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str):
        if (module, name) in _ARRAYS or (module.partition(".")[0] == "cmaes" and name in _OPTIMIZERS):
            return super().find_class(module, name)
        raise ValueError(f"the state of CMA-ES must be that of an optimizer, but a trial's names {module}.{name}")


def make_sampler(
    name: str, seed: int, present: int, distributions: Mapping, worker: int = 0, first: Mapping = NOTHING
) -> optuna.samplers.BaseSampler:
    """A sampler.

    Args:
        name: one of SAMPLERS.
        seed: seed of the study; the same seed gives the same study in one process.
        present: number of trials in the study, so that a resumed study does not propose its first trials again.
        distributions: of all parameters by name, from which a grid is made.
        worker: index of this process among those that share the study; each has its own random numbers.
        first: the parts of ranges in which a search begins, by name, for samplers that draw within a box.

    Raises:
        ValueError: for an unknown name, a missing package, or one that cannot choose among filter types.
    """
    one_of("sampler", name, tuple(SAMPLERS))
    package, extra = NEEDS.get(name, ("", ""))
    if package and importlib.util.find_spec(package) is None:
        raise ValueError(f"the sampler {name!r} needs {package}, which is not installed: {to_install(extra)}")
    if name in WITHOUT_FILTER_TYPES and FILTER_TYPE in distributions:
        able = ", ".join(sampler for sampler in SAMPLERS if sampler not in WITHOUT_FILTER_TYPES)
        raise ValueError(f"a method (--method) that chooses among filters must be one of {able}, but got {name!r}")
    if name == "grid":  # its order, and so its seed, has to be the same in every process
        values = {key: _grid(distribution) for key, distribution in distributions.items()}
        return optuna.samplers.GridSampler(values, seed=seed)
    seed = int(np.random.SeedSequence([seed, present, worker]).generate_state(1)[0])
    makers: dict[str, Callable[..., optuna.samplers.BaseSampler]] = {
        "tpe": partial(TpeInBox, first),
        "gp": partial(GpInBox, first),
        "cma-es": CmaEsSampler,
        "nsga-ii": optuna.samplers.NSGAIISampler,
        "random": partial(RandomInBox, first),
    }
    return makers[name](seed=seed)


def _grid(distribution: BaseDistribution) -> list:
    """Values over the range of a parameter, evenly spaced on its own scale."""
    if isinstance(distribution, CategoricalDistribution):
        return list(distribution.choices)
    if not isinstance(distribution, FloatDistribution | IntDistribution):
        raise TypeError(f"a grid needs numbers or names, but got {distribution}")
    spaced = np.geomspace if distribution.log else np.linspace
    values = spaced(distribution.low, distribution.high, GRID_VALUES)
    if isinstance(distribution, IntDistribution):
        return sorted({int(round(value)) for value in values})
    return [float(np.clip(value, distribution.low, distribution.high)) for value in values]


def near(best: Mapping, space: Mapping[str, BaseDistribution], plan: Plan, number: int) -> dict:
    """The parameters of the best trial, some of them changed by normal steps of a common random size.

        log10 x' = log10 x + s n,  n ~ N(0, 1),  log10 s ~ U(-1.5, 0); of a linear range s times a tenth of it

    The same trial number in a study with the same seed gives the same trial.

    Source: Beyer, Schwefel (2002), "Evolution strategies, a comprehensive introduction", Natural Computing 1.
    """
    generator = derived_generator(plan.seed, LOCAL_TRIALS, number)
    size, neighbour = 10.0 ** generator.uniform(-DECADES, 0.0), dict(best)
    names = [name for name in best if isinstance(space.get(name), FloatDistribution | IntDistribution)]
    is_changed = generator.random(len(names)) < MOVED
    if names and not is_changed.any():
        is_changed[generator.integers(len(names))] = True
    for name, step in zip(
        names, np.where(is_changed, size * generator.standard_normal(len(names)), 0.0), strict=True
    ):
        distribution, value = space[name], best[name]
        assert isinstance(distribution, FloatDistribution | IntDistribution)
        if step == 0.0:
            continue
        value = (
            value * 10.0**step
            if distribution.log
            else value + LARGEST_STEP * step * (distribution.high - distribution.low)
        )
        value = float(np.clip(value, distribution.low, distribution.high))
        neighbour[name] = round(value) if isinstance(distribution, IntDistribution) else value
    return neighbour
