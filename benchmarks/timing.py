"""Timing two programs in turns, so that both meet the same load of the machine."""

from __future__ import annotations

import gc
from collections.abc import Callable, Iterable
from contextlib import contextmanager
from statistics import median
from time import perf_counter
from typing import NamedTuple

Measure = Callable[[], float]
"""Does one round of work and returns the seconds that a unit of it (a step, say) took."""


class Timing(NamedTuple):
    """Seconds a unit of work, ours and the peer's."""

    ours: float  # [s], best of all rounds
    peer: float | None  # [s], best of all rounds
    ratio: float | None  # ours over the peer's: median over the rounds, which slow spells cannot bend


@contextmanager
def _no_collection():
    """Suspend the garbage collector, which would charge one program for the garbage of the other."""
    was_on = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def side_by_side(ours: Measure, peer: Measure, rounds: int, *, warm_up: bool = True) -> Timing:
    """Measure both once a round, in an order that alternates, after a first round that does not count."""
    if warm_up:
        ours(), peer()
    pairs = []
    with _no_collection():
        for number in range(rounds):
            if number % 2:
                second = peer()
                pairs.append((ours(), second))
            else:
                pairs.append((ours(), peer()))
    return Timing(*(min(times) for times in zip(*pairs, strict=True)), median(a / b for a, b in pairs))


def alone(ours: Measure, rounds: int, *, warm_up: bool = True) -> Timing:
    """Measure something that has no peer, after a first round that does not count."""
    if warm_up:
        ours()
    with _no_collection():
        return Timing(min(ours() for _ in range(rounds)), None, None)


def seconds_a_call(function: Callable, arguments: Iterable[tuple], prepare: Callable = lambda: None) -> Measure:
    """A measure that prepares, untimed, then calls function(*a) for every a of `arguments`."""
    arguments = list(arguments)

    def measure() -> float:
        prepare()
        begin = perf_counter()
        for a in arguments:
            function(*a)
        return (perf_counter() - begin) / len(arguments)

    return measure
