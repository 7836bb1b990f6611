"""Progress of long computations, reported to a listener."""

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
    """Within this context call listener("posterior bound: 40 of 200") as this thread's work proceeds."""
    before = _listener.set(listener)
    try:
        yield
    finally:
        _listener.reset(before)


def tell(text: str) -> None:
    """Report progress to the listener, if there is one."""
    listener = _listener.get()
    if listener is not None:
        listener(text)


def with_progress(what: str, parts: Sequence[Part], sizes: Sequence[int] | None = None) -> Iterator[Part]:
    """Iterate over the parts of a computation and report progress before each.

    Progress inside a part is appended to that of the part: "N = 40: 3 of 12, runs: 20 of 100".

    Args:
        what: name of what is computed.
        parts: what to go through; a single part is not reported.
        sizes: weight of each part in the count; 1 if None.
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
