"""The iterated ensemble Kalman filter: the measurement function linearised where the members come to lie."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.geometric import geometric_mean
from filters.algebra.members import covariance
from filters.algebra.operations import divide
from filters.engine.belief import Kernels
from filters.ensembles.ensemble import EnsembleFilter
from filters.ensembles.steps import advance, compare, expect, settle
from filters.ensembles.window import seen_anew, window_kernels
from filters.pages.page_filter import Page
from thruster_env.core.checks import at_least

MOST_ITERATIONS = 20  # that are written out
LONGEST_WINDOW = 1000  # steps


def update(model, x, z, e):
    """The measurement z; channels that are NaN are missing. Y are the slopes of h along the members' distances."""
    Y, C, v, S, R, level = compare(model, x, z)
    told = v, S, level
    for _ in range(1, model.own.iterations):
        y = expect(model, x + (divide(C, S) @ v - divide(C, S + geometric_mean(R, S)) @ Y), z)
        Y, v = seen_anew(model, y, z, Y, v, S, R)
        C, S = covariance(x, Y), covariance(Y, Y) + R
    return x + (divide(C, S) @ v - divide(C, S + geometric_mean(R, S)) @ Y), *told


@dataclass(frozen=True, kw_only=True, eq=False)
class IteratedEnsembleKalmanFilter(EnsembleFilter):
    """Iterated ensemble Kalman filter (IEnKF) over one update, for nonlinear measurements.

        predict: x_j = f(x_j, u) + w_j,  w_j ~ N(0, Q);  X (n, N) the members' distances from their mean
        update:  least over w (N,) of (N - 1) w'w + (z - h(mean + X w))' R^-1 (z - h(mean + X w)), by Gauss-Newton:
                 from w = 0 and T = I on, `iterations` times,
                 y_j = h(mean + X w + X T e_j),  Y = (y - mean(y)) T^-1,  S = Y Y'/(N - 1) + R,
                 w = Y' S^-1 (z - mean(y) + Y w)/(N - 1),  T = (I + Y' R^-1 Y/(N - 1))^-1/2;
                 then x_j = mean + X w + X T e_j,  e_j the j-th unit vector

    The slopes of h are thus those at the estimate, averaged over its uncertainty. One
    iteration is the `EnsembleTransformFilter`; where h is linear, further ones change nothing. T and its inverse
    are symmetric and N x N, and never formed. The innovation and its covariance are those of the first iteration.

    Steps are not damped: where the measurement fits several states, iterations may jump between them. Where a
    measurement is far more accurate than the forecast, T^-1 magnifies any nonlinearity of h along unobserved
    directions, and iterations gain little.

    With a `window` of L steps this is the iterative ensemble Kalman smoother (IEnKS) of lag L, each measurement
    used once, the window shifted by one: mean and X are of x_0, L steps ago, and of the process noise w_1 ... w_L
    since, and y_j = h(x_Lj) follows by x_kj = f(x_(k-1)j, u_k) + w_kj, run again in each iteration. So the slopes
    are those of f, too. Where f and h are linear the estimates are those without a window.
    `Belief.members` then is (n (L + 2), N): the members now, those at the window's start given all measurements
    since, and w_1 ... w_L; `Belief.extras` holds how many steps the window has so far, with the input and the
    model's constants of each.

    Attributes:
        iterations: evaluations of h by all members in an update, 1 to 20; with a window, each with its steps of f.
        window: steps L that an update estimates again, 0 to 1000; 0 leaves the motion as predicted. With a window
            inflation and relaxation act on x_0 and the noise, and there is no adaptive_inflation.
            The others are those of `EnsembleFilter`.

    Raises:
        ValueError: if a parameter is out of its range.

    Source: Sakov, Oliver, Bertino (2012), "An iterative EnKF for strongly nonlinear systems"; over the update
    alone it is the filter of Zupanski (2005), "Maximum likelihood ensemble filter: theoretical aspects", solved as
    in Bocquet, Sakov (2012), "Combining inflation-free and iterative ensemble Kalman filters for strongly
    nonlinear systems". With a window: Bocquet, Sakov (2014), "An iterative ensemble Kalman smoother"; noise that
    is estimated, too: Sakov, Haussaire, Bocquet (2018), "An iterative ensemble Kalman filter in the presence of
    additive model error", here with one ensemble of states and noise.
    """

    name: ClassVar[str] = "ienkf"
    page: ClassVar[Page] = Page(advance, settle, update)
    unrolled: ClassVar[tuple[str, ...]] = ("iterations",)
    iterations: int = 3
    window: int = 0

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        super().__post_init__()
        object.__setattr__(self, "iterations", at_least("iterations", self.iterations, 1, MOST_ITERATIONS))
        object.__setattr__(self, "window", at_least("window", self.window, 0, LONGEST_WINDOW))
        if self.window and self.adaptive_inflation:
            rule = f"window of a filter with adaptive_inflation {self.adaptive_inflation:g} must be 0"
            raise ValueError(f"{rule}, but got {self.window}")

    @property
    def by_parts(self) -> bool:
        """Whether an update runs the motion again, too, and is more than the page."""
        return bool(self.window)

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        if not self.window:
            return super().kernels()
        page, model = self.page_with(False, False), self.kernel_model
        return window_kernels(page, model.functions, model.shape, self.window, self.iterations)
