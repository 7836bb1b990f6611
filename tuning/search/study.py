"""Optuna studies of a filter's parameters, with common random numbers for all trials.

The first Ctrl-C ends a study after the running trial, the second one at once.
"""

from __future__ import annotations

import math
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from itertools import accumulate
from typing import Any, NamedTuple

import optuna
from optuna.distributions import BaseDistribution
from optuna.trial import FrozenTrial, TrialState

from filters.registry import filter_type
from thruster_env.core.checks import tell
from tuning.evaluation.sizes import SizeRow
from tuning.problems.check import is_older
from tuning.problems.data import Data
from tuning.search.among_types import (
    MAXIMUM_LIKELIHOOD,
    enqueue_after,
    enqueue_what_is_left,
    is_race,
    next_in_race,
    sized,
    sizes_of,
)
from tuning.search.measures import measured
from tuning.search.plan import Plan, nis_ratio
from tuning.search.space import FILTER_TYPE, Choice, trial_parameters
from tuning.search.storage import PROCESS, drop_waiting, retry_orphans, this_process
from tuning.search.trials import BLOCK, COST, best_trial, cost_of, is_consistent, make_sampler, measure, run_trial
from tuning.search.validation import BY_CONSISTENCY, Validation, as_data, validate

BY_SCORE = 4  # of the best trials meet the baselines, and `BY_CONSISTENCY` of the best consistent ones
STOPPING = "stopping after the running task; Ctrl-C again stops at once"
FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
BEST = "best trial under the constraints"  # attribute of a study, for programs that ignore constraints
CHOSEN = "choice at the end"  # attribute of a study: how the best trials met the baselines, and its trials then
OnTrial = Callable[[optuna.Study, int], None]


@contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Within this context the first Ctrl-C makes the yielded function return True, with a message to listeners.

    An exception within compiled code or a storage's lock could get lost or leave the lock behind. Outside the main
    thread, where Python delivers no signals, this has no effect.
    """
    caught: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.getsignal(signal.SIGINT)

    def note(number, frame):
        caught.append(number)
        signal.signal(signal.SIGINT, before)
        tell(STOPPING)

    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(caught)
    finally:
        signal.signal(signal.SIGINT, before)


class StudyResult(NamedTuple):
    """The result of a study, before held-out evaluation."""

    choice: Choice  # with the smallest sufficient ensemble
    best_value: float  # first objective of the choice, on the training seeds
    trials: list[FrozenTrial]
    sizes: list[SizeRow]  # score against ensemble size, empty without an ensemble
    seconds: float
    interrupted: bool
    free_value: float | None = (
        None  # first objective of the best trial, consistent or not; None without a constraint
    )
    band_value: float | None = None  # the same of the best trial with a mean NIS in its band; None if none has
    front: tuple[FrozenTrial, ...] = ()  # Pareto front: trials that no other trial dominates in two objectives
    microseconds: float | None = None  # us/step of the choice, where the plan asks for it
    consistent: bool | None = None  # whether any trial's mean NIS is within its band; None without a constraint
    nis: tuple[float, ...] = ()  # NIS of the choice over the number of channels, on each scenario's training seeds
    validation: Validation | None = None  # how the best trials met the baselines; None where they did not
    sized: Choice | None = None  # the trial of which `sizes` is the table; None without an ensemble

    @property
    def finished(self) -> int:
        """Number of finished trials: complete and pruned ones."""
        return sum(trial.state in FINISHED for trial in self.trials)

    @property
    def pruned(self) -> int:
        """Number of pruned trials."""
        return sum(trial.state == TrialState.PRUNED for trial in self.trials)

    def or_interrupted(self) -> StudyResult:
        """This result; KeyboardInterrupt if Ctrl-C ended the study, for callers that must end, too."""
        if self.interrupted:
            raise KeyboardInterrupt
        return self


def checked(plan: Plan) -> Plan:
    """A feasible plan whose sampler is installed; ValueError otherwise, before anything is stored."""
    plan = plan.checked()
    make_sampler(plan.sampler, plan.seed, 0, plan.space())
    return plan


P_THRESHOLD = 0.1  # p-value of Wilcoxon's signed-rank test below which a trial is pruned
MOST_EXACT = 50  # differences for which Optuna's test is the exact one


class PairedPruner(optuna.pruners.WilcoxonPruner):
    """Optuna's pruner, whose test is a comparison of two whole numbers in all but rare cases.

    Without ties the p-value of the signed-rank test depends on the sum of ranks alone, so the sum from which it is
    below the threshold is known beforehand. Optuna decides where there are ties or values that are not finite.
    """

    def __init__(self):
        """Take the threshold, and no decision before the first block."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            super().__init__(p_threshold=P_THRESHOLD, n_startup_steps=BLOCK)

    def prune(self, study: optuna.Study, trial: FrozenTrial) -> bool:
        """Whether a trial of a study that minimises is significantly worse than its best one, and in the mean."""
        complete = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
        complete.sort(key=lambda finished: finished.values[0])  # so that few are asked for their constraints
        best_so_far = next(filter(_is_feasible, complete), None)
        if best_so_far is None:
            return False
        values, best = trial.intermediate_values, best_so_far.intermediate_values
        if not values or not best or not values.keys() <= best.keys() or not _all_finite(values, best):
            return super().prune(study, trial)
        if len(values) >= BLOCK and _mean(best) >= _mean(values):
            return False
        differences = [value - best[step] for step, value in values.items()]
        sizes = {abs(difference) for difference in differences}
        if not BLOCK <= len(differences) <= MOST_EXACT or len(sizes) < len(differences) or 0.0 in sizes:
            return super().prune(study, trial)
        return positive_rank_sum(differences) >= critical_rank_sum(len(differences), P_THRESHOLD)


def positive_rank_sum(differences: Sequence[float]) -> int:
    """Sum of the ranks of positive differences, ranked by size from 1; of differences without ties."""
    return sum(rank for rank, difference in enumerate(sorted(differences, key=abs), start=1) if difference > 0)


@cache
def critical_rank_sum(count: int, threshold: float) -> int:
    """The smallest sum of ranks of positive differences whose one-sided p-value is below a threshold.

    p(r) = P(R >= r), where R is the sum of a random subset of 1 ... count, all subsets being equally likely.

    Source: Wilcoxon (1945), "Individual comparisons by ranking methods", Biometrics Bulletin 1(6).
    """
    subsets = [1]  # number of subsets with each sum
    for rank in range(1, count + 1):
        longer = subsets + [0] * rank
        subsets = [n + (longer[r - rank] if r >= rank else 0) for r, n in enumerate(longer)]
    beyond = accumulate(reversed(subsets))  # number with this sum or a larger one, from the largest sum downwards
    return len(subsets) - sum(number < threshold * 2**count for number in beyond)


def _is_feasible(trial: FrozenTrial) -> bool:
    return all(value <= 0 for value in trial.constraints.values())


def _all_finite(*values: dict[int, float]) -> bool:
    return all(math.isfinite(value) for trial_values in values for value in trial_values.values())


def _mean(values: dict[int, float]) -> float:
    return sum(values.values()) / len(values)


def make_pruner(plan: Plan) -> optuna.pruners.BasePruner:
    """A paired test over seeds, or no pruning; two objectives are never pruned."""
    return PairedPruner() if plan.prune and len(plan.objectives) == 1 else optuna.pruners.NopPruner()


def give_sampler(study: optuna.Study, make: Callable[[int], optuna.samplers.BaseSampler], present: int) -> None:
    """Give a study the sampler of index 0 or, if another process also runs trials of it, one with its own index.

    Processes that open a study at the same number of trials would propose the same trials. But trials have
    different
    numbers: only the process with the first sampled trial finds no earlier trial of another process. Every other
    process takes the number of its own trial as its index.

    Args:
        study: the study whose trials this process runs.
        make: makes the sampler of an index.
        present: number of trials in the study before this process added any.
    """
    first, own_numbers = make(0), set()
    proceed = first.before_trial

    def look(_: optuna.Study, trial: FrozenTrial) -> None:
        own_numbers.add(trial.number)
        if "fixed_params" not in trial.system_attrs:  # nothing is sampled in an enqueued trial
            first.before_trial = proceed  # type: ignore[method-assign]  # of this sampler alone
            begun = (t.number for t in study.get_trials(deepcopy=False)[present:] if t.state != TrialState.WAITING)
            if any(number < trial.number and number not in own_numbers for number in begun):
                study.sampler = make(trial.number)
        (proceed if study.sampler is first else study.sampler.before_trial)(study, trial)

    first.before_trial = look  # type: ignore[method-assign, assignment]  # of this sampler alone
    study.sampler = first


def choose_type_by_race(sampler: optuna.samplers.BaseSampler, plan: Plan) -> optuna.samplers.BaseSampler:
    """The sampler, whose trials have the filter type that is next in the race."""
    of_all, of_one = sampler.infer_relative_search_space, sampler.sample_independent

    def without_type(study: optuna.Study, trial: FrozenTrial) -> dict[str, BaseDistribution]:
        return {name: distribution for name, distribution in of_all(study, trial).items() if name != FILTER_TYPE}

    def sample(
        study: optuna.Study, trial: FrozenTrial, param_name: str, param_distribution: BaseDistribution
    ) -> Any:
        if param_name == FILTER_TYPE:
            return next_in_race(plan, study.get_trials(deepcopy=False))
        return of_one(study, trial, param_name, param_distribution)

    sampler.infer_relative_search_space = without_type  # type: ignore[method-assign]  # of this sampler alone
    sampler.sample_independent = sample  # type: ignore[method-assign]
    return sampler


def open_study(
    name: str,
    plan: Plan,
    storage: optuna.storages.BaseStorage | None = None,
    start: Choice | None = None,
    worker: int = 0,
) -> optuna.Study:
    """Create a study, or load it to continue it; its first trial is `start`, by default the untuned filter.

    A study over several filter types tries the untuned filter of each type, one after the other.

    Args:
        name: name of the study.
        plan: what the study is for.
        storage: from `open_storage`; None for a study in memory.
        start: the first trial, instead of untuned ones.
        worker: index of this process among those that share the study; 0 if it may be the only one.

    Raises:
        ValueError: if the plan is not feasible, or a study of this name was made for another plan or by another
            version of Optuna.
    """
    plan, space = checked(plan), plan.space()
    study = optuna.create_study(
        study_name=name,
        storage=storage,
        directions=["minimize"] * len(plan.objectives),
        load_if_exists=True,
        pruner=make_pruner(plan),
    )
    _check_identity(name, plan.identity, study.user_attrs.get("identity", plan.identity))
    retry_orphans(study)
    present = len(study.get_trials(deepcopy=False))
    ranges = plan.first_ranges()

    def sampler_of(worker: int) -> optuna.samplers.BaseSampler:
        sampler = make_sampler(plan.sampler, plan.seed, present, space, worker, ranges)
        return choose_type_by_race(sampler, plan) if is_race(plan) else sampler

    if worker:
        study.sampler = sampler_of(worker)
    else:
        give_sampler(study, sampler_of, present)
    if not present:
        study.set_user_attr("identity", plan.identity)
        if start is not None:
            study.enqueue_trial(trial_parameters(start, space))
    if not worker:  # several at once would enqueue it twice
        enqueue_what_is_left(study, plan)
    return study


def _check_identity(name: str, wanted: dict, stored: dict) -> None:
    """Raise ValueError, with the differences, unless a study has the wanted identity."""
    if stored != wanted:
        differing = [key for key in {**wanted, **stored} if wanted.get(key) != stored.get(key)]
        wanted, stored = ({key: part.get(key) for key in differing} for part in (wanted, stored))
        if is_older(stored, wanted):
            raise ValueError(
                f"a study must have this version's digests of problems, but {name!r} has those of an older one, "
                "which tell nothing here: give it another name (--study NAME), or go on with that version"
            )
        if differing == ["scenario_digests"]:  # its numbers would tell nobody anything
            raise ValueError(
                f"a study must be for one model and its data, but {name!r} exists here for another model or other "
                "logs: give it another name (--study NAME), or move the file that keeps it (out/studies.journal)"
            )
        if differing == ["estimators"]:
            raise ValueError(
                f"a study must be of one estimator, but the code of {', '.join(wanted['estimators'])} is not what "
                f"{name!r} was made with: give it another name (--study NAME)"
            )
        raise ValueError(
            f"study {name!r} must be for {wanted}, but it was made for {stored}: give it another name"
        )


def finished_trials(study: optuna.Study) -> int:
    """Number of finished trials: complete and pruned ones."""
    return len(study.get_trials(deepcopy=False, states=FINISHED))


def finalists_of(
    plan: Plan, trials: Sequence[FrozenTrial], resize: Callable[[Choice, bool], Choice]
) -> dict[str, Choice]:
    """The trials that meet the baselines, by name: the best, the best consistent, the maximum-likelihood ones.

    Args:
        plan: of the study.
        trials: its trials.
        resize: gives the best trial of each filter type the ensemble size with which it ends; the others of that
            type have the same. Called with whether its size must be consistent.
    """
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    complete.sort(key=lambda trial: trial.values[0])
    best = best_trial(complete)
    first = [] if best is None else [best]
    consistent = [trial for trial in complete if is_consistent(trial)][:BY_CONSISTENCY]
    likely = [trial for trial in complete if MAXIMUM_LIKELIHOOD in trial.user_attrs]
    finalists: dict[str, Choice] = {}
    sizes: dict[str, int] = {}
    for trial in (*first, *complete[:BY_SCORE], *consistent, *likely):
        choice = plan.choice_of(trial.params)
        if filter_type(choice.name).has_ensemble:
            if choice.name not in sizes:
                sized = resize(choice, plan.is_constrained and is_consistent(trial))
                sizes[choice.name] = sized.numbers["ensemble_size"]
            choice = choice.with_size(sizes[choice.name])
        finalists[f"trial {trial.number + 1}"] = choice
    return finalists


def run_study(
    study: optuna.Study,
    plan: Plan,
    trials: int,
    on_trial: OnTrial = lambda study, finished: None,
    run: Callable[[optuna.Study, Plan, Sequence[Data], int, OnTrial], bool] | None = None,
) -> StudyResult:
    """Run a study until it has `trials` finished trials, all on the same training seeds.

    Ctrl-C ends it after the running trial and keeps all finished trials; a second one ends it at once.

    Args:
        study: from `open_study`.
        plan: what the study is for.
        trials: finished trials that the study shall have in total.
        on_trial: called after each trial with the study and the number of finished trials.
        run: runs the trials and returns whether it was interrupted; `run_trials` by default.

    Raises:
        ValueError: if all trials are over the plan's budget.
        KeyboardInterrupt: if it is interrupted before any trial is complete.
    """
    data = plan.training_data()
    started = time.perf_counter()
    interrupted = (run or run_trials)(study, plan, data, trials, on_trial)
    present = _begun(study)
    best = best_trial(present)
    if best is None:
        costs = [trial.user_attrs[COST] for trial in present if COST in trial.user_attrs]
        if plan.budget is None or interrupted or not costs:
            raise KeyboardInterrupt
        raise ValueError(
            f"budget must be at least the time of the cheapest trial, {min(costs):.3g} microseconds a step, "
            f"but got {plan.budget:g}"
        )
    if study.user_attrs.get(BEST) != best.number:  # another worker may have written an older one last
        study.set_user_attr(BEST, best.number)
    tables: dict[str, tuple[Choice, list[SizeRow]]] = {}

    def resize(choice: Choice, consistent: bool) -> Choice:
        sizes = sizes_of(study, choice, plan, data, consistent)
        choice = sized(choice, plan, data, sizes, consistent)
        tables[choice.name] = choice, sizes
        return choice

    finalists = finalists_of(plan, present, resize)
    validation, value = validate(plan, finalists, data), best.values[0]
    if validation is None:
        choice = plan.forgetting(next(iter(finalists.values())), exact=True)
        if plan.forget is not None:
            value = measured(choice, plan, data).value
    else:
        choice = validation.named(validation.chosen).choice
        value = measured(choice, plan, data).value
        study.set_user_attr(CHOSEN, {"trials": len(present), **(as_data(validation) or {})})
    sized_choice, sizes = tables.get(choice.name, (None, []))
    complete = [trial.values[0] for trial in present if trial.state == TrialState.COMPLETE]
    return StudyResult(
        choice,
        value,
        present,
        sizes,
        time.perf_counter() - started,
        interrupted,
        min(complete) if plan.is_constrained else None,
        best.values[0] if plan.is_constrained and is_consistent(best) else None,
        tuple(study.best_trials) if len(plan.objectives) > 1 else (),
        # A smaller ensemble takes no longer than the trial's.
        min(cost_of(choice, plan, data), best.user_attrs[COST]) if plan.asks_for_cost else None,
        is_consistent(best) if plan.is_constrained else None,
        tuple(map(nis_ratio, measure(choice, plan, data))) if plan.is_constrained else (),
        validation,
        sized_choice,
    )


def answered_by(result: StudyResult, plan: Plan, name: str, choice: Choice) -> StudyResult:
    """The result with the answer of another method, which meets the baselines as trials do, and may give way."""
    data = plan.training_data()
    validation = validate(plan, {name: choice}, data, rescales=False)
    if validation is None:
        choice = plan.forgetting(choice, exact=True)
    else:
        choice = validation.named(validation.chosen).choice
    return result._replace(
        choice=choice,
        best_value=measured(choice, plan, data).value,
        validation=validation,
        free_value=None,
        band_value=None,
        consistent=None,
        nis=(),
        sizes=[],
        sized=None,
    )


def _begun(study: optuna.Study) -> list[FrozenTrial]:
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state != TrialState.WAITING]


def chosen_of(study: optuna.Study) -> dict | None:
    """The validation of a study's best trials, or None if there have been trials since."""
    validation = study.user_attrs.get(CHOSEN)
    same = isinstance(validation, dict) and validation.get("trials") == len(_begun(study))
    return validation if same else None


def _note_best(study: optuna.Study, last: FrozenTrial) -> None:
    """Store the last trial's number if it is the best one."""
    best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
    if best is not None and best.number == last.number:
        study.set_user_attr(BEST, last.number)


def run_trials(
    study: optuna.Study,
    plan: Plan,
    data: Sequence[Data],
    trials: int,
    on_trial: OnTrial = lambda study, finished: None,
    stop: Callable[[], bool] = lambda: False,
    on_choice: Callable[[Choice], None] = lambda choice: None,
    drops_waiting: bool = True,
) -> bool:
    """Run trials in this process until the study has `trials` finished ones; return whether Ctrl-C ended it.

    Beside other processes nothing is enqueued for which no trial is left.

    Args:
        study: from `open_study`; other processes may run trials of it, too.
        plan: what the study is for.
        data: the plan's training data.
        trials: finished trials that the study shall have in total.
        on_trial: called after each trial with the study and the number of finished trials.
        stop: asked before the first and after each trial whether to end.
        on_choice: called with the choice of each trial.
        drops_waiting: whether enqueued trials that nobody needs, of two processes or a killed one, are failed at
            the end.
    """
    if stop():
        return False
    if finished_trials(study) >= trials:
        if drops_waiting:
            drop_waiting(study)
        return False
    space, beside_others = plan.space(), False
    before = {trial.number for trial in study.get_trials(deepcopy=False, states=FINISHED)}

    def objective(trial: optuna.Trial) -> list[float]:
        trial.set_user_attr(PROCESS, this_process())
        return run_trial(trial, plan, data, space, on_choice)

    def after(study: optuna.Study, trial: FrozenTrial) -> None:
        _note_best(study, trial)
        nonlocal beside_others
        finished, running = finished_trials(study), _in_state(study, TrialState.RUNNING)
        beside_others |= running > 0
        waiting = _in_state(study, TrialState.WAITING) if running else 0
        if finished + running + waiting < trials:
            enqueue_after(study, plan, trial)
        on_trial(study, finished)
        if finished >= trials or interrupted() or stop():
            study.stop()

    try:
        with stop_on_interrupt() as interrupted:
            study.optimize(objective, callbacks=[after])
        finished = study.get_trials(deepcopy=False, states=FINISHED)
        beside_others |= any(
            trial.number not in before and trial.user_attrs.get(PROCESS) != this_process() for trial in finished
        )
        if drops_waiting and beside_others and len(finished) >= trials:
            drop_waiting(study)
        return interrupted()
    except KeyboardInterrupt:
        return True
    except (AssertionError, UnboundLocalError) as error:  # of Optuna's, when its storage fails it
        raise _first_cause(error) from None


def _in_state(study: optuna.Study, state: TrialState) -> int:
    return len(study.get_trials(deepcopy=False, states=(state,)))


def _first_cause(error: BaseException) -> BaseException:
    """The error of a storage that Optuna's own assertions have hidden."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, (OSError, ValueError)):
        cause = cause.__context__
    return cause or error
