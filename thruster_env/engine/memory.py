"""Where things lie: the memory of many thrusters, and the row of numbers that compiled code reads.

The memory of N copies is one float64 array (blocks, rows, width), block by block, so that a block's rows fit
the fastest cache and every loop over copies is vector code. A single env is one block of width one.
"""

from __future__ import annotations

import numpy as np

from plants.disturbances.layout import FRONT, MAX_CHANNELS
from thruster_env.dynamics import Constants

WIDTH = 128  # copies in a block: 23 rows of them are 23 KiB

# Behind the rows that all plants have in front, those that every step reports, ...
OMEGA, FLOW, THRUST, AMBIENT, REFERENCE, REWARD, TERMINATED, TIME, NEXT_REFERENCE = range(
    len(FRONT), len(FRONT) + 9
)
FIRST_REPORTED = OMEGA
READINGS = NEXT_REFERENCE + 1  # a row for each channel, ...
VALID = READINGS + MAX_CHANNELS  # ... and whether it is valid
REPORTED = VALID + MAX_CHANNELS  # where they end
# ... and those that it keeps to itself. Rows of disturbances, then of drawn constants, follow.
COMMAND, LAST_COMMAND, VOLTAGE = range(REPORTED, REPORTED + 3)
FIXED_ROWS = REPORTED + 3

CONSTANT_COUNT = len(Constants._fields)

# Places in the row of numbers; the constants of the equations of motion come first.
SUBSTEPS, TOP_VOLTAGE, SAMPLE_TIME, CONSTANT_ROWS, LINEAR = range(CONSTANT_COUNT, CONSTANT_COUNT + 5)
Q_ROOT = LINEAR + 1  # lower triangle of 2 x 2, by rows
PRIOR_MEAN, PRIOR_ROOT = Q_ROOT + 3, Q_ROOT + 5
CHANNEL_COUNT = PRIOR_ROOT + 3
CHANNEL_CODES = CHANNEL_COUNT + 1
R_ROOT = CHANNEL_CODES + MAX_CHANNELS  # 4 x 4 by rows
LINEAR_MODEL = R_ROOT + MAX_CHANNELS * MAX_CHANNELS  # A_d (2, 2), B_d (2, 2), C (2,) by rows
REWARD_WEIGHTS = LINEAR_MODEL + 10  # tracking, energy, voltage rate
THRUST_SCALE = REWARD_WEIGHTS + 3
LIMITS = THRUST_SCALE + 1  # of |omega_m| and |U_a|
SECTIONS = LIMITS + 2  # number of effects on amplifier, flow, sensors and reference
FIRST_EFFECT = SECTIONS + 4
# An effect: its length in numbers, kind, row that it acts on, first row of its own, number, then its parameters.
EFFECT_KIND, EFFECT_TARGET, EFFECT_ROWS, EFFECT_NUMBER, EFFECT_PARAMETERS = range(1, 6)


def new_memory(copies: int, extra_rows: int, width: int | None = None) -> np.ndarray:
    """Memory (blocks, rows, width) of zeros for a number of copies; the last block may have some to spare."""
    width = min(copies, WIDTH) if width is None else width
    return np.zeros((-(-copies // width), FIXED_ROWS + extra_rows, width))


def row(memory: np.ndarray, index: int, copies: int) -> np.ndarray:
    """A copy of one row for all copies, (copies,)."""
    return memory[:, index].reshape(-1)[:copies]


def set_row(memory: np.ndarray, index: int, values: np.ndarray) -> None:
    """Write one value a copy, (copies,), into a row."""
    blocks, _, width = memory.shape
    full = len(values) // width
    memory[:full, index] = values[: full * width].reshape(full, width)
    if full < blocks:
        memory[full, index, : len(values) - full * width] = values[full * width :]


def gathered(memory: np.ndarray, which: np.ndarray) -> np.ndarray:
    """Memory of some copies, named by their numbers (count,), in blocks of their own."""
    part = np.zeros((-(-len(which) // min(len(which), WIDTH)), memory.shape[1], min(len(which), WIDTH)))
    block, column = np.divmod(which, memory.shape[2])
    own_block, own_column = np.divmod(np.arange(len(which)), part.shape[2])
    part[own_block, :, own_column] = memory[block, :, column]
    return part


def scatter(part: np.ndarray, memory: np.ndarray, which: np.ndarray) -> None:
    """Put the memory of some copies, as `gathered` made it, back into the memory of all."""
    block, column = np.divmod(which, memory.shape[2])
    own_block, own_column = np.divmod(np.arange(len(which)), part.shape[2])
    memory[block, :, column] = part[own_block, :, own_column]
