"""Work on all cores: calls in parts, and worker threads for calls that take some hundred microseconds.

A thread that has gone to sleep wakes up tens of microseconds after it is called. So worker threads wait for
the next call spinning, during half a millisecond, in compiled code that holds no lock, before they go to sleep;
unless the wait policy is "passive" (`thruster_env.core.wait_policy`).
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from queue import SimpleQueue

import numpy as np

from thruster_env.core.atomics import (
    CALL,
    DONE,
    LINE,
    SPIN_ROUNDS,
    TAKEN,
    new_flags,
    post,
    spin_for_call,
    take,
    teach_numba,
    wait_for,
)
from thruster_env.core.compiled import CompiledOrPython, function_fingerprint, inlined
from thruster_env.core.wait_policy import ACTIVE, wait_policy

CALLER = 0  # place of the thread that makes a call; helpers are 1, 2, ...
_of_thread = threading.local()  # whether a thread of the pool is at work on a part
BEHIND = 2  # calls that wait for a helper, with which it gets no more


@cache
def cores() -> int:
    """Cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def spread(part: Callable[[int, int], None], count: int) -> None:
    """Call part(first, last) on all cores until it has covered 0 ... count; part releases the lock.

    After an exception, such as Ctrl-C, no further part begins. A part that calls `spread` itself does that work on
    its own core, for the others may all be waiting for it.

    The caller makes a call of nothing first, part(0, 0). What part compiles or loads is then there. A worker that
    loads code imports modules, and would wait for ever for one in whose import its caller is.
    """
    part(0, 0)
    if getattr(_of_thread, "is_working", False) or count < 2:  # a single part would only wait for its worker
        part(0, count)
        return
    edges = np.linspace(0, count, 1 + min(count, 4 * cores())).astype(int).tolist()
    parts = iter(list(itertools.pairwise(edges)))  # of all threads: what one has taken no other gets

    def work() -> None:
        _of_thread.is_working = True
        try:
            for first, last in parts:
                part(first, last)
        finally:
            list(parts)  # takes those that are left after an exception

    try:
        # One job for each thread: a job for each part would take longer to hand over than short parts take.
        for job in [_pool().submit(work) for _ in range(min(cores(), count))]:
            job.result()
    finally:
        list(parts)


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(cores(), thread_name_prefix="numerics-pool")


def in_parts(work: Callable) -> CompiledOrPython:
    """Return the call that `WorkerThreads.run` makes: work(first, last, *arguments), compiled, in shared parts."""
    teach_numba()
    inlined(work)
    fingerprint = function_fingerprint(work, within=work.__module__)

    def part(flags, marks, place, helpers, call, rounds, count, arguments):
        fingerprint  # noqa: B018 - part of the cache's key
        if place == CALLER and helpers > 0:
            post(flags, CALL, call)
        # The caller does its own part, then each that no helper has taken; a helper does its own if it is open.
        last, mark = (helpers, DONE) if place == CALLER else (place, TAKEN)
        for p in range(place, last + 1):
            if p == CALLER or take(marks, LINE * p, mark):
                if count > 0:
                    work(p * count // (helpers + 1), (p + 1) * count // (helpers + 1), *arguments)
                post(marks, LINE * p, DONE)
            elif place == CALLER:
                wait_for(marks, LINE * p)
        if place != CALLER:
            spin_for_call(flags, call, rounds)

    return CompiledOrPython(part)


@cache
def worker_threads() -> WorkerThreads:
    """The worker threads of this process, one for each core but one."""
    return WorkerThreads(cores() - 1 if hasattr(os, "sched_yield") else 0)


if hasattr(os, "register_at_fork"):  # a forked child has none of the threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
    os.register_at_fork(after_in_child=worker_threads.cache_clear)


class WorkerThreads:
    """Threads that share the work of a call with the thread that makes it.

    The state of a call, its parts and who has taken them, belongs to the call and not to the workers. The calling
    thread does every part that no worker has begun, so that it never waits for a worker that is late or busy with
    another call. An exception at any moment, such as Ctrl-C, leaves the workers unchanged.
    """

    def __init__(self, helpers: int):
        """Start `helpers` threads."""
        self._flags, self._nothing = new_flags(1), new_flags(1)
        self._calls = itertools.count(1)
        self._jobs: list[SimpleQueue] = [SimpleQueue() for _ in range(helpers)]
        for place, jobs in enumerate(self._jobs, 1):
            name, arguments = f"numerics-worker-{place}", (place, jobs)
            threading.Thread(target=self._help, args=arguments, name=name, daemon=True).start()

    def run(self, part: CompiledOrPython, count: int, *arguments, alone: bool = False) -> None:
        """Cover 0 ... count with calls of a part made by `in_parts`.

        The caller does all of it if `alone`, and while it is not known whether numba takes the part.
        """
        direct = part.direct
        if alone or direct is part or not self._jobs:
            part(self._flags, self._nothing, CALLER, 0, 0, 0, count, arguments)
        else:
            self._share(direct, count, arguments)

    def _share(self, part: Callable, count: int, arguments: tuple) -> None:
        flags, helpers, call = self._flags, len(self._jobs), next(self._calls)
        rounds = SPIN_ROUNDS if wait_policy() == ACTIVE else 0
        marks = new_flags(helpers + 1)
        errors: list[BaseException] = []
        try:
            for place, jobs in enumerate(self._jobs, 1):
                if jobs.qsize() < BEHIND:  # else it would keep the arguments of calls that are over
                    jobs.put((part, (flags, marks, place, helpers, call, rounds, count, arguments), errors))
            part(flags, marks, CALLER, helpers, call, rounds, count, arguments)
        except BaseException:  # no helper may be at work when the caller goes on
            part(flags, marks, CALLER, helpers, call, rounds, 0, arguments)
            raise
        if errors:
            raise errors[0]

    def _help(self, place: int, jobs: SimpleQueue) -> None:
        while True:
            part, arguments, errors = jobs.get()
            try:
                part(*arguments)
            except BaseException as error:
                errors.append(error)
                arguments[1][LINE * place] = DONE
            del part, arguments, errors  # an env that is not stepped again can be freed
