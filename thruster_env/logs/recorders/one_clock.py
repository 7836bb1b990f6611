"""One clock for all topics of a log from a bag: stamps of headers, or the times at which messages were received.

Headers may have the time of a device or a simulation, and topics without stamps have none but that of reception:
of two such topics nobody knows which samples belong together. Stamps of headers are exact where all topics have
them; otherwise all topics have the times of reception.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

HEADER, RECEIPT = "header", "receipt"
STAMPS = (HEADER, RECEIPT)
APART = 60.0  # [s] between the clocks of two headers: less may be the delay of a message
FEWEST = 3  # messages of a topic whose clock is compared: one that is sent once may be old


class Clocked(NamedTuple):
    """The times of a topic's messages, in order of `times`."""

    clock: str  # HEADER or RECEIPT; empty for a format that has no such choice
    times: np.ndarray  # (samples,) [s]
    received: np.ndarray | None  # (samples,) [s]; None where the times are these

    @property
    def order(self) -> np.ndarray:
        """Indices of the messages in the order of reception."""
        return np.argsort(self.times if self.received is None else self.received, kind="stable")


class Choice(NamedTuple):
    """The clock of a log, and why it is not that of the headers; empty where no topic has stamps in headers."""

    clock: str
    why: str


def chosen_clock(topics: Mapping[str, Clocked], asked: str | None, path: Path) -> Choice:
    """The clock of some topics, by name.

    Args:
        topics: those of a log.
        asked: HEADER or RECEIPT; None for HEADER if all topics have stamps of one clock, else RECEIPT.
        path: of the file, for messages.

    Raises:
        ValueError: if the stamps of headers are asked for, and a topic has none.
    """
    without = [name for name, topic in topics.items() if topic.clock == RECEIPT]
    if asked == HEADER and without:
        rule = "stamps must be in the headers of all topics of a log"
        raise ValueError(f"{rule}, but {without[0]} of {path} has none (use --stamps receipt)")
    if asked is not None:
        return Choice(asked, "")
    if len(without) == len(topics):
        return Choice(RECEIPT if without else "", "")
    if without:
        return Choice(RECEIPT, f"{without[0]} has no stamps in headers")
    other = _of_another_clock(topics)
    return Choice(RECEIPT, f"the headers of {other} have another clock") if other else Choice(HEADER, "")


def _of_another_clock(topics: Mapping[str, Clocked]) -> str:
    """The first topic whose headers are not on the clock of those of the longest topic; empty if there is none.

    How far a clock is ahead of reception is compared at the same times of reception, because simulated time may
    run at another rate.
    """
    longest = max(topics.values(), key=lambda topic: len(topic.times))
    if longest.received is None or len(longest.times) < FEWEST:
        return ""
    received = longest.received[longest.order]
    ahead = longest.times[longest.order] - received
    for name, topic in topics.items():
        if topic.received is not None and len(topic.times) >= FEWEST:
            apart = topic.times - topic.received - np.interp(topic.received, received, ahead)
            if np.median(abs(apart)) > APART:
                return name
    return ""
