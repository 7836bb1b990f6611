"""Work spread over threads and executors, how threads wait, and what is told of progress."""

import os
import signal
import threading
import time
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest

from thruster_env.core import parallel
from thruster_env.core.checks import listening, with_progress
from thruster_env.core.parallel import VARIABLE, prepare_process, spread, task_map, waiting

COUNT = 1000


def add_index(first, last, values):
    for i in range(first, last):
        values[i] += i


def test_spread_covers_everything_once():
    values = np.zeros(COUNT)
    spread(lambda first, last: add_index(first, last, values), COUNT)
    assert np.array_equal(values, np.arange(COUNT))


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_after_an_exception_no_further_part_of_spread_begins(error, monkeypatch):
    pool, begun, raised = ThreadPoolExecutor(2), [], threading.Event()
    monkeypatch.setattr("thruster_env.core.parallel._pool", lambda: pool)
    monkeypatch.setattr("thruster_env.core.parallel.cores", lambda: 50)

    def fail(*_):
        raised.set()
        raise error

    def part(first, last):
        begun.append(first)
        if first == 0 < last and error is ValueError:
            fail()
        if last:
            raised.wait(10)  # a guard, not a measurement
            time.sleep(0.01)  # what was raised gets to the caller

    if error is KeyboardInterrupt:  # it comes to the caller, while that waits
        monkeypatch.setattr(Future, "result", fail)
    with pytest.raises(error):
        spread(part, 200)
    pool.shutdown()
    assert len(begun) < 100


def test_a_part_may_spread_work_itself():
    found = np.zeros((40, 30))

    def row(i):
        def cells(first, last):
            found[i, first:last] += 1.0

        return cells

    def rows(first, last):
        for i in range(first, last):
            spread(row(i), 30)

    calling = threading.Thread(target=spread, args=(rows, 40), daemon=True)  # it once waited for ever
    calling.start()
    calling.join(timeout=20.0)
    assert not calling.is_alive() and (found == 1.0).all()


def test_work_that_is_spread_while_a_module_is_imported_may_import_it(tmp_path, monkeypatch):
    # A worker that loads compiled code of a model imports the model's module: it would wait for the end of
    # an import that waits for the worker.
    source = """
from importlib import import_module
from thruster_env.core.parallel import spread
found = []
def part(first, last):
    if not found:
        found.append(import_module(__name__))
spread(part, 8)
"""
    (tmp_path / "spreads_at_import.py").write_text(source)
    monkeypatch.syspath_prepend(tmp_path)
    importing = threading.Thread(target=import_module, args=("spreads_at_import",), daemon=True)
    importing.start()
    importing.join(60.0)  # a guard, not a measurement
    assert not importing.is_alive()
    assert import_module("spreads_at_import").found


@pytest.fixture(params=[None, "active", "passive"])
def inherited(request, monkeypatch):
    """A process that was started with this in its environment, and has not asked for it yet."""
    monkeypatch.setattr(parallel, "_policy", None)
    if request.param is None:
        monkeypatch.delenv(VARIABLE, raising=False)
    else:
        monkeypatch.setenv(VARIABLE, request.param)
    return request.param


def test_the_environment_counts_then_the_context_and_afterwards_all_is_as_it_was(inherited):
    usual = inherited or "active"
    with pytest.raises(KeyboardInterrupt), waiting("passive"):
        with waiting("active"):
            assert parallel.wait_policy() == "active"
        assert parallel.wait_policy() == "passive"
        raise KeyboardInterrupt
    assert parallel.wait_policy() == usual and os.environ.get(VARIABLE) == inherited


def test_an_error_within_the_context_is_not_hidden_by_a_variable_that_is_gone(inherited, monkeypatch):
    with pytest.raises(KeyboardInterrupt), waiting("passive"):
        monkeypatch.delenv(VARIABLE)
        raise KeyboardInterrupt
    assert os.environ.get(VARIABLE) == inherited


def test_a_process_that_is_started_within_the_context_waits_as_it_says(inherited, monkeypatch):
    with waiting("passive"):
        monkeypatch.setattr(parallel, "_policy", None)  # as it is in a new process, which has this environment
        assert parallel.wait_policy() == "passive"


def test_another_word_is_refused(monkeypatch):
    monkeypatch.setattr(parallel, "_policy", None)
    monkeypatch.setenv(VARIABLE, "pasive")
    with pytest.raises(ValueError, match=f"{VARIABLE} must be one of active, passive, but got 'pasive'; did you"):
        parallel.wait_policy()
    with pytest.raises(ValueError, match="policy must be one of active, passive, but got 0"), waiting(0):
        pass


def test_what_is_inside_a_part_stands_behind_it_and_a_single_part_is_not_told():
    heard = []
    with listening(heard.append):
        for part in with_progress("N", (5, 10)):
            for _ in with_progress("runs", range(part), sizes=[2] * part):
                break  # leaves nothing behind
            assert list(with_progress("alone", [1])) == [1]
        assert list(with_progress("runs", [3, 4])) == [3, 4]
    assert list(with_progress("unheard", [1, 2])) == [1, 2]
    inside = ["N: 0 of 2", "N: 0 of 2, runs: 0 of 10", "N: 1 of 2", "N: 1 of 2, runs: 0 of 20"]
    assert heard == [*inside, "runs: 0 of 2", "runs: 1 of 2"]


def test_work_goes_on_after_whoever_listened_has_stopped():
    heard = []
    with listening(heard.append):
        parts = with_progress("runs", [5, 6, 7])
        assert next(parts) == 5
    assert list(parts) == [6, 7]
    assert heard == ["runs: 0 of 3"]


def square(number):
    return number**2


def die_once(folder, number):
    """Kill this process, which the parent must not be, the first time that it comes to the third task."""
    marker = Path(folder) / "died"
    if number == 2 and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return os.getpid(), number


def test_tasks_run_in_order_here_and_anywhere_on_any_executor():
    with task_map() as tasks:
        assert list(tasks(square, [(1,), (2,), (3,)])) == [(0, 1), (1, 4), (2, 9)] and not tasks.is_remote
    with ThreadPoolExecutor(2) as pool, task_map(pool) as tasks:
        assert dict(tasks(square, [(1,), (2,), (3,)])) == {0: 1, 1: 4, 2: 9} and tasks.is_remote
        assert list(tasks(square, [])) == []


def test_a_part_of_a_worker_that_was_killed_runs_again(tmp_path):
    with task_map("processes:2") as tasks:
        with pytest.warns(UserWarning, match="a worker has died: [1-4] tasks are run again"):
            results = dict(tasks(die_once, [(tmp_path, number) for number in range(4)]))
        processes = list(tasks._executor._processes.values())
    assert [results[index][1] for index in range(4)] == [0, 1, 2, 3]
    assert os.getpid() not in {process for process, _ in results.values()}
    assert not any(process.is_alive() for process in processes)


class Broken(ThreadPoolExecutor):
    """Does some tasks, and then is broken."""

    def __init__(self, left):
        super().__init__(1)
        self.left = left

    def submit(self, *arguments):
        if self.left:
            self.left -= 1
            return super().submit(*arguments)
        future = Future()
        future.set_exception(BrokenExecutor("no worker is left"))
        return future


def test_the_rest_of_an_executor_that_breaks_runs_here_and_ours_are_not_opened_for_ever(monkeypatch):
    with Broken(1) as pool, task_map(pool) as tasks, pytest.warns(UserWarning, match="run in this process"):
        assert dict(tasks(square, [(1,), (2,), (3,)])) == {0: 1, 1: 4, 2: 9}
    monkeypatch.setattr(parallel, "opener_of", lambda name: lambda: Broken(0))
    with task_map("processes:2") as tasks, pytest.warns(UserWarning, match="1 tasks are run again"):
        with pytest.raises(ValueError, match="workers must live until .* but died 3 times without finishing one"):
            list(tasks(square, [(1,)]))


def test_who_stops_waits_for_no_task_that_has_not_begun():
    numbers = [(0.02, number) for number in range(50)]
    with ThreadPoolExecutor(1) as pool, task_map(pool) as elsewhere, task_map() as here:
        assert next(elsewhere(wait, numbers)) == (0, 0)  # which ends there
        assert len(WAITED) < 50
        for tasks, most in ((here, 2), (elsewhere, 3)):
            finished = []
            for index, _ in tasks(wait, numbers, stop=lambda: len(finished) > 1):  # noqa: B023 - it is called here
                finished.append(index)
            assert finished == [*range(len(finished))] and 2 <= len(finished) <= most


WAITED = []


def wait(seconds, number):
    WAITED.append(number)
    time.sleep(seconds)
    return number


def test_an_error_of_a_task_is_the_callers():
    with (
        ThreadPoolExecutor(1) as pool,
        task_map(pool) as tasks,
        pytest.raises(TypeError, match="unsupported operand"),
    ):
        list(tasks(square, [(None,)]))


@pytest.mark.parametrize(
    ("where", "message"),
    [
        ("threads:2", "executor .--executor. must be processes:N, mpi or dask:ADDRESS, but got 'threads:2'"),
        ("dask:", "but got 'dask:'"),
        ("processes:0", "executor .--executor. processes must be a whole number of at least 1, but got '0'"),
        (3, "or a concurrent.futures.Executor, but got 3"),
    ],
)
def test_other_words_are_refused(where, message):
    with pytest.raises(ValueError, match=message), task_map(where):
        pass


def test_what_has_no_name_is_refused_in_one_line():
    with ThreadPoolExecutor(1) as pool, task_map(pool) as tasks:
        with pytest.raises(
            ValueError, match="must be made of named functions for an executor, but cannot be pickled"
        ):
            list(tasks(lambda: 0, [()]))


def test_a_process_leaves_ctrl_c_to_its_parent_and_ends_with_it(monkeypatch):
    ended, before = [], signal.getsignal(signal.SIGINT)
    monkeypatch.setattr(os, "_exit", ended.append)
    monkeypatch.setattr(parallel, "take_share", lambda count: None)
    monkeypatch.setattr(parallel.multiprocessing, "parent_process", lambda: None)
    try:
        prepare_process(2)
        assert signal.getsignal(signal.SIGINT) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGINT, before)
    deadline = time.monotonic() + 10.0
    while not ended and time.monotonic() < deadline:
        time.sleep(0.01)
    assert ended == [1]
