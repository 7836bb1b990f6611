"""Ctrl-C during long work: the first one asks for an end, the second one forces it."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from thruster_env.core.progress import tell

STOPPING = "stopping after the running task; Ctrl-C again stops at once"


@contextmanager
def stop_on_interrupt() -> Iterator[Callable[[], bool]]:
    """Within this context the first Ctrl-C makes the yielded function return True, with a message to listeners.

    An exception within compiled code or a storage's lock could get lost or leave the lock behind. Outside the main
    thread, where Python delivers no signals, this has no effect.
    """
    caught: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield lambda: False
        return
    before = signal.getsignal(signal.SIGINT)

    def note(number, frame):
        caught.append(number)
        signal.signal(signal.SIGINT, before)
        tell(STOPPING)

    signal.signal(signal.SIGINT, note)
    try:
        yield lambda: bool(caught)
    finally:
        signal.signal(signal.SIGINT, before)


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
