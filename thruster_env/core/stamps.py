"""Time stamps: when two of them are one, and the steps of a model from one to the next.

Stamps are rounded: float64 leaves 2.4e-7 s of seconds since 1970, and a recorder that writes milliseconds leaves
1 ms. A step that is longer than the sample time by no more than that is one step.
"""

from __future__ import annotations

import math

CLOSE = 1e-9  # of a sample time: two stamps that are no further apart are one
ROUNDING = 1e-6  # of a sample time: so much longer it is still one step
MOST_STEPS = 1_000_000  # from one stamp to the next; some seconds of an extended filter


def resolution_of(latest: float, resolution: float = 0.0) -> float:
    """The largest difference [s] that rounding makes between stamps up to the latest one.

    Args:
        latest: the stamp of the largest size [s].
        resolution: that of the recorder [s]; float64's counts where it is coarser.
    """
    return max(resolution, 2.0 * math.ulp(latest))


def closeness(dt: float, resolution: float) -> float:
    """How far two stamps may be apart to be one [s], for a sample time dt [s] and their resolution [s]."""
    return max(CLOSE * dt, resolution)


def count_steps(length: float, dt: float, resolution: float) -> int:
    """How many equal steps of at most dt [s] a time [s] is divided into, for stamps of some resolution [s].

    Both the time and dt, which is often read off stamps, are rounded.

    Raises ValueError for more than MOST_STEPS, as after a clock was set.
    """
    count = length / dt - max(ROUNDING, 2.0 * resolution / dt)
    if not count <= MOST_STEPS:
        rule = f"two successive stamps must be at most {MOST_STEPS} steps of {dt:g} s apart"
        raise ValueError(f"{rule}, but are {length:.9g} s: after a gap or a clock that was set start anew")
    return max(1, math.ceil(count))
