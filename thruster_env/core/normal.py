"""The normal distribution, for compiled code."""

from __future__ import annotations

import math

from thruster_env.core.compiled import inlined

HALVINGS = 60  # of an interval of 80 standard deviations, to rounding


@inlined
def below(z):
    """The normal distribution at z."""
    return 0.5 * math.erfc(-z / 2.0**0.5)


@inlined
def quantile(share):
    """The z below which there is a share in (0, 1) of the normal distribution."""
    low, high = -40.0, 40.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        if below(middle) < share:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)
