"""Functions as machine code on all cores: parts of a call are shared by worker threads.

A thread that has gone to sleep wakes up tens of microseconds after it is called. So worker threads wait for the
next call spinning, for half a millisecond, in machine code that holds no lock, before they go to sleep, unless the
wait policy (`core.parallel`) is "passive".

One integer is the number of the current call. For each part of a call that a worker thread may do, another one
says whether the part is open, taken or done. Every flag has a cache line of its own, so that writing one does not
slow down the reading of another.
"""

from __future__ import annotations

import itertools
import os
import threading
from array import array
from collections.abc import Callable, Sequence
from functools import cache, cached_property, partial
from queue import SimpleQueue
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]

from thruster_env.core.compiled import is_interpreting
from thruster_env.core.parallel import ACTIVE, cores, wait_policy
from thruster_env.graphs.expressions import instruction
from thruster_env.graphs.instructions import LONG
from thruster_env.graphs.loops import machine_code_of
from thruster_env.graphs.machine_code import Code, address_of, builtin_of, runner_of, words_of

# Of flags.
LINE = 16  # integers of 8 bytes: two cache lines, for processors that fetch pairs
CALL = 0  # index of the current call's number
OPEN, TAKEN, DONE = 0, 1, 2  # what a part of a call may be
OPEN_MARK = array("q", [OPEN] * LINE)
SPINS = 64  # at a number between two moments in which another thread may have the core
SPIN_ROUNDS = 1000  # such moments in a wait for the next call, of about half a microsecond each

# Of worker threads.
CALLER = 0  # number of the thread that makes a call; helpers are 1, 2, ...
BEHIND = 2  # calls that wait for a helper, with which it gets no more


class InParts:
    """Calls of work(first, last, *arguments, result) that cover 0 ... count, on all cores if these are many.

    If it is no machine code, or within `interpreted()`, it runs as Python.
    """

    def __init__(self, work: Callable, shapes: Sequence, *, few: int = 2, single: bool = False):
        """Compile nothing yet.

        Args:
            work: a Python function.
            shapes: of its arguments after the first two, see `graphs.loops.add_function`; the last is an array.
            few: smallest count that is shared.
            single: whether the count is always 1, and calls have to be quick.
        """
        self._work, self._shapes, self._few, self._single = work, shapes, few, single
        self.in_python = is_interpreting()

    @cached_property
    def _code(self) -> Code | None:
        if self.in_python:
            return None
        return machine_code_of(self._work, (None, None, *self._shapes), as_builtin=self._single, unrolled=False)

    def on(self, count: int, arguments: tuple, lengths: Sequence[int]) -> Callable[[np.ndarray], Any]:
        """`call(result)` with an array of these lengths; the other arrays stay where they are."""
        code, before = self._code, (0, count, *arguments)
        if self._single:
            return lambda result: self.on_result(arguments, result)()
        if code is None:
            return lambda result: self._as_python(*before, result)
        words, shared, alone = array("q", [*words_of(before), 0, *lengths]), count >= self._few, runner_of(code)
        at, of_result = words.buffer_info()[0], len(words) - 1 - len(lengths)

        def call(result: np.ndarray) -> None:
            arguments  # noqa: B018 - whose arrays live as long as the function
            words[of_result] = address_of(result)
            if shared:
                worker_threads().run(code, count, words)
            else:
                alone(at)

        return call

    def on_result(self, arguments: tuple, result: np.ndarray) -> Callable[[], Any]:
        """`call()` of a single one with arrays that all stay where they are."""
        code, before = self._code, (0, 1, *arguments)
        if code is None:
            return partial(self._as_python, *before, result)
        return partial(builtin_of(code, *before, lengths=result.shape), address_of(result))

    def _as_python(self, *arguments):
        with np.errstate(all="ignore"):
            return self._work(*arguments)


def _at(builder: ir.IRBuilder, address: ir.Value, index: ir.Value) -> ir.Value:
    return builder.gep(builder.inttoptr(address, LONG.as_pointer()), [index], source_etype=LONG)


@instruction
def read(builder, flags, index):
    """Read one flag (acquire): everything its writer wrote before is then visible."""
    return builder.load_atomic(_at(builder, flags, index), "acquire", 8, typ=LONG)


@instruction
def post(builder, flags, index, value):
    """Write one flag (release): a thread that reads it sees everything written before."""
    builder.store_atomic(value, _at(builder, flags, index), "release", 8)


@instruction
def take(builder, marks, index, mark):
    """Mark a part if it is open (compare and swap); return whether it was open."""
    before = ir.Constant(LONG, OPEN)
    return builder.extract_value(
        builder.cmpxchg(_at(builder, marks, index), before, mark, "acq_rel", "acquire"), 1
    )


@instruction
def yield_core(builder):
    """Let another thread have the core if it wants it."""
    kind = ir.FunctionType(ir.IntType(32), [])
    builder.call(builder.module.globals.get("sched_yield") or ir.Function(builder.module, kind, "sched_yield"), [])


@instruction
def work_on(builder, run, words, first, last):
    """Call the machine code at an address with its words, of which the first two say where it begins and ends."""
    words = _at(builder, words, ir.Constant(LONG, 0))
    builder.store(first, words)
    builder.store(last, builder.gep(words, [ir.Constant(LONG, 1)], source_etype=LONG))
    kind = ir.FunctionType(LONG, [LONG.as_pointer()])
    builder.call(builder.inttoptr(run, kind.as_pointer()), [words])


def share(thread, count, run, rows, row_bytes, flags, marks, helpers, call, rounds):
    """A thread's share of a call; a helper then waits for the next call for some rounds.

    run is the address of machine code, rows that of its words for each part, flags and marks those of integers.
    """
    if thread == CALLER:
        post(flags, CALL, call)
    # The caller does its part, then each that no helper has taken; a helper does its part if it is open.
    for p in range(thread, (helpers if thread == CALLER else thread) + 1):
        if take(marks, LINE * p, TAKEN):
            if count > 0:
                parts = helpers + 1
                work_on(run, rows + row_bytes * p, p * count // parts, (p + 1) * count // parts)
            post(marks, LINE * p, DONE)
        elif thread == CALLER:
            spins = 0
            while read(marks, LINE * p) != DONE:
                spins += 1
                if spins % SPINS == 0:
                    yield_core()
    if thread != CALLER:
        spins = 0
        while spins < SPINS * rounds and read(flags, CALL) <= call:
            spins += 1
            if spins % SPINS == 0:
                yield_core()


@cache
def _runner_of_share() -> Callable[[int], int]:
    code = machine_code_of(share, [None] * 10)
    assert code is not None
    return runner_of(code)


@cache
def worker_threads() -> WorkerThreads:
    """The worker threads of this process, one for each core but one."""
    return WorkerThreads(cores() - 1 if hasattr(os, "sched_yield") else 0)


if hasattr(os, "register_at_fork"):  # a forked child has none of the threads
    os.register_at_fork(after_in_child=worker_threads.cache_clear)


class WorkerThreads:
    """Threads that share the work of a call with the thread that makes it.

    The state of a call, its parts and who has taken them, belongs to the call and not to the workers. The calling
    thread does every part that no worker has begun, so that it never waits for a worker that is late or busy with
    another call. An exception at any moment, such as Ctrl-C, leaves the workers unchanged.
    """

    _run: Callable[[int], int]

    def __init__(self, helpers: int):
        """Start `helpers` threads."""
        if helpers:
            self._run = _runner_of_share()
        self._flags = array("q", OPEN_MARK)
        self._calls = itertools.count(1)
        self._jobs: list[SimpleQueue] = [SimpleQueue() for _ in range(helpers)]
        for thread, jobs in enumerate(self._jobs, 1):
            name, arguments = f"numerics-worker-{thread}", (thread, jobs)
            threading.Thread(target=self._help, args=arguments, name=name, daemon=True).start()

    def run(self, code: Code, count: int, words: array) -> None:
        """Cover 0 ... count with calls of machine code, whose first two words say where each begins and ends."""
        if not self._jobs:
            runner_of(code)(words.buffer_info()[0])
            return
        helpers, call = len(self._jobs), next(self._calls)
        rounds = SPIN_ROUNDS if wait_policy() == ACTIVE else 0
        rows, marks = words * (helpers + 1), OPEN_MARK * (helpers + 1)
        (rows_at, _), (flags_at, _), (marks_at, _) = (a.buffer_info() for a in (rows, self._flags, marks))
        work = code.addresses["run"], rows_at, 8 * len(words), flags_at, marks_at
        of_share = array("q", (CALLER, count, *work, helpers, call, rounds))
        try:
            for jobs in self._jobs:
                if jobs.qsize() < BEHIND:
                    jobs.put((of_share, marks))  # a helper that comes late needs no more
            self._run(of_share.buffer_info()[0])
        except BaseException:  # no helper may be at work when the caller goes on
            of_share[1] = 0
            self._run(of_share.buffer_info()[0])
            raise

    def _help(self, thread: int, jobs: SimpleQueue) -> None:
        while True:
            of_share, marks = jobs.get()
            words = array("q", (thread, *of_share[1:]))
            self._run(words.buffer_info()[0])
            del of_share, marks
