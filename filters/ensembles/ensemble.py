"""The base of all ensemble filters: propagation of the members, inflation and relaxation.

Inflation, its adaptation to the innovations (`adapted`) and relaxation take a page and return one that does more.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from filters.algebra.members import correlations, covariance, mean, on_branch, stretches, variances
from filters.algebra.operations import at_least as at_least_number
from filters.algebra.operations import (
    choose,
    constant,
    diagonal,
    divide,
    exceeds,
    factor,
    inverse,
    mask_missing,
    present,
    sym,
    uncorrelated,
    wrap,
)
from filters.algebra.points import dot, log_density, outer
from filters.algebra.tangents import added
from filters.engine.belief import Belief, Kernels
from filters.filter import FilterWithPage
from filters.pages.kernels import members_kernels
from filters.pages.page import Page
from thruster_env.core.checks import at_least, positive, short_repr, switch


def checked(filter_: Any) -> dict[str, float]:
    """The parameters of a filter as numbers; raise ValueError that states the rule and the value."""
    inflation, relaxation = filter_.inflation, positive("relaxation", filter_.relaxation, zero_allowed=True)
    if relaxation > 1.0:
        raise ValueError(f"relaxation must be at most 1, but got {short_repr(filter_.relaxation)}")
    first = positive("adaptive_inflation", filter_.adaptive_inflation, zero_allowed=True)
    if switch("inflation_by_state", filter_.inflation_by_state) and not first:
        raise ValueError("adaptive_inflation of a filter with inflation_by_state must be positive, but got 0")
    least = positive("least_deviation", filter_.least_deviation, zero_allowed=True)
    if least > first:
        rule = f"least_deviation must be at most adaptive_inflation, {first:g}"
        raise ValueError(f"{rule}, but got {short_repr(filter_.least_deviation)}")
    known = {"adaptive_inflation": first, "least_deviation": least}
    return {"inflation": positive("inflation", inflation), "relaxation": relaxation, **known}


def limits(first: float, least: float) -> Mapping[str, float]:
    """Parameters of pages: the deviation of a factor, or the widest and narrowest width; none without a factor."""
    if not first:
        return {}
    return {"widest": width_of(first), "narrowest": width_of(least)} if least else {"deviation": first}


def width_of(deviation: float) -> float:
    """The width p of an inverse gamma density, below 1/3, with a standard deviation over its mode."""

    def excess(root):
        p = root * root
        return root - deviation * (1.0 - 2.0 * p) * max(1.0 - 3.0 * p, 0.0) ** 0.5

    from scipy.optimize import brentq  # here, because it loads half of SciPy

    return brentq(excess, 0.0, 3.0**-0.5, xtol=1e-300) ** 2  # solved for the root of p, so that a small p is exact


@cache
def inflated(add_process_noise: Callable) -> Callable:
    """Add process noise, then x = mean + inflation (x - mean)."""

    def add_process_noise_inflated(model, x, w):
        x = add_process_noise(model, x, w)
        return mean(x) + (x - mean(x)) * model.own.inflation

    return add_process_noise_inflated


@cache
def relaxed(update: Callable) -> Callable:
    """An update, then x = mean + (1 + relaxation (b - a)/a) (x - mean), by components.

    b and a are the sample standard deviations before and after the update. A component without spread after the
    update stays without. The means do not change.
    """

    def update_relaxed(model, x, z, e):
        after, *outputs = update(model, x, z, e)
        factors = stretches(variances(x), variances(after), model.own.relaxation)
        return mean(after) + (after - mean(after)) * factors, *outputs

    return update_relaxed


def propagate(model, x, u):
    """Propagate a member by one substep."""
    return model.f(x, u)


def add_process_noise(model, x, w):
    """Add noise of covariance Q to a member, at the end of a step."""
    return on_branch(added(model, x, model.Q_root @ w), model.state_angles)


def expect(model, x, z):
    """The predicted measurement of a member, zero in channels that are NaN in z."""
    return on_branch(mask_missing(present(z), model.h(x)), model.measurement_angles)


def compare(model, x, z):
    """A member's y minus the mean of y, cov(x, y), innovation v, S, R, log N(v; 0, S).

    Covariances are tapered if the filter has tapers between channels.
    """
    measured, y = present(z), expect(model, x, z)
    R = uncorrelated(measured, model.R)
    v = mask_missing(measured, wrap(z - mean(y), model.measurement_angles))
    C, A = covariance(x, y), covariance(y, y)
    if hasattr(model.own, "between"):
        C, A = C * model.own.taper, sym(A * model.own.between)
    S = A + R
    return y - mean(y), C, v, S, R, log_density(v, S, measured)


def slopes(model, x, z, v, S):
    """Return g, or each g_i, of members x before the update, by 1/2 tr((w w' - S^-1) dA/dt'), w = S^-1 v."""
    measured, w, ones, t = present(z), divide(v, S), constant(1.0, v), model.extras["factor"]
    A = S - uncorrelated(measured, model.R)
    # Sums of the rows of M o A, M = w w' - S^-1, for 1/2 tr(M (E A + A E)) of a diagonal E is their sum by E.
    scores = ((outer(w, w) - inverse(factor(S), measured)) * A) @ ones
    if not np.shape(t):
        return dot(scores, ones) / (2.0 * t)
    c, root = abs(correlations(x, expect(model, x, z))), t**0.5
    if hasattr(model.own, "taper"):
        c = c * model.own.taper
    return ((c / (1.0 + diagonal(root - 1.0) @ c)) @ scores) / (2.0 * root)  # E = dD/dt' where D = I


def updated_factor(t, g, deviation):
    """The mode of the normal prior times the likelihood, at least 1."""
    # A root of u^2 + u/g - deviation^2: the larger one if g is positive, else the smaller; 1 if g is NaN.
    product = 2.0 * g * (deviation * deviation)
    return at_least_number(t + product / (1.0 + (1.0 + 2.0 * g * product) ** 0.5), 1.0)


def relative_move(h, p):
    """Return e: (1 + h e) times an inverse gamma density with mode 1 and width p has its mode at 1 + e."""
    # That root of (1 - p) h e^2 + (1 - 2 p h) e - p h which has the sign of h.
    along = 1.0 - 2.0 * p * h
    return 2.0 * p * h / (along + (along * along + 4.0 * p * (1.0 - p) * h * h) ** 0.5)


def factor_and_width(t, p, g, narrowest, widest):
    """The mode for an inverse gamma prior, and the new width; 1 and the widest if the likelihood is NaN."""
    e = relative_move(t * g, p)  # comparisons below are false for NaN
    d = e / (1.0 + e)
    p = p / (1.0 - 2.0 * d + d * d / p)
    p = choose(exceeds(widest - p, 0.0), p, widest)
    return at_least_number(t * (1.0 + e), 1.0), choose(exceeds(p - narrowest, 0.0), p, narrowest)


@cache
def adapted(page: Page) -> Page:
    """A page whose inflation adapts to the innovations, by a factor t for each number of `model.own.deviation`.

        predict: x_j = mean + t^1/2 (x_j - mean) at the end of the step
        update:  t = max(1, t + u), u the mode of  (1 + g u) exp(-u^2/(2 deviation^2)),
                 g = d log N(v; 0, (t'/t) A + R)/dt' at t' = t,  A = S - R the forecast's own part of S

    The belief keeps the factor, initially 1. Before each update it is normal with a constant standard deviation,
    so that it can follow a model whose errors change; its likelihood is linearised about the last value. An error
    of the model that is not in Q widens the innovations, and so the ensemble.

    With a factor for each state, t_i is that of state i, and its likelihood is that of all channels if only t_i
    changes:

        g_i = d log N(v; 0, D A D + R)/dt' at t' = t_i,  D_kk = (1 + c_ik (t'^1/2 - 1))/(1 + c_ik (t_i^1/2 - 1)),
        c_ik = taper of i and k times |correlation of x_i and y_k| in the forecast

    so that for a single state and a linear h it equals the common factor.

    With an inverse gamma prior (`model.own` has the `widest` and the `narrowest` width), p(t') ~ t'^-(a+1)
    exp(-(a+1) t/t'), whose mode is t, measurements also change the standard deviation. The belief keeps it as the
    width p = 1/(a+1), after the factors:

        (deviation/t)^2 = p/((1 - 2p)^2 (1 - 3p)),  p at first that of `adaptive_inflation`, later between it and
                          that of `least_deviation`
        update:  t+ = t (1 + e), the mode of (1 + g (t' - t)) p(t');  p+ = p/(1 - 2d + d^2/p),  d = 1 - t/t+,
                 the inverse gamma density with the posterior's mode and its curvature there;  t = max(1, t+)

    Sources: Anderson (2007), "An adaptive covariance inflation error correction algorithm for ensemble filters",
    for one factor; the linear likelihood and factors of states are those of Anderson (2009), "Spatially and
    temporally varying adaptive covariance inflation for ensemble filters", here of all channels at once. The
    inverse gamma prior: El Gharamti (2018), "Enhanced adaptive inflation algorithm for ensemble filters", Monthly
    Weather Review 146, which finds the new deviation from a second point of the posterior instead of its
    curvature.
    """

    def start(model):
        parameters = model.own
        if hasattr(parameters, "widest"):
            return {"factor": constant(1.0, parameters.widest), "width": parameters.widest}
        return {"factor": constant(1.0, parameters.deviation)}

    def add_inflated_noise(model, x, w):
        x = page.add_process_noise(model, x, w)
        return mean(x) + (x - mean(x)) * model.extras["factor"] ** 0.5

    def update(model, x, z, e):
        after, v, S, level = page.update(model, x, z, e)
        t, parameters = model.extras["factor"], model.own
        g = slopes(model, x, z, v, S)
        if not hasattr(parameters, "widest"):
            return after, v, S, level, {"factor": updated_factor(t, g, parameters.deviation)}
        t, p = factor_and_width(t, model.extras["width"], g, parameters.narrowest, parameters.widest)
        return after, v, S, level, {"factor": t, "width": p}

    return page._replace(initial=start, add_process_noise=add_inflated_noise, update=update)


LARGEST_ENSEMBLE = 1_000_000
OF_THE_ENGINE = frozenset(  # parameters that no page reads
    "ensemble_size rotations radius adaptive_inflation inflation_by_state least_deviation window".split()
)


@dataclass(frozen=True, kw_only=True, eq=False)
class EnsembleFilter(FilterWithPage):
    """Base of the ensemble filters: subclasses name their page, whose functions are written for one member.

        x = add_process_noise(model, propagate(model, x, u), w),  w ~ N(0, I),  propagate once per substep
        x, v, S, log N(v; 0, S) = update(model, x, z, e),  e ~ N(0, I)

    Results of all members, such as `mean(x)` and `covariance(x, y)` (`filters.algebra.members`), are the same for
    each. Normals that a page does not use are not drawn. The belief's mean and covariance are those of the
    members.

    Attributes:
        ensemble_size: number N of members, at least 2.
        inflation: factor on the spread of the members about their mean in every step of the model's dt, after the
            process noise; 1 is none. For steps of another length dt' it is inflation^(dt'/dt).
        relaxation: fraction, 0 to 1, of each state's loss of spread in an update that is restored.
        adaptive_inflation: standard deviation, in each update, of a factor on the covariance of each forecast, in
            steps of any length; the factor is estimated from the innovations and is at least 1. 0 for no factor.
            See `adapted`.
        inflation_by_state: 1 for a factor of adaptive_inflation for each state, 0 for a common one.
        least_deviation: if positive, the factor's prior is an inverse gamma density with the initial standard
            deviation adaptive_inflation; measurements change it, but not below this. Both are relative to the
            factor.

    Sources: Anderson, Anderson (1999), "A Monte Carlo implementation of the nonlinear filtering problem to produce
    ensemble assimilations and forecasts", for inflation; Whitaker, Hamill (2012), "Evaluating methods to account
    for system errors in ensemble data assimilation", for relaxation to the prior spread.
    """

    ensemble_size: int = 100
    inflation: float = 1.0
    relaxation: float = 0.0
    adaptive_inflation: float = 0.0
    inflation_by_state: int = 0
    least_deviation: float = 0.0

    def __post_init__(self):
        size = at_least("ensemble_size", self.ensemble_size, 2, LARGEST_ENSEMBLE)
        for name, number in {"ensemble_size": size, **checked(self)}.items():
            object.__setattr__(self, name, number)

    @property
    def by_parts(self) -> bool:
        """Whether an update goes through states or channels, or runs the motion, which a page does not contain."""
        return False

    @property
    def size(self) -> int:
        """Number of ensemble members."""
        return self.ensemble_size

    @property
    def parameters(self) -> Mapping[str, Any]:
        """Fields that the page reads, and limits of each factor of an adaptive inflation, if it is chosen."""
        count = np.ones(self.model.t) if self.inflation_by_state else 1.0
        limits_of_factors = limits(self.adaptive_inflation, self.least_deviation).items()
        return {**super().parameters, **{name: count * limit for name, limit in limits_of_factors}}

    def _fields(self) -> Iterator[str]:
        return (name for name in super()._fields() if name not in OF_THE_ENGINE)

    @property
    def written_page(self) -> Page:
        """The page, with inflation and relaxation if they differ from none."""
        return self.page_with(self.inflation != 1.0, self.relaxation != 0.0)

    def page_with(self, inflation: bool = True, relaxation: bool = True) -> Page:
        """The page, with inflation, relaxation, or both, and adaptive inflation if it is chosen."""
        page = self.plain_page
        if inflation:
            page = page._replace(add_process_noise=inflated(page.add_process_noise))
        if relaxation:
            page = page._replace(update=relaxed(page.update))
        return adapted(page) if self.adaptive_inflation else page

    def sample(self, belief: Belief) -> np.ndarray:
        """The members (n, N) of a belief, without further rows that a filter keeps."""
        return belief.members[: self.kernel_model.n]

    def kernels(self) -> Kernels:
        """Kernels of the page for the model's functions; see `Filter.kernels`."""
        shape = self.kernel_model.any_shape if self.takes_rotations else self.kernel_model.shape
        return members_kernels(self.written_page, self.kernel_model.functions, shape)

    @property
    def takes_rotations(self) -> bool:
        """Whether it takes models with rotations: if its update is its page, no radius, no random rotations."""
        return not (self.by_parts or any(getattr(self, name, 0) for name in ("radius", "rotations")))


def check_page_is_all(filter_: EnsembleFilter, where: str) -> None:
    """Raise ValueError for an ensemble whose update is more than its page: `where` says what runs only pages."""
    if getattr(filter_, "rotations", 0):
        raise ValueError(f"an ensemble {where} must have no random rotations, but got rotations=1")
    if filter_.by_parts:
        rule = f"an ensemble {where} must have a page for its whole update, as 'etkf' has"
        raise ValueError(f"{rule}, but got {named(filter_)}")


def named(filter_: EnsembleFilter) -> str:
    """The name of a filter, with the parameters by which its update is more than its page."""
    chosen = ((name, getattr(filter_, name, 0)) for name in ("radius", "window"))
    return f"{filter_.name!r}" + "".join(f" with a {name} of {number:g}" for name, number in chosen if number)
