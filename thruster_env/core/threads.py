"""Threads: calls in parts on all cores, worker threads and their flags, and how they wait.

A thread that has gone to sleep wakes up tens of microseconds after it is called. So worker threads wait for the
next call spinning, for half a millisecond, in compiled code that holds no lock, before they go to sleep, unless
the wait policy is "passive". The words are those of OpenMP's OMP_WAIT_POLICY. The environment variable
THRUSTER_WAIT_POLICY sets the policy of a process and of all that it starts, `waiting` that of a part of a program.

One integer is the number of the current call. For each part of a call that a worker thread may do, another one
says whether the part is open, taken or done. Every flag has a cache line of its own, so that writing one does not
slow down the reading of another.
"""

from __future__ import annotations

import itertools
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from queue import SimpleQueue

import numpy as np

from thruster_env.core.checks import one_of
from thruster_env.core.compiled import CompiledOrPython, function_fingerprint, inlined, overloaded

VARIABLE = "THRUSTER_WAIT_POLICY"
ACTIVE, PASSIVE = "active", "passive"

# Of flags.
LINE = 16  # integers of 8 bytes: two cache lines, for processors that fetch pairs
CALL = 0  # index of the current call's number
OPEN, TAKEN, DONE = 0, 1, 2  # what a part of a call may be
SPINS = 64  # at a number between two moments in which another thread may have the core
SPIN_ROUNDS = 1000  # such moments in a wait for the next call, of about half a microsecond each

# Of worker threads.
CALLER = 0  # place of the thread that makes a call; helpers are 1, 2, ...
BEHIND = 2  # calls that wait for a helper, with which it gets no more

# How many threads torch uses for small networks.


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


# How worker threads wait for the next call: "active", spinning for half a millisecond, or "passive", asleep.


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


# Atomic flags with which compiled code synchronises several threads.


def new_flags(count: int) -> np.ndarray:
    """Zeros: a cache line for each of `count` flags."""
    return np.zeros(LINE * count, np.int64)


@overloaded
def read(flags, index):
    """Read one flag (acquire): everything its writer wrote before is then visible."""
    return flags[index]


@overloaded
def post(flags, index, value):
    """Write one flag (release): a thread that reads it sees everything written before."""
    flags[index] = value


@overloaded
def take(marks, index, mark):
    """Mark a part if it is open (compare and swap); return whether it was open."""
    was_open = marks[index] == OPEN
    if was_open:
        marks[index] = mark
    return was_open


@overloaded
def yield_core():
    """Let another thread have the core if one wants it."""


@inlined
def wait_for(marks, index):
    """Wait until a part that another thread has taken is done."""
    spins = 0
    while read(marks, index) != DONE:
        spins += 1
        if spins % SPINS == 0:
            yield_core()


@inlined
def spin_for_call(flags, call, rounds):
    """Wait for the next call for a limited time, of some rounds (spin-wait)."""
    for _ in range(rounds):
        for _ in range(SPINS):
            if read(flags, CALL) > call:
                return
        yield_core()


@cache
def teach_numba() -> None:
    """Register numba's compilation of `read`, `post`, `take` and `yield_core` to atomic instructions."""
    from numba import extending, types
    from numba.extending import overload

    intrinsic: Callable = extending.intrinsic  # numba passes the context, of which its annotations do not know

    @intrinsic
    def load(context, flags, index):
        def generate(context, builder, signature, arguments):
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            return builder.load_atomic(builder.gep(array.data, [arguments[1]]), "acquire", 8)

        return types.int64(flags, types.intp), generate

    @intrinsic
    def store(context, flags, index, value):
        def generate(context, builder, signature, arguments):
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            builder.store_atomic(arguments[2], builder.gep(array.data, [arguments[1]]), "release", 8)
            return context.get_dummy_value()

        return types.void(flags, types.intp, types.int64), generate

    @intrinsic
    def exchange(context, marks, index, mark):
        def generate(context, builder, signature, arguments):
            array = context.make_array(signature.args[0])(context, builder, arguments[0])
            where, before = builder.gep(array.data, [arguments[1]]), context.get_constant(types.int64, OPEN)
            return builder.extract_value(builder.cmpxchg(where, before, arguments[2], "acq_rel", "acquire"), 1)

        return types.boolean(marks, types.intp, types.int64), generate

    sched_yield = types.ExternalFunction("sched_yield", types.int32())

    overload(read)(lambda flags, index: lambda flags, index: load(flags, index))
    overload(post)(lambda flags, index, value: lambda flags, index, value: store(flags, index, value))
    overload(take)(lambda marks, index, mark: lambda marks, index, mark: exchange(marks, index, mark))

    @overload(yield_core)
    def yield_core_compiled():
        def compiled_yield_core():
            sched_yield()

        return compiled_yield_core


# Work on all cores: calls in parts, and worker threads for calls that take some hundred microseconds.

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


def in_parts(work: Callable) -> CompiledOrPython:
    """Return the call that `WorkerThreads.run` makes: work(first, last, *arguments), compiled, in shared parts."""
    teach_numba()
    inlined(work)
    fingerprint = function_fingerprint(work, within=work.__module__)

    def part(flags, marks, thread, helpers, call, rounds, count, arguments):
        fingerprint  # noqa: B018 - part of the cache's key
        if thread == CALLER and helpers > 0:
            post(flags, CALL, call)
        # The caller does its own part, then each that no helper has taken; a helper does its own if it is open.
        last, mark = (helpers, DONE) if thread == CALLER else (thread, TAKEN)
        for p in range(thread, last + 1):
            if p == CALLER or take(marks, LINE * p, mark):
                if count > 0:
                    work(p * count // (helpers + 1), (p + 1) * count // (helpers + 1), *arguments)
                post(marks, LINE * p, DONE)
            elif thread == CALLER:
                wait_for(marks, LINE * p)
        if thread != CALLER:
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
        for thread, jobs in enumerate(self._jobs, 1):
            name, arguments = f"numerics-worker-{thread}", (thread, jobs)
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
            for thread, jobs in enumerate(self._jobs, 1):
                if jobs.qsize() < BEHIND:  # else it would keep the arguments of calls that are over
                    jobs.put((part, (flags, marks, thread, helpers, call, rounds, count, arguments), errors))
            part(flags, marks, CALLER, helpers, call, rounds, count, arguments)
        except BaseException:  # no helper may be at work when the caller goes on
            part(flags, marks, CALLER, helpers, call, rounds, 0, arguments)
            raise
        if errors:
            raise errors[0]

    def _help(self, thread: int, jobs: SimpleQueue) -> None:
        while True:
            part, arguments, errors = jobs.get()
            try:
                part(*arguments)
            except BaseException as error:
                errors.append(error)
                arguments[1][LINE * thread] = DONE
            del part, arguments, errors  # an env that is not stepped again can be freed
