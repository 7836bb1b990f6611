"""Whether two recorded runs have rows in common, so that one cannot be held out of training on the other."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from thruster_env.logs.log import Log

WINDOW = 20  # rows in a row that are the same; of shorter logs half of them
FEWEST = 4
FACTOR = np.uint64(0x9E3779B97F4A7C15)  # odd, of the hash of a window


def shared_by(some: Sequence[Log], others: Sequence[Log]) -> tuple[Log, Log] | None:
    """The first pair of logs, one of each kind, with the same rows in a row; None where there is none.

    Rows with measurements are compared by inputs and measurements, independent of their times and the logs' names.
    Rows in which no measurement changes, as at rest, are ignored, except in identical logs.
    """
    logs = [*some, *others]
    whole = {log.digest: log for log in some}
    for log in others:
        if log.digest in whole:
            return whole[log.digest], log
    rows = [_measured_rows(log) for log in logs]
    width = max(FEWEST, min(WINDOW, *(len(one) // 2 for one in rows)))
    flat = np.ascontiguousarray(np.concatenate(rows)).view(f"V{8 * rows[0].shape[1]}")[:, 0]
    numbers = np.unique(flat, return_inverse=True)[1].astype(np.uint64)
    pieces = np.split(numbers, np.cumsum([len(one) for one in rows])[:-1])
    inputs = some[0].inputs.shape[1]
    hashes = [_hashes(piece, one[:, inputs:], width) for piece, one in zip(pieces, rows, strict=True)]
    seen: dict[int, Log] = {}
    for log, found in zip(some, hashes, strict=False):
        seen.update(dict.fromkeys(found.tolist(), log))
    for log, found in zip(others, hashes[len(some) :], strict=True):
        common = next((one for one in found.tolist() if one in seen), None)
        if common is not None:
            return seen[common], log
    return None


def _measured_rows(log: Log) -> np.ndarray:
    """Inputs and measurements of the rows in which something is measured."""
    there = ~np.isnan(log.measurements[:-1]).all(axis=1)
    return np.column_stack((log.inputs, log.measurements[:-1]))[there] + 0.0


def _hashes(numbers: np.ndarray, measured: np.ndarray, width: int) -> np.ndarray:
    """A hash of each stretch of `width` rows in which measurements change at least every other row."""
    count = len(numbers) - width + 1
    if count < 1:
        return np.empty(0, np.uint64)
    total: np.ndarray = np.zeros(count, np.uint64)
    for place in range(width):
        total = total * FACTOR + (numbers[place : place + count] + np.uint64(1))
    changes = np.append(0, np.cumsum((np.diff(measured, axis=0) != 0).any(axis=1)))
    return np.unique(total[changes[width - 1 :] - changes[:count] >= width // 2])
