"""Work on all cores: calls in parts, and a crew of threads for calls that take some hundred microseconds.

A thread that has gone to sleep wakes up tens of microseconds after it is called. So the crew's threads look out
for the next call during half a millisecond, in compiled code that holds no lock, before they go to sleep.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from queue import SimpleQueue

import numpy as np

from thruster_env.compiled import CompiledOrPython, function_fingerprint, inlined
from thruster_env.signals import CALL, LINE, announce, finish, new_signals, teach_numba, wait_for_helpers

ALONE, CALLER = -1, 0  # places of a thread that works by itself, and of one that has helpers 1, 2, ...


@cache
def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def spread(part: Callable[[int, int], None], count: int) -> None:
    """Call part(first, last) on all cores until it has covered 0 ... count; part releases the lock."""
    edges = np.linspace(0, count, 1 + min(count, 4 * cores())).astype(int)
    list(_pool().map(part, edges[:-1], edges[1:]))


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), thread_name_prefix="thrusters")


def in_parts(work: Callable) -> CompiledOrPython:
    """Return the call that `Crew.run` makes: work(first, last, *arguments), compiled, with the crew's signals."""
    teach_numba()
    inlined(work)
    fingerprint = function_fingerprint(work)

    def part(signals, place, helpers, call, first, last, arguments):
        fingerprint  # noqa: B018 - part of the cache's key
        if place == CALLER:
            announce(signals, call)
        work(first, last, *arguments)
        if place == CALLER:
            wait_for_helpers(signals, helpers, call)
        elif place > CALLER:
            finish(signals, place, call)

    return CompiledOrPython(part)


@cache
def crew() -> Crew:
    """The crew of this process, a thread for each core but one."""
    return Crew(cores() - 1 if hasattr(os, "sched_yield") else 0)


if hasattr(os, "register_at_fork"):  # a forked child has none of the threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
    os.register_at_fork(after_in_child=crew.cache_clear)


class Crew:
    """Threads that share the work of a call with the thread that makes it."""

    def __init__(self, helpers: int):
        """Start `helpers` threads."""
        self._signals = new_signals(helpers)
        self._calls = 0
        self._busy = threading.Lock()
        self._jobs = [SimpleQueue() for _ in range(helpers)]
        self._errors: list[BaseException] = []
        for place, jobs in enumerate(self._jobs, 1):
            name, arguments = f"thruster-crew-{place}", (place, jobs)
            threading.Thread(target=self._help, args=arguments, name=name, daemon=True).start()

    def run(self, part: CompiledOrPython, count: int, *arguments, alone: bool = False) -> None:
        """Cover 0 ... count with calls of a part made by `in_parts`.

        The caller does all of it if `alone`, while another thread has the crew, and if numba has refused the part.
        """
        direct = part.direct
        alone = alone or direct is part or not self._jobs
        if not alone and self._busy.acquire(blocking=False):
            try:
                self._share(direct, count, arguments)
            finally:
                self._busy.release()
        else:
            part(self._signals, ALONE, 0, 0, 0, count, arguments)

    def _share(self, part: Callable, count: int, arguments: tuple) -> None:
        signals, helpers = self._signals, len(self._jobs)
        self._calls = call = self._calls + 1
        edges = [i * count // (helpers + 1) for i in range(helpers + 2)]
        given = 0
        try:
            for jobs in self._jobs:
                given += 1
                first, last = edges[given], edges[given + 1]
                jobs.put((part, (signals, given, helpers, call, first, last, arguments)))
            part(signals, CALLER, helpers, call, 0, edges[1], arguments)
        except BaseException:  # no helper may be at work when the caller goes on
            signals[CALL] = call
            while any(signals[LINE * place] < call for place in range(1, given + 1)):
                time.sleep(1e-5)
            raise
        if self._errors:
            errors, self._errors = self._errors, []
            raise errors[0]

    def _help(self, place: int, jobs: SimpleQueue) -> None:
        while True:
            part, arguments = jobs.get()
            try:
                part(*arguments)
            except BaseException as error:
                self._errors.append(error)
                self._signals[LINE * place] = arguments[3]
            del part, arguments  # an env that is not stepped again can be freed
