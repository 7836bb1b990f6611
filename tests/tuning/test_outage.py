"""A database that goes away and stays away: one deadline for all calls and threads, one line."""

import types

import optuna
import pytest

from tuning.plants.thruster import find_scenario
from tuning.search import storage as database
from tuning.search.plan import Plan
from tuning.search.storage import PATIENCE_SECONDS, open_storage
from tuning.search.study import open_study, run_trials

PLAN = Plan("ekf", (find_scenario("mismatch"),), prune=False)
WRITES = ("set_trial_user_attr", "set_trial_state_values", "set_study_user_attr", "record_heartbeat")


class Clock:
    """Time that passes when somebody sleeps."""

    def __init__(self):
        self.now, self.alarm = 0.0, (float("inf"), None)

    def monotonic(self):
        return self.now

    def sleep(self, seconds):
        self.now += seconds
        if self.now >= self.alarm[0]:
            self.alarm[1]()


@pytest.fixture
def clock(monkeypatch):
    clock = Clock()
    monkeypatch.setattr(database, "time", types.SimpleNamespace(monotonic=clock.monotonic, sleep=clock.sleep))
    return clock


@pytest.fixture
def storage(tmp_path):
    return open_storage(f"sqlite:///{tmp_path}/s.db")


@pytest.fixture
def refuse(storage, monkeypatch):
    """Makes a database refuse some of its methods, until it is told otherwise."""
    away = types.SimpleNamespace(methods=())

    def refusing(name, method):
        def call(*args, **kwargs):
            if name in away.methods:
                raise optuna.exceptions.StorageInternalError("read-only transaction")
            return method(*args, **kwargs)

        return call

    for name in (*WRITES, "get_all_trials"):
        monkeypatch.setattr(storage._backend, name, refusing(name, getattr(storage._backend, name)))
    return lambda *methods: setattr(away, "methods", methods)


@pytest.mark.filterwarnings("ignore:no answer from the database")
def test_one_deadline_counts_for_all_calls(storage, refuse, clock):
    study = optuna.create_study(storage=storage)
    refuse(*WRITES)
    rule = f"a database must answer within {PATIENCE_SECONDS} s, but got: read-only transaction"
    with pytest.raises(ValueError, match=rule):
        study.set_user_attr("a", 1)
    assert PATIENCE_SECONDS < clock.now <= PATIENCE_SECONDS + 1
    for _ in range(3):  # each would have had a minute of its own
        assert study.get_trials() == []  # reading works, and is no sign that writing does
        with pytest.raises(ValueError, match=rule):
            study.set_user_attr("b", 1)
    assert clock.now <= PATIENCE_SECONDS + 1


def test_after_an_outage_the_next_one_has_a_deadline_of_its_own(storage, refuse, clock):
    study = optuna.create_study(storage=storage)
    for _ in range(2):
        refuse(*WRITES)
        clock.now, clock.alarm = 0.0, (50.0, refuse)  # which then refuses nothing
        with pytest.warns(UserWarning, match="no answer from the database, trying for 60 s: read-only") as told:
            study.set_user_attr("a", 1)
        assert len(told) == 1 and 50 <= clock.now < 52


def test_a_sign_of_life_that_gets_lost_ends_no_thread(storage, refuse, clock):
    study = optuna.create_study(storage=storage)
    number = storage.create_new_trial(study._study_id)
    refuse("record_heartbeat")
    for _ in range(20):
        storage.record_heartbeat(number)
        clock.now += 10.0
    refuse()
    storage.record_heartbeat(number)
    refuse("set_study_user_attr")
    before = clock.now
    with (
        pytest.warns(UserWarning, match="no answer"),
        pytest.raises(ValueError, match="a database must answer within 60 s"),
    ):
        study.set_user_attr("a", 1)  # the outage of before is over
    assert clock.now > before + PATIENCE_SECONDS


@pytest.mark.filterwarnings("ignore:no answer from the database")
@pytest.mark.parametrize("refused", [WRITES, (*WRITES, "get_all_trials")])
def test_a_study_whose_database_stays_away_ends_with_what_it_said(storage, refuse, clock, capfd, refused):
    study = open_study("s", PLAN, storage)

    def after(study, finished):
        if finished == 2:
            refuse(*refused)

    with pytest.raises(ValueError, match="a database must answer within 60 s, but got: read-only"):
        run_trials(study, PLAN, PLAN.training_data(), 5, after)
    assert clock.now <= PATIENCE_SECONDS + 1
    assert "Traceback" not in capfd.readouterr().err
    refuse()
    assert sum(trial.state.is_finished() for trial in study.get_trials()) == 2
