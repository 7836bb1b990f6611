"""What the page draws next, in one message: as several, they would be drawn in as many frames of the screen."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Any

import numpy as np

Column = np.ndarray | Sequence[np.ndarray]


class Sent:
    """Columns of numbers and ends of axes that wait to be sent.

    The script of the page puts them into the models of the same names (`draw` in page.js). Those of the server
    keep what they began with.
    """

    def __init__(self) -> None:
        """Nothing waits."""
        self._columns: dict[str, dict[str, Column]] = {}
        self._axes: dict[str, dict[str, tuple[float, float]]] = {}

    def columns(self, source: str, columns: dict[str, Column]) -> None:
        """All columns of a source: numbers, or several lines of numbers."""
        self._columns[source] = columns

    def axis(self, figure: str, axis: str, start: float, end: float) -> None:
        """The ends of a figure's axis, "x" or "y"."""
        self._axes.setdefault(figure, {})[axis] = start, end

    def take(self) -> dict[str, Any]:
        """All that waits: float32 numbers in base 64, and which parts of them are whose; empty if nothing does."""
        numbers: list[np.ndarray] = []
        size = 0

        def part(column: Column) -> list:
            nonlocal size
            if not isinstance(column, np.ndarray):
                return [part(line) for line in column]
            numbers.append(as_sent(column))
            size += column.size
            return [size - column.size, size]

        parts = {
            source: {name: part(column) for name, column in columns.items()}
            for source, columns in self._columns.items()
        }
        axes, self._columns, self._axes = self._axes, {}, {}
        if not (parts or axes):
            return {}
        sent = b"".join(array.tobytes() for array in numbers)
        return {"numbers": base64.b64encode(sent).decode(), "columns": parts, "axes": axes}


def as_sent(values: np.ndarray) -> np.ndarray:
    """Numbers in the half as many bytes that a screen needs; without infinite ones, which no axis has."""
    with np.errstate(over="ignore"):
        short = np.asarray(values, dtype=np.float32)
    return np.where(np.isfinite(short), short, np.float32(np.nan)).astype("<f4", copy=False)
