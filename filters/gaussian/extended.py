"""The extended Kalman filter: the Kalman filter of the model linearised along its own estimate."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.densities import log_density
from filters.algebra.operations import divide, joseph, only, present, sym, uncorrelated, wrap
from filters.gaussian.square_root import SQUARE_ROOT
from filters.gaussian.ud import UD
from filters.pages.page_filter import Page, PageFilter
from thruster_env.core.checks import one_of


def advance(model, x, P, u):
    """One of the model's substeps."""
    F = model.F(x, u)
    return wrap(model.f(x, u), model.state_angles), sym(F @ P @ F.T)


def settle(model, x, P):
    """The end of a step."""
    return x, sym(P + model.Q)


def update(model, x, P, z):
    """The measurement z; channels that are NaN are missing."""
    seen = present(z)
    H, R = only(seen, model.H(x)), uncorrelated(seen, model.R)
    v = only(seen, wrap(z - model.h(x), model.measurement_angles))
    S = sym(H @ P @ H.T + R)
    K = divide(P @ H.T, S)
    return wrap(x + K @ v, model.state_angles), joseph(P, K, H, R), v, S, log_density(v, S, seen)


@dataclass(frozen=True, kw_only=True, eq=False)
class ExtendedKalmanFilter(PageFilter):
    """Extended Kalman filter.

        predict: x = f(x, u),  P = F P F' + Q,  F = df/dx at the last mean
        update:  v = z - h(x),  S = H P H' + R,  K = P H' S^-1,  H = dh/dx at the mean,
                 x += K v,  P = (I - K H) P (I - K H)' + K R K'  (Joseph)

    Attributes:
        form: form of the recursion: "covariance" as above, "square-root" (`gaussian.square_root`) or "ud"
            (`gaussian.ud`), which keep twice the digits of P. The estimates are equal to rounding.

    Raises:
        ValueError: if the form is unknown.

    Source: Jazwinski (1970), Stochastic Processes and Filtering Theory, section 8.3.
    """

    name: ClassVar[str] = "ekf"
    page: ClassVar[Page] = Page(advance, settle, update)
    forms: ClassVar[Mapping[str, Page]] = {"square-root": SQUARE_ROOT, "ud": UD}
    form: str = "covariance"

    def __post_init__(self):
        """Check the form; raise ValueError that states the rule and the value."""
        one_of("form", self.form, self.known_forms)
