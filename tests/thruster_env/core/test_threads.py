"""Work shared by threads: all of it done once, whoever else asks, whatever goes wrong."""

import contextlib
import multiprocessing
import os
import sys
import threading
import time
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from importlib import import_module
from queue import SimpleQueue

import numpy as np
import pytest

from thruster_env.core.compiled import interpreted
from thruster_env.core.threads import (
    BEHIND,
    CALLER,
    LINE,
    SPIN_ROUNDS,
    TAKEN,
    WorkerThreads,
    in_parts,
    spread,
    take,
    waiting,
    worker_threads,
)

COUNT = 1000


def add_index(first, last, values):
    for i in range(first, last):
        values[i] += i


@pytest.fixture(scope="module")
def part():
    part = in_parts(add_index)
    worker_threads().run(part, 1, np.zeros(1))  # compiled by this thread alone
    return part


@pytest.mark.parametrize("helpers", [0, 1, 3])
@pytest.mark.parametrize("pause", [0.0, 0.003])
def test_every_call_covers_everything_once(part, helpers, pause):
    workers, values = WorkerThreads(helpers), np.zeros(COUNT)
    for _ in range(20):
        workers.run(part, COUNT, values)
        time.sleep(pause)  # in the longer one the helpers go to sleep
    assert np.array_equal(values, 20.0 * np.arange(COUNT))


def test_fewer_tasks_than_threads(part):
    values = np.zeros(2)
    WorkerThreads(3).run(part, 2, values)
    assert np.array_equal(values, [0.0, 1.0])


def test_a_first_call_and_an_interpreted_one_are_made_alone():
    workers = WorkerThreads(1)
    with interpreted():
        part = in_parts(add_index)
        for _ in range(2):
            values = np.zeros(COUNT)
            workers.run(part, COUNT, values)
            assert np.array_equal(values, np.arange(COUNT))
    assert not workers._flags.any()


def test_many_threads_may_ask_at_once(part):
    results = [np.zeros(COUNT) for _ in range(4)]

    def ask(values):
        for _ in range(200):
            worker_threads().run(part, COUNT, values)

    callers = [threading.Thread(target=ask, args=(values,)) for values in results]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert all(np.array_equal(values, 200.0 * np.arange(COUNT)) for values in results)


class Rehearsed:
    """Stands in for a compiled part: the caller begins when all helpers have, and some places fail."""

    def __init__(self, part, helpers, failing=()):
        self.part, self.begun, self.failing = part, threading.Barrier(helpers + 1), failing

    @property
    def direct(self):
        return self._fail_or_do

    def _fail_or_do(self, flags, marks, place, helpers, call, rounds, count, arguments):
        if count > 0:  # else it only makes sure that no helper is at work
            if place != CALLER and place in self.failing:
                take(marks, LINE * place, TAKEN)
            self.begun.wait(30)
            if place in self.failing:
                raise KeyboardInterrupt
        self.part(flags, marks, place, helpers, call, rounds, count, arguments)


@pytest.mark.parametrize("failing", [{0}, {1}, {2}, {1, 2}])
def test_after_a_failure_in_any_thread_the_next_call_is_right(part, failing):
    workers, values = WorkerThreads(2), np.zeros(COUNT)
    with pytest.raises(KeyboardInterrupt):
        workers.run(Rehearsed(part, 2, failing), COUNT, values)
    values[:] = 0.0
    workers.run(part, COUNT, values)
    assert np.array_equal(values, np.arange(COUNT))


class Noted:
    """Stands in for a compiled part, and notes for how many rounds the helpers are to wait."""

    def __init__(self, part):
        self.part, self.rounds = part, set()

    @property
    def direct(self):
        return self._note

    def _note(self, flags, marks, place, helpers, call, rounds, count, arguments):
        self.rounds.add(rounds)
        self.part(flags, marks, place, helpers, call, rounds, count, arguments)


def test_the_wait_policy_reaches_the_helpers_and_changes_no_number(part):
    workers = WorkerThreads(2)
    for policy, rounds in (("passive", 0), ("active", SPIN_ROUNDS)):
        noted, values = Noted(part), np.zeros(COUNT)
        with waiting(policy):
            for _ in range(5):
                workers.run(noted, COUNT, values)
        assert noted.rounds == {rounds}
        assert np.array_equal(values, 5.0 * np.arange(COUNT))


@contextmanager
def interrupted_at(moment):
    """Raise KeyboardInterrupt before the byte code of this number in what the workers do in this thread."""
    passed = 0

    def count(frame, event, argument):
        nonlocal passed
        frame.f_trace_opcodes = True
        if event == "opcode":
            passed += 1
            if passed == moment:
                raise KeyboardInterrupt
        return count

    def trace(frame, event, argument):
        return count(frame, event, argument) if frame.f_code in OF_THE_WORKERS else None

    before = sys.gettrace()
    sys._getframe().f_trace_opcodes = True  # Python 3.12 tells byte codes only if a frame asks before settrace
    sys.settrace(trace)
    try:
        yield lambda: passed
    finally:
        sys.settrace(before)


OF_THE_WORKERS = (WorkerThreads.run.__code__, WorkerThreads._share.__code__)


def test_ctrl_c_at_any_moment_leaves_workers_that_help(part):
    workers, moment = WorkerThreads(2), 0
    while True:
        moment, values = moment + 1, np.zeros(COUNT)
        with interrupted_at(moment) as passed:
            with contextlib.suppress(KeyboardInterrupt):
                workers.run(part, COUNT, values)
        done = values.copy()
        while not all(jobs.empty() for jobs in workers._jobs):
            time.sleep(1e-4)
        expected = values + np.arange(COUNT)
        workers.run(Rehearsed(part, 2), COUNT, values)  # would wait in vain for a helper that does not come
        assert np.array_equal(values, expected)
        assert np.isin(done - np.arange(COUNT) * (done != 0), 0).all()  # what is done is done once
        if passed() < moment:
            break
    assert moment > 80


def test_a_helper_that_never_comes_is_not_waited_for(part):
    workers, values = WorkerThreads(2), np.zeros(COUNT)
    workers._jobs[1] = SimpleQueue()  # nobody spins into this one
    for _ in range(5):
        workers.run(part, COUNT, values)
    assert np.array_equal(values, 5.0 * np.arange(COUNT))
    assert workers._jobs[1].qsize() == BEHIND


def _ask_in_child(part, results):
    values = np.zeros(COUNT)
    for _ in range(3):
        worker_threads().run(part, COUNT, values)
    results.put(bool(np.array_equal(values, 3.0 * np.arange(COUNT))))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_forked_child_has_workers_of_its_own(part):
    worker_threads().run(part, COUNT, np.zeros(COUNT))
    context = multiprocessing.get_context("fork")
    results = context.SimpleQueue()
    child = context.Process(target=_ask_in_child, args=(part, results))
    child.start()
    child.join(60)
    assert child.exitcode == 0
    assert results.get()


def test_spread_covers_everything_once():
    values = np.zeros(COUNT)
    spread(lambda first, last: add_index(first, last, values), COUNT)
    assert np.array_equal(values, np.arange(COUNT))


@pytest.mark.parametrize("error", [ValueError, KeyboardInterrupt])
def test_after_an_exception_no_further_part_of_spread_begins(error, monkeypatch):
    pool, begun, raised = ThreadPoolExecutor(2), [], threading.Event()
    monkeypatch.setattr("thruster_env.core.threads._pool", lambda: pool)
    monkeypatch.setattr("thruster_env.core.threads.cores", lambda: 50)

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
from thruster_env.core.threads import spread
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
