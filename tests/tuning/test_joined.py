"""Processes that join a study propose what is their own, whenever they come; a single one repeats itself."""

import optuna
import pytest

from tuning.plants.thruster import find_scenario
from tuning.search.plan import Plan
from tuning.search.study import open_study

PLAN = Plan("ekf", (find_scenario("mismatch"),), prune=False)


def storage_with_one_trial():
    storage = optuna.storages.InMemoryStorage()
    study = open_study("s", PLAN, storage)
    study.tell(propose(study)[0], 1.0)
    return storage


def propose(study):
    trial = study.ask(PLAN.space())
    return trial, tuple(trial.params.values())


@pytest.mark.parametrize("sampler", ["tpe", "random", "nsga-ii"])
def test_two_that_join_at_the_same_number_of_trials_never_propose_alike(sampler):
    plan, storage = PLAN._replace(sampler=sampler), optuna.storages.InMemoryStorage()
    both = [open_study("s", plan, storage)]
    both[0].tell(propose(both[0])[0], 1.0)  # the untuned filter, which is queued
    both = [open_study("s", plan, storage) for _ in range(2)]
    proposed = []
    for study in [*both, *both[::-1], *both]:
        trial, point = propose(study)
        proposed.append(point)
        study.tell(trial, 1.0)
    assert len(set(proposed)) == len(proposed)


def test_so_do_two_that_begin_a_study_at_once(monkeypatch):
    storage = optuna.storages.InMemoryStorage()
    get_trials = optuna.Study.get_trials
    with monkeypatch.context() as patch:  # neither sees what the other has queued
        patch.setattr(optuna.Study, "get_trials", lambda *args, **kwargs: [])
        both = [open_study("s", PLAN, storage) for _ in range(2)]
    assert optuna.Study.get_trials is get_trials
    queued = [propose(study)[1] for study in both]
    assert queued[0] == queued[1]  # the untuned filter, which does no harm
    points = [propose(study)[1] for study in both + both]
    assert len(set(points)) == len(points)


def test_a_single_process_proposes_the_same_again():
    def points(storage):
        study = open_study("s", PLAN, storage)
        study.enqueue_trial({"Q11": 1.0})  # as a study does after good trials
        found = []
        for _ in range(5):
            trial, point = propose(study)
            found.append(point)
            study.tell(trial, 1.0)
        return found

    first = points(optuna.storages.InMemoryStorage())
    assert first == points(optuna.storages.InMemoryStorage()) and len(set(first)) == 5
    resumed = points(storage_with_one_trial())
    assert resumed == points(storage_with_one_trial()) and not set(resumed[1:]) & set(first)
