"""What the memory of every plant's copies, and the row of numbers beside it, have in common.

A memory is an array (blocks, rows, width). Its first rows hold what random draws depend on, and what every plant
reports of a step; the plant's own follow. A measured channel has a row, and so many rows behind it (the plant's
`Context.valid_offset`, the same for all its channels) one that says whether the measurement is valid.
"""

from __future__ import annotations

KEY_0, KEY_1, STEP, REWARD, TERMINATED, TIME = FRONT = range(6)
FIRST_REPORTED = REWARD
# An effect: its length in numbers, kind, row that it acts on, first row of its own, number, then its parameters.
EFFECT_KIND, EFFECT_TARGET, EFFECT_ROWS, EFFECT_NUMBER, EFFECT_PARAMETERS = range(1, 6)
