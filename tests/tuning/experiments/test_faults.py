"""Delays of alarms, in the quick form of the study."""

import numpy as np
import pytest

from filters.monitoring.monitor import cusum_threshold
from tuning.experiments.faults import best_delay


def test_the_best_delay_is_that_of_simulated_cusums():
    rng, shift = np.random.default_rng(0), 1.5
    h, total = cusum_threshold(1000.0, 0.5 * shift, sides=1), 0
    for _ in range(4000):
        g, steps = 0.0, 0
        while g < h:
            g, steps = max(0.0, g + shift + rng.standard_normal() - 0.5 * shift), steps + 1
        total += steps
    assert best_delay(shift, 1000.0) == pytest.approx(total / 4000, rel=0.04)
