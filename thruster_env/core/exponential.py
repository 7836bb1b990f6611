"""e^x of logarithms of weights, without branches and calls, so that loops over it become vector code."""

from __future__ import annotations

import math

import numpy as np

from thruster_env.core.compiled import inlined

LOWEST = -46.0  # e^-46 = 1e-20 is nothing beside 1, and still tells how far the others are off
LN_2, PER_LN_2 = math.log(2.0), 1.0 / math.log(2.0)
ROUNDER = 1.5 * 2.0**52  # adding it leaves a whole number in the last bits
ROUNDER_BITS = int(np.float64(ROUNDER).view(np.int64))


@inlined
def parts(x):
    """The factor e^r and the power k of e^x = e^r 2^k, |r| <= log(2)/2, by its series, to 1e-16."""
    k = np.floor(x * PER_LN_2 + 0.5)
    r = x - k * LN_2
    series = 1.0 / 6227020800.0
    series = series * r + 1.0 / 479001600.0
    series = series * r + 1.0 / 39916800.0
    series = series * r + 1.0 / 3628800.0
    series = series * r + 1.0 / 362880.0
    series = series * r + 1.0 / 40320.0
    series = series * r + 1.0 / 5040.0
    series = series * r + 1.0 / 720.0
    series = series * r + 1.0 / 120.0
    series = series * r + 1.0 / 24.0
    series = series * r + 1.0 / 6.0
    series = series * r + 0.5
    series = series * r + 1.0
    series = series * r + 1.0
    return series, k


@inlined
def exponential(x):
    """e^x for x <= 700, as e^-46 below -46 and for NaN."""
    series, k = parts(x if x > LOWEST else LOWEST)
    bits = np.float64(k + ROUNDER).view(np.int64) - ROUNDER_BITS  # k itself, which becomes the exponent
    return series * np.int64((bits + 1023) << 52).view(np.float64)
