"""Moving-horizon estimation: the most probable states of the last steps, within bounds, at every step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from filters.engine.belief import Belief, Kernels
from filters.filter import Filter
from filters.horizon.passes import horizon_kernels
from filters.horizon.window import LOSSES, kept_places
from thruster_env.numerics.checks import at_least, one_of, positive

MOST_STEPS, MOST_ITERATIONS = 200, 50


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingHorizonFilter(Filter):
    """Moving-horizon estimation.

    Attributes:
        horizon: L, 1 to 200.

    Raises:
        ValueError: if a parameter is out of its range.
    """

    name: ClassVar[str] = "mhe"
    varying_noise: ClassVar[bool] = False
    horizon: int = 10
    iterations: int = 2
    loss: str = "huber"
    threshold: float = 2.0
    disturbance_limit: float = math.inf

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        object.__setattr__(self, "horizon", at_least("horizon", self.horizon, 1, MOST_STEPS))
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))
        one_of("loss", self.loss, LOSSES)
        object.__setattr__(self, "threshold", positive("threshold", self.threshold))
        if self.disturbance_limit != math.inf:
            object.__setattr__(self, "disturbance_limit", positive("disturbance_limit", self.disturbance_limit))

    @property
    def own_numbers(self) -> tuple[float, ...]:
        """The threshold, and the limit of disturbances."""
        return self.threshold, self.disturbance_limit

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return horizon_kernels(
            self.kernel_model.functions,
            self.kernel_model.shape,
            horizon=self.horizon,
            iterations=self.iterations,
            loss=self.loss,
            bounds=self.model.bounds,
            limited=self.disturbance_limit < math.inf,
        )

    def window(self, belief: Belief) -> np.ndarray:
        """The states (at most L, n) of the window as last estimated, the oldest first."""
        places, n = kept_places(self.kernel_model.shape), self.model.n
        steps = belief.extras[1 + n + n * n :].reshape(self.horizon + 1, places.end)
        return steps[: int(belief.extras[0]), places.x : places.x + n].copy()
