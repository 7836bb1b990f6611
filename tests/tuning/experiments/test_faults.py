"""Delays of alarms, in the quick form of the study."""

import math

import numpy as np
import pytest

from filters.monitoring import cusum_threshold
from tuning.experiments.faults import BIASES, LOST_BLADES, PLANTS, best_delay, delays


def test_larger_faults_of_the_thruster_are_found_sooner_and_none_without_one():
    found = delays(PLANTS[0], runs=12)
    steps = [found[f"bias of {size:g} sigma"].median for size in BIASES]
    assert steps == sorted(steps, reverse=True) and steps[-1] <= 3
    assert found["none"].found <= 1 / 12 and found["stuck"].found == 1.0 and found[LOST_BLADES].found == 1.0
    assert found["noise doubled"].first == "variance" and math.isfinite(found["stuck"].median)


def test_the_best_delay_is_that_of_simulated_cusums():
    rng, shift = np.random.default_rng(0), 1.5
    h, total = cusum_threshold(1000.0, 0.5 * shift, sides=1), 0
    for _ in range(4000):
        g, steps = 0.0, 0
        while g < h:
            g, steps = max(0.0, g + shift + rng.standard_normal() - 0.5 * shift), steps + 1
        total += steps
    assert best_delay(shift, 1000.0) == pytest.approx(total / 4000, rel=0.04)
