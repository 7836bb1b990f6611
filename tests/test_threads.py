"""Work shared by threads: all of it done once, whoever else asks, whatever goes wrong."""

import multiprocessing
import os
import threading
import time

import numpy as np
import pytest

from thruster_env.compiled import interpreted
from thruster_env.signals import LINE
from thruster_env.threads import Crew, crew, in_parts, spread

COUNT = 1000


def add_index(first, last, values):
    for i in range(first, last):
        values[i] += i


@pytest.fixture(scope="module")
def part():
    part = in_parts(add_index)
    crew().run(part, 1, np.zeros(1))  # compiled by this thread alone
    return part


@pytest.mark.parametrize("helpers", [0, 1, 3])
@pytest.mark.parametrize("pause", [0.0, 0.003])
def test_every_call_covers_everything_once(part, helpers, pause):
    team, values = Crew(helpers), np.zeros(COUNT)
    for _ in range(20):
        team.run(part, COUNT, values)
        time.sleep(pause)  # in the longer one the helpers go to sleep
    assert np.array_equal(values, 20.0 * np.arange(COUNT))


def test_fewer_tasks_than_threads(part):
    values = np.zeros(2)
    Crew(3).run(part, 2, values)
    assert np.array_equal(values, [0.0, 1.0])


def test_a_first_call_and_an_interpreted_one_are_made_alone():
    team = Crew(1)
    with interpreted():
        part = in_parts(add_index)
        for _ in range(2):
            values = np.zeros(COUNT)
            team.run(part, COUNT, values)
            assert np.array_equal(values, np.arange(COUNT))
    assert not team._signals.any()


def test_many_threads_may_ask_at_once(part):
    results = [np.zeros(COUNT) for _ in range(4)]

    def ask(values):
        for _ in range(200):
            crew().run(part, COUNT, values)

    callers = [threading.Thread(target=ask, args=(values,)) for values in results]
    for caller in callers:
        caller.start()
    for caller in callers:
        caller.join()
    assert all(np.array_equal(values, 200.0 * np.arange(COUNT)) for values in results)


class Failing:
    """Stands in for a compiled part, and fails in some places."""

    def __init__(self, part, places):
        self.part, self.places = part, places

    @property
    def direct(self):
        return self._fail_or_do

    def _fail_or_do(self, signals, place, *arguments):
        if place in self.places:
            raise KeyboardInterrupt
        self.part(signals, place, *arguments)


@pytest.mark.parametrize("places", [{0}, {1}, {2}, {1, 2}])
def test_after_a_failure_in_any_thread_no_helper_is_at_work_and_the_next_call_is_right(part, places):
    team, values = Crew(2), np.zeros(COUNT)
    with pytest.raises(KeyboardInterrupt):
        team.run(Failing(part, places), COUNT, values)
    assert (team._signals[::LINE] == 1).all()
    values[:] = 0.0
    team.run(part, COUNT, values)
    assert np.array_equal(values, np.arange(COUNT))


def _ask_in_child(part, results):
    values = np.zeros(COUNT)
    for _ in range(3):
        crew().run(part, COUNT, values)
    results.put(bool(np.array_equal(values, 3.0 * np.arange(COUNT))))


@pytest.mark.skipif(not hasattr(os, "fork"), reason="this system cannot fork")
def test_a_forked_child_has_a_crew_of_its_own(part):
    crew().run(part, COUNT, np.zeros(COUNT))
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
