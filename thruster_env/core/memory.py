"""The memory of many copies of a plant: one float64 array (blocks, rows, width), block by block.

The rows of a block fit the fastest cache. A single env is one block of width one; blocks of more copies are whole
groups of copies that are advanced side by side. The first rows of every plant hold what random draws depend on and
what a step reports; the plant's own rows follow.
"""

from __future__ import annotations

import numpy as np

KEY_0, KEY_1, STEP, REWARD, TERMINATED, TIME = FRONT = range(6)
FIRST_REPORTED = REWARD
WIDTH = 128  # copies in a block: 23 rows of them are 23 KiB


def new_memory(copies: int, rows: int, lanes: int) -> np.ndarray:
    """Memory (blocks, rows, width) of zeros for a number of copies; the last block may have some to spare.

    The width is a multiple of `lanes`.
    """
    width = min(-(-copies // lanes) * lanes, WIDTH)
    return np.zeros((-(-copies // width), rows, width))


def set_row(memory: np.ndarray, index: int, values: np.ndarray) -> None:
    """Write one value per copy, (copies,), into a row."""
    blocks, _, width = memory.shape
    full = len(values) // width
    memory[:full, index] = values[: full * width].reshape(full, width)
    if full < blocks:
        memory[full, index, : len(values) - full * width] = values[full * width :]


def gathered(memory: np.ndarray, which: np.ndarray, lanes: int) -> np.ndarray:
    """Memory of some copies, given by their numbers (count,), in separate blocks of a multiple of `lanes`."""
    part = new_memory(len(which), memory.shape[1], lanes)
    block, column = np.divmod(which, memory.shape[2])
    own_block, own_column = np.divmod(np.arange(len(which)), part.shape[2])
    part[own_block, :, own_column] = memory[block, :, column]
    return part


def scatter(part: np.ndarray, memory: np.ndarray, which: np.ndarray) -> None:
    """Put the memory of some copies, as `gathered` made it, back into the memory of all."""
    block, column = np.divmod(which, memory.shape[2])
    own_block, own_column = np.divmod(np.arange(len(which)), part.shape[2])
    memory[block, :, column] = part[own_block, :, own_column]
