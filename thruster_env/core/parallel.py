"""Work on all cores and elsewhere: calls in parts by threads, how threads wait, and tasks on any executor.

A thread that has gone to sleep wakes up tens of microseconds after it is called. So worker threads
(`graphs.workers`) wait for the next call spinning, unless the wait policy is "passive". The words are those of
OpenMP's OMP_WAIT_POLICY. The environment variable THRUSTER_WAIT_POLICY sets the policy of a process and of those
that it starts, `waiting` that of a part of a program.

A task of `concurrent.futures.Executor`, in other processes or on other hosts, is a function that has a name and
arguments that can be pickled, so that every executor carries it, and gives the same result wherever it runs. If
workers die, the tasks that they had are run again.
"""

from __future__ import annotations

import itertools
import multiprocessing
import os
import pickle
import signal
import threading
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    Executor,
    Future,
    ProcessPoolExecutor,
    ThreadPoolExecutor,
    wait,
)
from contextlib import contextmanager
from functools import cache
from typing import Any

import numpy as np

from thruster_env.core.checks import at_least, one_of, short_repr
from thruster_env.core.modules import safe_paths, to_install, working_folder_last

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


MOST_PROCESSES = 1000
MOST_LOSSES = 3  # of workers, one after the other, without a finished task
FORMS = "processes:N, mpi or dask:ADDRESS"
Where = Executor | str | None  # of tasks: an executor, one of `FORMS`, or None for this process


class TaskMap:
    """Runs tasks on an executor, made by `task_map`."""

    def __init__(self, where: Where) -> None:
        """Take an executor, or one of `FORMS`, which is opened by the first tasks."""
        self._open = opener_of(where) if isinstance(where, str) else None
        self._executor = None if isinstance(where, str) else where

    @property
    def is_remote(self) -> bool:
        """Whether tasks run elsewhere than in this thread."""
        return self._open is not None or self._executor is not None

    def __call__(
        self, function: Callable[..., Any], tasks: Iterable[tuple], stop: Callable[[], bool] = lambda: False
    ) -> Iterator[tuple[int, Any]]:
        """Yield (index, function(*task)) of each task, as soon as it is finished; in order in this process.

        If the caller stops to iterate, for instance after Ctrl-C, tasks that have not begun are cancelled.

        Args:
            function: a function of a module, or a `functools.partial` of one.
            tasks: the arguments of each call.
            stop: once it returns True no further task begins, and those that have begun are the last ones.

        Raises:
            ValueError: if a task cannot be pickled, or workers die again and again.
        """
        left, losses = dict(enumerate(tasks)), 0
        while left and self.is_remote and not stop():
            try:
                for index, result in self._finished(function, left, stop):
                    del left[index]
                    losses = 0
                    yield index, result
            except BrokenExecutor as error:
                losses += 1
                self.close()
                if losses == MOST_LOSSES:
                    rule = "workers must live until their tasks are done, but died"
                    raise ValueError(f"{rule} {losses} times without finishing one: {error}") from None
                again = "again" if self._open else "in this process"
                warnings.warn(f"a worker has died: {len(left)} tasks are run {again}", stacklevel=3)
        while left and not stop():
            index = next(iter(left))
            yield index, function(*left.pop(index))

    def _finished(
        self, function: Callable[..., Any], tasks: dict[int, tuple], stop: Callable[[], bool]
    ) -> Iterator[tuple[int, Any]]:
        if self._executor is None:
            assert self._open is not None  # or nothing would be remote
            self._executor = self._open()
        # A pool of processes takes more tasks than it has processes, and does not give them back.
        most = self._executor.count if isinstance(self._executor, Processes) else MOST_PROCESSES
        closes = isinstance(self._executor, Processes)
        waiting, begun = list(tasks)[::-1], dict[Future, int]()
        try:
            while (waiting and not stop()) or begun:
                while waiting and len(begun) < most and not stop():
                    content = packed_task(function, tasks[waiting[-1]])
                    with without_interrupts(), safe_paths():
                        begun[self._executor.submit(run_packed, content)] = waiting.pop()
                if stop() and not closes:
                    begun = {future: index for future, index in begun.items() if not future.cancel()}
                for future in wait(begun, return_when=FIRST_COMPLETED).done:
                    yield begun.pop(future), future.result()
        finally:
            if not closes:  # processes are ended in `close`
                for future in begun:
                    future.cancel()

    def close(self) -> None:
        """End an executor that was opened here, at once: nobody waits for a task that is left."""
        executor, self._executor = self._executor, None
        if executor is None or self._open is None:
            return
        processes = executor._processes if isinstance(executor, Processes) else {}
        for process in list((processes or {}).values()):
            process.terminate()
        executor.shutdown(wait=bool(processes))


@contextmanager
def task_map(where: Where = None) -> Iterator[TaskMap]:
    """Within this context run tasks on an executor.

        with task_map("processes:4") as tasks:
            for index, result in tasks(function, [(1.0,), (2.0,)]): ...

    Args:
        where: an executor, which stays open; "processes:N", N processes of this host; "processes", one for each
            core; "mpi", the processes of `mpirun -n N python -m mpi4py.futures`; "dask:ADDRESS", the workers of a
            Dask scheduler; None for this process.

    Raises:
        ValueError: for anything else, or if the package of an executor is not installed.
    """
    if not (where is None or isinstance(where, str | Executor)):
        raise ValueError(
            f"executor must be {FORMS}, or a concurrent.futures.Executor, but got {short_repr(where)}"
        )
    tasks = TaskMap(where)
    try:
        yield tasks
    finally:
        tasks.close()


IN_PROCESS = TaskMap(None)


def packed_task(function: Callable[..., Any], task: tuple) -> bytes:
    """A function and its arguments as bytes; ValueError if these hold something without a name."""
    try:
        return pickle.dumps((function, task))
    except Exception as error:  # a function within a function, or what a class of the user's raises
        rule = "models and problems must be made of named functions for an executor"
        raise ValueError(f"{rule}, but cannot be pickled: {error}") from None


def run_packed(content: bytes) -> Any:
    """The result of a packed task; the user's modules may lie in the working folder."""
    with working_folder_last():
        function, task = pickle.loads(content)
        return function(*task)


# Executors by name.


def opener_of(name: str) -> Callable[[], Executor]:
    """What opens the executor of this name; ValueError if it is none of `FORMS`."""
    kind, _, rest = name.partition(":")
    if kind == "processes":
        rule = "executor (--executor) processes"
        count = cores() if name == kind else at_least(rule, rest, 1, MOST_PROCESSES)
        return lambda: Processes(count)
    if name == "mpi":
        return _mpi
    if kind == "dask" and rest:
        return lambda: _dask(rest)
    raise ValueError(f"executor (--executor) must be {FORMS}, but got {name!r}")


def _mpi() -> Executor:
    try:
        from mpi4py.futures import MPIPoolExecutor
    except ImportError as error:
        raise ValueError(f"mpi must have mpi4py and an MPI, but {error}: {to_install('cluster')}") from None
    return MPIPoolExecutor()


def _dask(address: str) -> Executor:
    try:
        from distributed import Client
    except ImportError:
        raise ValueError(f"dask must have distributed, which is not installed: {to_install('cluster')}") from None
    try:
        client = Client(address, set_as_default=False)
    except (OSError, ValueError) as error:
        raise ValueError(f"dask must have a scheduler that answers, but {address} does not: {error}") from None
    return client.get_executor()


# Processes of this host.


class Processes(ProcessPoolExecutor):
    """A pool of `count` processes that share the cores."""

    def __init__(self, count: int) -> None:
        """Start none: the first tasks do."""
        super().__init__(count, multiprocessing.get_context("spawn"), prepare_process, (count,))
        self.count = count


def prepare_process(count: int) -> None:
    """Prepare one of `count` processes: it leaves Ctrl-C to its parent, and ends when that has ended."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    take_share(count)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


def take_share(workers: int) -> None:
    """Let this process use the number of threads that is its share of the cores; it may run on any core."""
    if hasattr(os, "sched_setaffinity"):
        allowed = os.sched_getaffinity(0)
        os.sched_setaffinity(0, sorted(allowed)[: max(1, len(allowed) // workers)])
        cores()  # is cached
        os.sched_setaffinity(0, allowed)


@contextmanager
def without_interrupts() -> Iterator[None]:
    """Within this context Ctrl-C waits, and new processes ignore it: their parent ends them.

    Otherwise they would receive it while they load packages, and each would print a traceback.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)
