"""Moving-horizon estimation: the most probable states of the last steps, within bounds, at every step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from filters.engine.belief import Belief, Kernels
from filters.filter import Filter
from filters.horizon.passes import horizon_kernels
from filters.horizon.window import HUBER, LOSSES, kept_places
from thruster_env.core.checks import at_least, one_of, positive

MOST_STEPS, MOST_ITERATIONS = 200, 50
KERNEL_HORIZONS = 10, 20, 50, 100, MOST_STEPS  # only for these there are kernels, so that studies compile few


@dataclass(frozen=True, kw_only=True, eq=False)
class MovingHorizonFilter(Filter):
    """Moving-horizon estimation: Gauss and Newton's method for the most probable states of the last L steps.

        minimise  1/2 (x_1 - m)' P^-1 (x_1 - m) + 1/2 sum w_j' Q^-1 w_j + sum rho(r_j),
                  w_j = x_{j+1} - f(x_j, u_j),  r_j^2 = v_j' R^-1 v_j,  v_j = z_j - h(x_j),
        so that   low <= x_j <= high,  |w_j| <= limit sqrt(diag Q)

    over x_1 ... x_L; the estimate is x_L. An iteration is a forward pass of the extended filter and a backward
    pass of its smoother, both linearised along the states of the pass before; the first starts from the states of
    the last update and the prediction. When a step leaves the window, its prediction of the next one becomes the
    arrival cost of that: P = F P F' + Q by the extended filter along the estimate, and m such that the estimate
    does not change. The losses are

        quadratic  rho = r^2/2;  in a linear model without bounds the estimate is the Kalman filter's for any L
        huber      rho = r^2/2 up to the threshold k, from there on k r - k^2/2
        student    rho = (k^2 + d)/2 log(1 + r^2/k^2), of Student's t with k^2 degrees of freedom, for d channels

    The latter two divide R by a weight rho'(r)/r, which each pass computes again. Bounds of states are the model's
    `bounds`; its `bounded_by` has no meaning here. Components that are at a bound are found by an active set. If
    bounds of states and disturbances leave no room between them, the states keep theirs.

    The covariance of x_L follows from the last linearisation and weights, for the problem without bounds: it does
    not vanish if a bound holds. Innovation, S and log-likelihood are the extended filter's at the prediction, with
    R itself. An iteration that increases the cost is halved.

    Each step of the window keeps its dt, Q and R. Measurements of one time share a step; a second reading of a
    channel is a further step, to which the state does not move, and counts among the L.

    `Belief.extras` holds the number of steps, m, P, and of each step u, x, z, multipliers, Q, R and the model's
    constants; `window` reads x.

    Attributes:
        horizon: L, 1 to 200; with 1 it is an iterated extended filter.
        iterations: passes in an update, 1 to 50; with bounds up to 100 more until the right bounds hold.
        loss: "huber", "student" or "quadratic"; Student's may have several minima in a linear model, too.
        threshold: k of the loss, in standard deviations.
        disturbance_limit: of each w in its standard deviations; infinite for none.

    Raises:
        ValueError: if a parameter is out of its range, or the loss unknown.

    Source: Rao, Rawlings, Mayne (2003), "Constrained state estimation for nonlinear discrete-time systems", IEEE
    Trans. Automatic Control 48(2); a smoother's passes as iterations: Bell (1994), "The iterated Kalman smoother
    as a Gauss-Newton method", SIAM J. Optimization 4(3).
    """

    name: ClassVar[str] = "mhe"
    mixable: ClassVar[bool] = False  # mixing would change the estimate, but not its window
    horizon: int = 10
    iterations: int = 3
    loss: str = HUBER
    threshold: float = 2.0
    disturbance_limit: float = math.inf

    def __post_init__(self):
        object.__setattr__(self, "horizon", at_least("horizon", self.horizon, 1, MOST_STEPS))
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))
        one_of("loss", self.loss, LOSSES)
        object.__setattr__(self, "threshold", positive("threshold", self.threshold))
        if self.disturbance_limit != math.inf:
            object.__setattr__(self, "disturbance_limit", positive("disturbance_limit", self.disturbance_limit))

    @property
    def own_parameters(self) -> tuple[float, ...]:
        """The threshold, the limit of disturbances, the horizon, and the iterations."""
        return self.threshold, self.disturbance_limit, float(self.horizon), float(self.iterations)

    @property
    def _kernel_horizon(self) -> int:
        return next(length for length in KERNEL_HORIZONS if length >= self.horizon)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return horizon_kernels(
            self.kernel_model.functions,
            self.kernel_model.shape,
            room=self._kernel_horizon,
            loss=self.loss,
            bounds=self.model.bounds,
            limited=self.disturbance_limit < math.inf,
        )

    def window(self, belief: Belief) -> np.ndarray:
        """The last estimates (at most L, n) of the states of the window, the oldest first."""
        layout, n = kept_places(self.kernel_model.shape), self.model.n
        steps = belief.extras[1 + n + n * n :].reshape(self._kernel_horizon + 1, layout.end)
        return steps[: int(belief.extras[0]), layout.x : layout.x + n].copy()
