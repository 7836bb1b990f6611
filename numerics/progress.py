"""How far long work is: who does it tells, and whoever shows progress listens."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from typing import TypeVar

Part = TypeVar("Part")

_listener: ContextVar[Callable[[str], None] | None] = ContextVar("listener to progress", default=None)
_around: ContextVar[str] = ContextVar("progress of the work that this is a part of", default="")


@contextmanager
def listening(listener: Callable[[str], None]) -> Iterator[None]:
    """Within this context call listener("posterior bound: 40 of 200") as work goes on in this thread."""
    before = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(before)


def tell(text: str) -> None:
    """Tell what goes on, if anybody listens."""
    listener = _listener.get()
    if listener is not None:
        listener(text)


def told(what: str, parts: Sequence[Part], sizes: Sequence[int] | None = None) -> Iterator[Part]:
    """The parts of some work one after the other; before each it is told how much is done.

    What is told while a part is worked on stands behind it: "N = 40: 3 of 12, runs: 20 of 100".

    Args:
        what: is being worked out.
        parts: to go through; a single one is not worth telling.
        sizes: what each part counts for, 1 if None.
    """
    if _listener.get() is None or len(parts) < 2:
        yield from parts
        return
    sizes = [1] * len(parts) if sizes is None else sizes
    around, done = _around.get(), 0
    try:
        for part, size in zip(parts, sizes, strict=True):
            text = f"{around}{what}: {done} of {sum(sizes)}"
            _around.set(f"{text}, ")
            if (listener := _listener.get()) is not None:  # whoever listened may have stopped meanwhile
                listener(text)
            yield part
            done += size
    finally:
        _around.set(around)
