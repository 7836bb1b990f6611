"""Constants of a graph in single precision."""

from __future__ import annotations

import math

import numpy as np

SMALLEST = float(np.finfo(np.float32).tiny)  # normal


def as_single(value: float) -> float:
    """The nearest float32; of a number that is too small for one the smallest, which keeps a divisor from zero."""
    if 0.0 < abs(value) < SMALLEST:
        return math.copysign(SMALLEST, value)
    with np.errstate(over="ignore"):
        return float(np.float32(value))
