"""Threads: calls in parts on all cores, how many torch uses, and how worker threads wait.

A thread that has gone to sleep wakes up tens of microseconds after it is called. So worker threads
(`graphs.workers`) wait for the next call spinning, unless the wait policy is "passive". The words are those of
OpenMP's OMP_WAIT_POLICY. The environment variable THRUSTER_WAIT_POLICY sets the policy of a process and of those
that it starts, `waiting` that of a part of a program.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache

import numpy as np

from thruster_env.core.checks import one_of

VARIABLE = "THRUSTER_WAIT_POLICY"
ACTIVE, PASSIVE = "active", "passive"


@contextmanager
def one_thread() -> Iterator[None]:
    """Within this context torch uses one thread, which is fastest for small networks.

    Several wait for one another a dozen times a step, which takes most of the time if the cores are busy.
    """
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


_policy: str | None = None  # None: the environment has not been asked yet


def wait_policy() -> str:
    """The policy in force: "active", unless the environment, as it first was, or `waiting` says otherwise.

    Raises:
        ValueError: if the environment variable holds another word.
    """
    global _policy
    if _policy is None:
        _policy = one_of(VARIABLE, os.environ.get(VARIABLE, ACTIVE), (ACTIVE, PASSIVE))
    return _policy


@contextmanager
def waiting(policy: str) -> Iterator[None]:
    """Within this context worker threads wait by this policy, also those of processes that are started in it.

    Args:
        policy: "active" where the program's next call comes soon and the cores are its own, "passive" where other
            threads or processes, such as torch's, want them between calls.

    Raises:
        ValueError: if the policy is neither.
    """
    global _policy
    before, inherited = _policy, os.environ.get(VARIABLE)
    _policy = os.environ[VARIABLE] = one_of("policy", policy, (ACTIVE, PASSIVE))
    try:
        yield
    finally:
        _policy = before
        if inherited is None:
            os.environ.pop(VARIABLE, None)
        else:
            os.environ[VARIABLE] = inherited


_of_thread = threading.local()  # whether a thread of the pool is at work on a part


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


if hasattr(os, "register_at_fork"):  # a forked child has none of the threads
    os.register_at_fork(after_in_child=_pool.cache_clear)
