"""Tasks on executors: in order here, from any executor as they end, again if workers die, or one line why not."""

import os
import signal
import time
from concurrent.futures import BrokenExecutor, Future, ThreadPoolExecutor
from pathlib import Path

import pytest

from thruster_env.core import parallel
from thruster_env.core.parallel import prepare_process, task_map


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
