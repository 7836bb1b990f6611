"""The scale of a vehicle's scenario: standard deviations by the Riccati equation along noise-free paths."""

from __future__ import annotations

import numpy as np

from thruster_env.core.checks import at_least
from tuning.auv.scenario import Scenario

SEQUENCES = 200  # input sequences for a stored scale


def computed_scale(scenario: Scenario, sequences: int = SEQUENCES) -> np.ndarray:
    """The scale (n,) of a scenario, its bound over the seeds 0, 1, 2, ...

    Raises:
        ValueError: if it is zero or not finite, as it is without any noise.
    """
    scale = scenario.bound(scenario.data(range(at_least("sequences", sequences, 1))))
    if not (np.isfinite(scale).all() and (scale > 0).all()):
        raise ValueError(f"scale must be positive in every state, but the bound is {scale.tolist()}")
    return scale
