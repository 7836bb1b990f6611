"""Work shared by worker threads: all of it done once, whoever else asks, whatever goes wrong."""

import contextlib
import ctypes
import multiprocessing
import os
import sys
import threading
import time
from array import array
from contextlib import contextmanager
from queue import SimpleQueue

import numpy as np
import pytest

from thruster_env.core.compiled import interpreted
from thruster_env.core.parallel import waiting
from thruster_env.graphs.loops import machine_code_of
from thruster_env.graphs.machine_code import words_of
from thruster_env.graphs.workers import BEHIND, CALLER, SPIN_ROUNDS, InParts, WorkerThreads, worker_threads

COUNT = 1000


def add_index(first, last, values):
    for i in range(first, last):
        values[i] += i


@pytest.fixture(scope="module")
def ask():
    """Have workers add its index to each number, or to some of them."""
    code = machine_code_of(add_index, [None, None, (None,)])

    def ask(workers, values, count=COUNT):
        workers.run(code, count, array("q", words_of((0, count, values))))

    return ask


@pytest.mark.parametrize("few", [2, COUNT + 1])
def test_work_is_done_in_parts(few):
    for context in (contextlib.nullcontext(), interpreted()):
        with context:
            values, in_parts = np.zeros(COUNT), InParts(add_index, [(None,)], few=few)
            call = in_parts.on(COUNT, (), values.shape)
        for result in (values, values, np.zeros(COUNT)):
            call(result)
        assert np.array_equal(values, 2.0 * np.arange(COUNT)) and np.array_equal(result, np.arange(COUNT))


def test_a_single_one_has_quick_calls():
    single, values = InParts(add_index, [(None,)], single=True), np.full(1, 3.0)
    single.on(1, (), values.shape)(values)
    single.on_result((), values)()
    assert values == [3.0]


@pytest.mark.parametrize("helpers", [0, 1, 3])
@pytest.mark.parametrize("pause", [0.0, 0.003])
def test_every_call_covers_everything_once(ask, helpers, pause):
    workers, values = WorkerThreads(helpers), np.zeros(COUNT)
    for _ in range(20):
        ask(workers, values)
        time.sleep(pause)  # in the longer one the helpers go to sleep
    assert np.array_equal(values, 20.0 * np.arange(COUNT))


def test_fewer_tasks_than_threads(ask):
    values = np.zeros(2)
    ask(WorkerThreads(3), values, 2)
    assert np.array_equal(values, [0.0, 1.0])


def test_many_threads_may_ask_at_once(ask):
    results = [np.zeros(COUNT) for _ in range(4)]

    def ask_often(values):
        for _ in range(200):
            ask(worker_threads(), values)

    callers = [threading.Thread(target=ask_often, args=(values,)) for values in results]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert all(np.array_equal(values, 200.0 * np.arange(COUNT)) for values in results)


class Rehearsed:
    """Stands in for the workers' machine code: all begin when all are there; the caller may fail then."""

    def __init__(self, workers, helpers, *, fails=False):
        self.run, self.begun, self.fails, self.rounds = workers._run, threading.Barrier(helpers + 1), fails, set()
        workers._run = self

    def __call__(self, address):
        thread, count, *_, rounds = (ctypes.c_int64 * 10).from_address(address)
        if count > 0:  # else it only makes sure that no helper is at work
            self.rounds.add(rounds)
            self.begun.wait(30)
            if self.fails and thread == CALLER:
                raise KeyboardInterrupt
        self.run(address)


def test_after_a_failure_the_next_call_is_right(ask):
    workers, values = WorkerThreads(2), np.zeros(COUNT)
    rehearsed = Rehearsed(workers, 2, fails=True)
    with pytest.raises(KeyboardInterrupt):
        ask(workers, values)
    rehearsed.fails, values[:] = False, 0.0
    ask(workers, values)
    assert np.array_equal(values, np.arange(COUNT))


def test_the_wait_policy_reaches_the_helpers_and_changes_no_number(ask):
    for policy, rounds in (("passive", 0), ("active", SPIN_ROUNDS)):
        workers, values = WorkerThreads(2), np.zeros(COUNT)
        rehearsed = Rehearsed(workers, 2)
        with waiting(policy):
            for _ in range(5):
                ask(workers, values)
        assert rehearsed.rounds == {rounds}
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
        return count(frame, event, argument) if frame.f_code is WorkerThreads.run.__code__ else None

    before = sys.gettrace()
    sys._getframe().f_trace_opcodes = True  # Python 3.12 tells byte codes only if a frame asks before settrace
    sys.settrace(trace)
    try:
        yield lambda: passed
    finally:
        sys.settrace(before)


def test_ctrl_c_at_any_moment_leaves_workers_that_help(ask):
    workers, moment = WorkerThreads(2), 0
    while True:
        moment, values = moment + 1, np.zeros(COUNT)
        with interrupted_at(moment) as passed:
            with contextlib.suppress(KeyboardInterrupt):
                ask(workers, values)
        done = values.copy()
        while not all(jobs.empty() for jobs in workers._jobs):
            time.sleep(1e-4)
        expected, run = values + np.arange(COUNT), workers._run
        Rehearsed(workers, 2)
        ask(workers, values)  # would wait in vain for a helper that does not come
        workers._run = run
        assert np.array_equal(values, expected)
        assert np.isin(done - np.arange(COUNT) * (done != 0), 0).all()  # what is done is done once
        if passed() < moment:
            break
    assert moment > 80


def test_a_helper_that_never_comes_is_not_waited_for(ask):
    workers, values = WorkerThreads(2), np.zeros(COUNT)
    workers._jobs[1] = SimpleQueue()  # nobody spins into this one
    for _ in range(5):
        ask(workers, values)
    assert np.array_equal(values, 5.0 * np.arange(COUNT))
    assert workers._jobs[1].qsize() == BEHIND


def _ask_in_child(ask, results):
    values = np.zeros(COUNT)
    for _ in range(3):
        ask(worker_threads(), values)
    results.put(bool(np.array_equal(values, 3.0 * np.arange(COUNT))))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_forked_child_has_workers_of_its_own(ask):
    ask(worker_threads(), np.zeros(COUNT))
    context = multiprocessing.get_context("fork")
    results = context.SimpleQueue()
    child = context.Process(target=_ask_in_child, args=(ask, results))
    child.start()
    child.join(60)
    assert child.exitcode == 0
    assert results.get()
