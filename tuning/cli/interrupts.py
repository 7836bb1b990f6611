"""Ctrl-C: the end of a process, and contexts that it does not cut."""

from __future__ import annotations

import os
import sys
from _signal import SIGINT, getsignal, signal  # `signal` itself takes milliseconds: Ctrl-C may come

INTERRUPTED = 130


def leave(*_) -> None:
    """End the process now, as an interrupted one, with the cursor that a progress bar may have hidden."""
    try:
        if "multiprocessing.process" in sys.modules:
            for child in sys.modules["multiprocessing.process"].active_children():
                child.kill()
        os.write(2, b"\x1b[?25h\n" * os.isatty(2) + b"thruster: interrupted\n")
    finally:
        os._exit(INTERRUPTED)


class PrintedWhole:
    """A context in which the first Ctrl-C waits for its end; the next one ends the process, as on a blocked pipe.

    Outside the main thread, where Python delivers no signals, it has no effect.
    """

    def __enter__(self) -> None:
        from threading import current_thread, main_thread

        self._caught: list[int] = []
        self._is_main = current_thread() is main_thread()
        if self._is_main:
            self._before = getsignal(SIGINT)
            signal(SIGINT, self._note)

    def __exit__(self, *_) -> None:
        from signal import raise_signal

        if self._is_main:
            signal(SIGINT, self._before)
        if self._caught:
            raise_signal(SIGINT)

    def _note(self, number, frame) -> None:
        self._caught.append(number)
        signal(SIGINT, leave)
