"""What the memory of every plant's copies has in common, so that an effect needs to know no plant.

A memory is an array (blocks, rows, width). Its first rows hold what random draws depend on; the plant's own
follow. A measured channel has a row, and MAX_CHANNELS rows behind it one that says whether the measurement is
valid.
"""

from __future__ import annotations

KEY_0, KEY_1, STEP = FRONT = range(3)
MAX_CHANNELS = 4
