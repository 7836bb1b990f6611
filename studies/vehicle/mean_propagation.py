"""The ensemble Kalman filter as printed in one paper: every member is predicted from the mean, not from itself."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar

from filters.engine.belief import Kernels
from filters.ensembles.ensemble import EnsembleKalmanFilter
from filters.ensembles.members import row_means
from numerics.compiled import inlined
from numerics.sources import Source


@lru_cache(maxsize=64)
def from_the_mean(kernels: Kernels) -> Kernels:
    """An ensemble's kernels in which all members are set to their mean before the prediction."""
    n, predict_members, means_of = kernels.n, kernels.predict, row_means(kernels.n)
    source = Source("gather", "table, means", means=(n,))
    for a in source.rows_of_members(n):
        source.line(f"table[{a}, j] = means[{a}]")
    gather = source.function()

    @inlined
    def predict(memory, u, numbers, size):
        _, table, _ = memory
        gather(table, means_of(table, size))
        predict_members(memory, u, numbers, size)

    return kernels._replace(predict=predict)


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

    def kernels(self) -> Kernels:
        """Kernels for the model's functions; see `Filter.kernels`."""
        return from_the_mean(super().kernels())
