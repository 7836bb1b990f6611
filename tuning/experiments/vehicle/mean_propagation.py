"""The ensemble Kalman filter as printed in one paper: every member is predicted from the mean, not from itself."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from filters.algebra.members import mean
from filters.ensembles.stochastic import EnsembleKalmanFilter
from filters.pages.page import Page


def advance_from_the_mean(model, x, u):
    """One of the model's substeps, of all members at once."""
    return model.f(mean(x), u)


@dataclass(frozen=True, kw_only=True, eq=False)
class MeanPropagatingEnKF(EnsembleKalmanFilter):
    """The stochastic ensemble Kalman filter with a forecast that forgets the members.

        predict: x_j = f(mean, u) + w_j,  w_j ~ N(0, Q)
        update:  that of `EnsembleKalmanFilter`

    The members' covariance before an update is always Q, so the gain is Q H' (H Q H' + R)^-1: correlations that
    the model builds up over steps, such as of heave and pitch, are not used, and states that H does not contain
    are those of the model alone. With Q = R a state that is measured directly is estimated with the variance 2/3
    R; a correct filter has 0.618 R. It should not be used, so it is here and not in `filters`.

    Source: Ngatini, Nurhadi (2019), Jurnal Inovtek Polbeng Seri Informatika 4(1), equation (24), which has no
    index on the state that is moved; probably a misprint, for the authors' slides of 2017 have one.
    """

    name: ClassVar[str] = "mean-propagating enkf"
    page: ClassVar[Page] = EnsembleKalmanFilter.page._replace(propagate=advance_from_the_mean)
