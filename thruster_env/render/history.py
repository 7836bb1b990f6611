"""The last time steps of an episode, with the estimates of a filter."""

from __future__ import annotations

import math

import numpy as np

STEPS = 500  # that are remembered
ABSURD = 1e12  # states and estimates can diverge; beyond this a number is not drawn


class History:
    """The last moments of an episode, in columns: truth by its own name, beliefs as estimated_NAME.

    A moment is a tuple of numbers, or None where there is none; an overlay is a label and what a filter believes.
    """

    def __init__(self, moment: tuple[str, ...], overlay: tuple[str, ...]):
        """Take the names of a moment's entries, and of an overlay's behind the label."""
        self._names = (*moment, *(f"estimated_{name}" for name in overlay))
        self._of_moment = len(moment)
        self._rows = np.empty((STEPS, len(self._names)))
        self.clear()

    def clear(self) -> None:
        """Forget all of it."""
        self.count = 0  # moments added
        self.label = ""  # name of the filter

    def add(self, moment: tuple) -> None:
        """Note a moment."""
        row = self._rows[self.count % STEPS]
        row[: self._of_moment] = moment  # None becomes NaN
        row[self._of_moment :] = math.nan
        self.count += 1

    def amend(self, overlay: tuple) -> None:
        """Note what a filter believes of the moment added last."""
        self.label = overlay[0]
        self._rows[(self.count - 1) % STEPS, self._of_moment :] = overlay[1:]

    def columns(self) -> dict[str, np.ndarray]:
        """An array (n,) for each name, oldest first, NaN where there is no value that can be drawn."""
        full = self.count > STEPS
        rows = np.roll(self._rows, -self.count, axis=0) if full else self._rows[: self.count]
        return dict(zip(self._names, np.where(np.abs(rows) < ABSURD, rows, math.nan).T, strict=True))


def newest(columns: dict[str, np.ndarray], name: str) -> float:
    """The newest value of a column; that of the step before if a filter has not got to the last step yet."""
    last = columns[name][-2:]
    known = last[np.isfinite(last)]
    return float(known[-1]) if len(known) else math.nan
