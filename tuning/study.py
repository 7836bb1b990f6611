"""Optuna studies of a filter's numbers: common random numbers in, a choice and its proof out."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import NamedTuple

import numpy as np
import optuna
from optuna.trial import FrozenTrial, TrialState

from tuning.evaluate import Evaluation, evaluate, score_ratio
from tuning.scenarios import Data, Scenario, held_out_seeds, training_seeds
from tuning.space import (
    SIZE_LADDER,  # noqa: F401 - for those who show the sizes
    Choice,
    choice_of,
    has_ensemble,
    has_search_space,
    parameters_of,
    size_ladder,
    suggest,
    true_choice,
    untuned_choice,
)
from tuning.storage import PROCESS, retry_orphans, this_process

TRAINING_SEEDS = 32
HELD_OUT_SEEDS = 200
SIZE_TOLERANCE = 0.01  # the tuned ensemble is the smallest whose paired score is this close to the best
DIVERGENCE_PENALTY = 10.0  # added to the score for each run that had to restart
FINISHED = (TrialState.COMPLETE, TrialState.PRUNED)


def quiet_optuna() -> None:
    """Let Optuna report warnings only, for programs that show progress of their own."""
    optuna.logging.set_verbosity(optuna.logging.WARNING)


class Comparison(NamedTuple):
    """Three choices on the same held-out seeds, and the bound on these."""

    untuned: Evaluation
    tuned: Evaluation
    true: Evaluation
    bound: np.ndarray  # (n,) bound on the standard error of each state
    seeds: range


class SizeRow(NamedTuple):
    """How an ensemble of one size does against the best one."""

    size: int
    evaluation: Evaluation
    ratio: float  # score over the best score on the same seeds


class StudyResult(NamedTuple):
    """What a study found, before it is proved on held-out data."""

    choice: Choice  # with the smallest sufficient ensemble
    best_value: float  # score of the best trial on the training seeds
    trials: list[FrozenTrial]
    sizes: list[SizeRow]  # score against ensemble size, empty without an ensemble
    seconds: float
    interrupted: bool


def open_study(
    name: str, filter_name: str, scenario: Scenario, seed: int, storage: optuna.storages.BaseStorage
) -> optuna.Study:
    """Create a study or load it to go on; its first trial is the untuned filter.

    Raises:
        ValueError: if the filter has nothing to tune, or a study of this name was made for something else or by
            another version of Optuna.
    """
    if not has_search_space(filter_name):
        raise ValueError(f"filter must be one that has something to tune, but got {filter_name!r}")
    identity = {
        "filter": filter_name,
        "scenario": scenario.name,
        "seed": seed,
        "optuna": optuna.__version__.split(".")[0],
    }
    untuned = parameters_of(untuned_choice(filter_name, scenario))
    study = optuna.create_study(study_name=name, storage=storage, direction="minimize", load_if_exists=True)
    found = study.user_attrs.get("identity", identity)
    if found != identity:
        raise ValueError(f"study {name!r} must be for {identity}, but it was made for {found}")
    retry_orphans(study)
    present = len(study.get_trials(deepcopy=False))
    # A sampler with the same seed would repeat its first trials after a resume.
    study.sampler = optuna.samplers.TPESampler(
        seed=int(np.random.SeedSequence([seed, present]).generate_state(1)[0])
    )
    if not present:
        study.set_user_attr("identity", identity)
        study.enqueue_trial(untuned)
    return study


def finished_trials(study: optuna.Study) -> int:
    """Number of trials that count: complete and pruned ones."""
    return len(study.get_trials(deepcopy=False, states=FINISHED))


def run_study(
    study: optuna.Study,
    filter_name: str,
    scenario: Scenario,
    seed: int,
    trials: int,
    on_trial: Callable[[optuna.Study, int], None] = lambda study, finished: None,
) -> StudyResult:
    """Run a study until it has `trials` finished trials, all on the same training seeds.

    Ctrl-C ends it after the running trial and keeps what is finished; a second one ends it at once.

    Args:
        study: from `open_study`.
        filter_name: name of the filter.
        scenario: what data to tune on.
        seed: chooses the training seeds.
        trials: finished trials that the study shall have in total.
        on_trial: called after each trial with the study and the number of finished trials.

    Raises:
        KeyboardInterrupt: if it is interrupted before any trial is finished.
    """
    data = scenario.data(training_seeds(seed, TRAINING_SEEDS))
    started, interrupted = time.perf_counter(), False
    try:
        with stop_on_interrupt() as stopped:
            while not stopped() and (done := finished_trials(study)) < trials:
                _run_trial(study, filter_name, scenario, data)
                on_trial(study, done + 1)
        interrupted = stopped()
    except KeyboardInterrupt:
        interrupted = True
    if not finished_trials(study):
        raise KeyboardInterrupt
    best = study.best_trial
    choice = choice_of(filter_name, best.params, scenario)
    sizes = ensemble_sizes(choice, scenario, data) if has_ensemble(filter_name) else []
    if sizes:
        choice = choice.with_size(next(row.size for row in sizes if row.ratio <= 1.0 + SIZE_TOLERANCE))
    seconds = time.perf_counter() - started
    return StudyResult(choice, best.value, study.get_trials(deepcopy=False), sizes, seconds, interrupted)


def _run_trial(study: optuna.Study, filter_name: str, scenario: Scenario, data: Data) -> None:
    trial = study.ask()
    try:
        trial.set_user_attr(PROCESS, this_process())
        choice = suggest(trial, filter_name, scenario)
        study.tell(trial, _training_score(choice, scenario, data))
    except BaseException:
        study.tell(trial, state=TrialState.FAIL, skip_if_finished=True)
        raise


@contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Within this context the first Ctrl-C only makes the yielded function return True.

    An exception in the midst of compiled code or a storage's lock could get lost or leave the lock behind.
    Outside the main thread, where Python takes no signals, nothing changes.
    """
    caught = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.getsignal(signal.SIGINT)

    def note(number, frame):
        caught.append(number)
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(caught)
    finally:
        signal.signal(signal.SIGINT, before)


def _training_score(choice: Choice, scenario: Scenario, data: Data) -> float:
    evaluation = evaluate(choice.filter(scenario), data, scenario.scale)
    return min(evaluation.score.value, 1e6) + DIVERGENCE_PENALTY * evaluation.divergences


def ensemble_sizes(choice: Choice, scenario: Scenario, data: Data) -> list[SizeRow]:
    """The score of a choice against ensemble size, paired on the same seeds, smallest size first."""
    sizes = sorted({*size_ladder(choice.name), choice.numbers["ensemble_size"]})
    evaluations = [evaluate(choice.with_size(n).filter(scenario), data, scenario.scale) for n in sizes]
    best = min(evaluations, key=lambda e: e.score.value)
    return [SizeRow(n, e, score_ratio(e, best).value) for n, e in zip(sizes, evaluations, strict=True)]


def prove(choice: Choice, scenario: Scenario, seed: int, count: int = HELD_OUT_SEEDS) -> Comparison:
    """Untuned, tuned and true filter on seeds that the study never saw, with the bound on these seeds."""
    seeds = held_out_seeds(seed, count)
    data = scenario.data(seeds)
    choices = (untuned_choice(choice.name, scenario), choice, true_choice(choice.name, scenario))
    evaluations = [evaluate(c.filter(scenario), data, scenario.scale) for c in choices]
    return Comparison(*evaluations, bound=scenario.bound(data), seeds=seeds)
