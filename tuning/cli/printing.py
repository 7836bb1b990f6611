"""Ctrl-C while results are printed: they become whole first."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from signal import SIGINT, getsignal, raise_signal, signal
from threading import current_thread, main_thread

from tuning.cli.main import leave


@contextmanager
def printed_whole() -> Iterator[None]:
    """Within this context the first Ctrl-C waits for its end; the next one ends the process, as on a blocked pipe.

    Outside the main thread, where Python delivers no signals, this has no effect.
    """
    if current_thread() is not main_thread():
        yield
        return
    caught: list[int] = []

    def note(number, frame):
        caught.append(number)
        signal(SIGINT, leave)

    before = getsignal(SIGINT)
    signal(SIGINT, note)
    try:
        yield
    finally:
        signal(SIGINT, before)
        if caught:
            raise_signal(SIGINT)
