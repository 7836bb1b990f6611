"""Optuna studies of a filter's numbers: common random numbers in, a choice out."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from tuning.interruption import stop_on_interrupt
from tuning.plan import Plan
from tuning.proof import SizeRow, ensemble_sizes, sufficient_size
from tuning.samplers import make_sampler
from tuning.scenarios import Data
from tuning.space import (
    Choice,
    choice_of,
    has_ensemble,
    parameters_of,
    untuned_choice,
)
from tuning.storage import PROCESS, retry_orphans, this_process
from tuning.trials import CONSISTENCY, NIS, make_pruner, run_trial

TWIN = "consistent twin"  # attribute: how often a trial's Q and R have been scaled
TWINS = 2  # so often at most: nonlinear filters may need a second time
FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)
OnTrial = Callable[[optuna.Study, int], None]


def quiet_optuna() -> None:
    """Let Optuna report errors only, for programs that show progress of their own."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)


class StudyResult(NamedTuple):
    """What a study found, before it is proved on held-out data."""

    choice: Choice  # with the smallest sufficient ensemble
    best_value: float  # first objective of the best trial, on the training seeds
    trials: list[FrozenTrial]
    sizes: list[SizeRow]  # score against ensemble size, empty without an ensemble
    seconds: float
    interrupted: bool
    free_value: float | None = None  # first objective of the best trial, consistent or not; None where all count
    front: tuple[FrozenTrial, ...] = ()  # trials that no other beats in both of two objectives

    @property
    def pruned(self) -> int:
        """Trials that ended early."""
        return sum(trial.state == TrialState.PRUNED for trial in self.trials)


def open_study(
    name: str, plan: Plan, storage: optuna.storages.BaseStorage, start: Choice | None = None, worker: int = 0
) -> optuna.Study:
    """Create a study or load it to go on; its first trial is `start`, by default the untuned filter.

    Args:
        name: of the study.
        plan: what the study is for.
        storage: from `open_storage`.
        start: the first trial.
        worker: place of this process among those that share the study.

    Raises:
        ValueError: if the plan cannot work, or a study of this name was made for something else or by another
            version of Optuna.
    """
    plan = plan.checked()
    scenario = plan.scenarios[0]
    space = plan.space()
    make_sampler(plan.sampler, plan.seed, 0, space)  # a clear error before anything is stored
    study = optuna.create_study(
        study_name=name,
        storage=storage,
        directions=["minimize"] * len(plan.objectives),
        load_if_exists=True,
        pruner=make_pruner(plan),
    )
    found = study.user_attrs.get("identity", plan.identity)
    if found != plan.identity:
        raise ValueError(f"study {name!r} must be for {plan.identity}, but it was made for {found}")
    retry_orphans(study)
    present = len(study.get_trials(deepcopy=False))
    study.sampler = make_sampler(plan.sampler, plan.seed, present, space, worker)
    if not present:
        study.set_user_attr("identity", plan.identity)
        first = parameters_of(start or untuned_choice(plan.filter, scenario))
        study.enqueue_trial({name: first[name] for name in space})
    return study


def finished_trials(study: optuna.Study) -> int:
    """Number of trials that count: complete and pruned ones."""
    return len(study.get_trials(deepcopy=False, states=FINISHED))


def best_trial(trials: Sequence[FrozenTrial]) -> FrozenTrial | None:
    """The complete, consistent trial with the least first objective; else the least inconsistent one."""
    complete = [trial for trial in trials if trial.state == TrialState.COMPLETE]
    if not complete:
        return None
    return min(complete, key=lambda trial: (max(violation(trial), 0.0), trial.values[0]))


def violation(trial: FrozenTrial) -> float:
    """How far a trial's mean NIS is outside its band, in logarithms; at most zero inside, or without a band."""
    return trial.constraints.get(CONSISTENCY, 0.0)


def run_study(
    study: optuna.Study,
    plan: Plan,
    trials: int,
    on_trial: OnTrial = lambda study, finished: None,
    run: Callable[[optuna.Study, Plan, Sequence[Data], int, OnTrial], bool] | None = None,
) -> StudyResult:
    """Run a study until it has `trials` finished trials, all on the same training seeds.

    Ctrl-C ends it after the running trial and keeps what is finished; a second one ends it at once.

    Args:
        study: from `open_study`.
        plan: what the study is for.
        trials: finished trials that the study shall have in total.
        on_trial: called after each trial with the study and the number of finished trials.
        run: runs the trials and returns whether it was interrupted; `run_trials` by default.

    Raises:
        KeyboardInterrupt: if it is interrupted before any trial is finished.
    """
    data = plan.training_data()
    started = time.perf_counter()
    interrupted = (run or run_trials)(study, plan, data, trials, on_trial)
    present = study.get_trials(deepcopy=False)
    best = best_trial(present)
    if best is None:
        raise KeyboardInterrupt
    choice = choice_of(plan.filter, best.params, plan.scenarios[0])
    sizes = ensemble_sizes(choice, plan, data) if has_ensemble(plan.filter) and len(plan.objectives) == 1 else []
    if sizes:
        choice = choice.with_size(sufficient_size(sizes))
    complete = [trial.values[0] for trial in present if trial.state == TrialState.COMPLETE]
    return StudyResult(
        choice,
        best.values[0],
        present,
        sizes,
        time.perf_counter() - started,
        interrupted,
        min(complete) if plan.is_constrained else None,
        tuple(study.best_trials) if len(plan.objectives) > 1 else (),
    )


def run_trials(
    study: optuna.Study,
    plan: Plan,
    data: Sequence[Data],
    trials: int,
    on_trial: OnTrial = lambda study, finished: None,
    stop: Callable[[], bool] = lambda: False,
) -> bool:
    """Run trials in this process until the study has `trials` finished ones; return whether Ctrl-C ended it.

    Args:
        study: from `open_study`; other processes may run trials of it, too.
        plan: what the study is for.
        data: the plan's training data.
        trials: finished trials that the study shall have in total.
        on_trial: called after each trial with the study and the number of finished trials.
        stop: asked before the first and after each trial whether to end.
    """
    if stop() or finished_trials(study) >= trials:
        return False

    def objective(trial: optuna.Trial) -> list[float]:
        trial.set_user_attr(PROCESS, this_process())
        return run_trial(trial, plan, data)

    def after(study: optuna.Study, trial: FrozenTrial) -> None:
        finished = finished_trials(study)
        if plan.is_constrained and finished < trials:
            _enqueue_consistent_twin(study, plan, trial)
        on_trial(study, finished)
        if finished >= trials or interrupted() or stop():
            study.stop()

    try:
        with stop_on_interrupt() as interrupted:
            study.optimize(objective, callbacks=[after])
        return interrupted()
    except KeyboardInterrupt:
        return True


def _enqueue_consistent_twin(study: optuna.Study, plan: Plan, last: FrozenTrial) -> None:
    """Ask next for the last trial with Q and R scaled by its mean NIS, if it is the better for being inconsistent.

    A common factor on Q and R leaves the gain of a linear filter as it is, and divides the NIS: without this a
    sampler would have to find by chance, for every good ratio of Q and R, the one scale that is consistent.
    """
    if (
        plan.hold_r
        or last.state != TrialState.COMPLETE
        or violation(last) <= 0
        or NIS not in last.user_attrs
        or last.user_attrs.get(TWIN) == TWINS
    ):
        return
    best = best_trial(study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,)))
    if violation(best) <= 0 and best.values[0] < last.values[0]:
        return
    space, factor = plan.space(), last.user_attrs[NIS]
    scaled = {
        name: float(np.clip(factor * value, space[name].low, space[name].high))
        for name, value in last.params.items()
        if name == "R" or name.startswith("Q")
    }
    twin = {TWIN: last.user_attrs.get(TWIN, 0) + 1, f"{TWIN} of": last.number}
    study.enqueue_trial({**last.params, **scaled}, user_attrs=twin)
