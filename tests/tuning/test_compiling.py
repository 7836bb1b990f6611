"""Filter types are compiled before a study's first trial, the last of them by other processes."""

import json
import subprocess
from types import SimpleNamespace

import numpy as np
import pytest

from tests.linear_problem import LinearProblem
from tuning.problems.model_problem import RunsProblem
from tuning.search import compiling
from tuning.search.compiling import compile_filters
from tuning.search.plan import TRAINING_SEEDS, Plan
from tuning.search.workers import end, orders_of, plan_of, start
from tuning.thruster.scenario import find_scenario

NAMES = ("ekf", "kf", "ukf", "ckf", "enkf")
TUNNEL = find_scenario("published_tunnel")
PLAN = Plan("auto", (TUNNEL,), budget=1.0)


@pytest.fixture
def beside(monkeypatch):
    """Three cores on which each filter seems to take a while, and the helpers that would be started, and ended."""
    found = SimpleNamespace(started=[], options=[], ended=[])

    def started(module, orders, **options):
        found.started.append(json.dumps(orders))
        found.options.append(options)

    monkeypatch.setattr(compiling, "COMPILED", -1.0)
    monkeypatch.setattr(compiling, "cores", lambda: 3)
    monkeypatch.setattr(compiling, "start", started)
    monkeypatch.setattr(compiling, "end", found.ended.append)
    monkeypatch.setattr(compiling, "_compile", lambda *_: None)
    return found


def test_helpers_begin_with_the_last_types_and_are_ended(beside):
    shown = []
    compile_filters(PLAN, NAMES, shown.append)
    orders = [*map(json.loads, beside.started)]
    assert shown == [*NAMES]
    assert [one["names"] for one in orders] == [["enkf", "ukf"], ["ckf", "kf"]]
    assert plan_of(orders[0]).identity == PLAN.identity
    assert len(beside.ended) == 2
    assert all(
        set(one.values()) == {subprocess.DEVNULL} and len(one) == 2 for one in beside.options
    )  # --json - may be beside


def test_helpers_are_ended_when_somebody_interrupts(beside):
    def interrupt(name):
        if name == "ckf":
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compile_filters(PLAN, NAMES, interrupt)
    assert len(beside.ended) == 2


def test_there_are_none_where_code_is_cached_or_a_model_cannot_be_sent(beside, monkeypatch):
    def refused(plan):
        raise ValueError("a model cannot be pickled")

    monkeypatch.setattr(compiling, "COMPILED", 1e9)
    compile_filters(PLAN, NAMES)
    monkeypatch.setattr(compiling, "COMPILED", -1.0)
    monkeypatch.setattr(compiling, "orders_of", refused)
    compile_filters(PLAN, NAMES)
    assert not beside.started


def test_a_filter_that_fails_is_left_to_its_trial(monkeypatch):
    def failing(name, problem):
        raise ValueError("no such filter here")

    monkeypatch.setattr(compiling, "untuned_choice", failing)
    compile_filters(PLAN, ["ekf"])


@pytest.mark.usefixtures("as_python")
def test_it_runs_as_many_runs_as_a_trial_one_step_long(monkeypatch):
    seen, rng = [], np.random.default_rng(0)
    runs = [(np.zeros((12, 1)), rng.normal(size=(13, 1))) for _ in range(5)]
    recorded = RunsProblem(runs, LinearProblem(n=1, m=1).model(), held_out=[3, 4])
    monkeypatch.setattr(compiling, "run", lambda filter_, *data: seen.append([*map(np.shape, data)]))
    compile_filters(PLAN, NAMES)
    assert not seen  # where nothing is compiled
    monkeypatch.setattr(compiling, "is_interpreting", lambda: False)
    compile_filters(Plan("kf", (TUNNEL, recorded)), ["kf"])
    inputs = TUNNEL.data([0]).inputs.shape[-1]
    assert seen == [[(count, 2), (count, 1, p), (count, 2, 1)] for count, p in ((TRAINING_SEEDS, inputs), (3, 1))]


@pytest.mark.slow
def test_a_process_puts_its_code_into_the_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    helper = start(compiling.MODULE, {**orders_of(PLAN), "names": ["kf"]}, stderr=subprocess.PIPE)
    assert helper.wait(timeout=120) == 0, helper.stderr.read()
    end(helper)
    helper.stderr.close()
    assert [*tmp_path.rglob("*.o")]
