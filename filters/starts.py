"""Where the trajectories of a batch begin, if that is not the model's prior; and a prior that is wide."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thruster_env.core.angles import difference
from thruster_env.core.sources import as_value
from thruster_env.model.layout import number_places
from thruster_env.model.shape import observation_slopes
from thruster_env.model.state_space import StateSpaceModel

PRIOR, MEASUREMENT = "prior", "measurement"
STARTS = (PRIOR, MEASUREMENT)  # where recorded runs may begin
WIDE = 10.0  # standard deviations of the prior, of which a free start has one
FAINT = 1e-6  # part of the strongest direction, below which a direction is not seen


class Starts(NamedTuple):
    """Separate priors for some of B trajectories of a model with n states."""

    free: np.ndarray  # (B,) bool, which trajectories have one; the others begin with the model's prior
    means: np.ndarray  # (B, n)
    covs: np.ndarray  # (B, n, n)
    leads: np.ndarray  # (B,) int, the first row whose innovation counts; 0 for trajectories without
    held: bool = True  # whether these priors stay where parameters move the model's

    def numbers(self, model: StateSpaceModel) -> np.ndarray:
        """The row of numbers of each trajectory's model, (B, count): the model's with other priors."""
        rows, places, n = np.tile(model.numbers, (len(self.free), 1)), number_places(model.n, model.m), model.n
        rows[self.free, places.prior_mean : places.prior_mean + n] = self.means[self.free]
        rows[self.free, places.prior_cov : places.prior_cov + n * n] = self.covs[self.free].reshape(-1, n * n)
        return rows

    def model(self, model: StateSpaceModel, place: int) -> StateSpaceModel:
        """The model with the prior of one trajectory."""
        if not self.free[place]:
            return model
        return model.replace(prior_mean=self.means[place], prior_cov=self.covs[place])

    @property
    def counted_from(self) -> np.ndarray:
        """The first row of each trajectory that counts, (B,)."""
        return np.where(self.free, self.leads, 0)


def as_the_prior_says(model: StateSpaceModel, count: int) -> Starts:
    """All of `count` trajectories begin with the model's prior."""
    means, covs = np.tile(model.prior_mean, (count, 1)), np.tile(model.prior_cov, (count, 1, 1))
    return Starts(np.zeros(count, dtype=bool), means, covs, np.zeros(count, dtype=np.int64))


def wide_cov(model: StateSpaceModel, reach: np.ndarray) -> np.ndarray:
    """The covariance W = diag(100 P_0,ii + reach_i^2), (n, n), of a start that is free.

    States are taken as independent: those that go together where a run begins at rest need not do so in its midst.

    Args:
        model: with the prior covariance P_0.
        reach: (n,), how far each state may be from the prior mean.
    """
    return np.diag(WIDE**2 * np.diag(model.prior_cov) + reach**2)


def cov_of_measured_starts(model: StateSpaceModel, first: np.ndarray) -> np.ndarray:
    """A prior covariance (n, n) with which a filter begins where its first measurement says.

        A = D^-1 H S,  V = A^+ A,  reach = S max_b |A^+ D^-1 (z_b - h(m_0))|
        P = S (V S^-1 W S^-1 V + (I - V) S^-1 P_0 S^-1 (I - V)) S

    with the prior N(m_0, P_0), H = dh/dx at m_0, the diagonal matrices S of `model.scales` and D of the standard
    deviations in R, and W of `wide_cov`. V is the projection on the observed subspace: there P is wide, so that
    the update with the first measurement replaces the prior; elsewhere it is the prior's.

    Args:
        model: with the prior.
        first: (B, m), the first value of each channel of some runs, NaN where there is none.

    Raises:
        ValueError: if no measurement sees a state at the prior mean.

    Source: Durbin, Koopman (2012), Time Series Analysis by State Space Methods, section 5.2, on diffuse starts.
    """
    x, c, shape = as_value(model.prior_mean), model.given_constants, model.shape
    scales, deviations = model.scales, np.sqrt(np.diag(model.measurement_noise_cov))
    deviations = np.where(deviations > 0, deviations, 1.0)
    h = np.array(observation_slopes(model.functions, shape)(x, as_value(scales), c)).reshape(model.m, model.n)
    a = h * scales / deviations[:, None]
    if not (np.isfinite(a).all() and a.any()):
        raise ValueError(
            "a start from the first measurement needs a measurement that depends on a state at the prior mean, "
            f"but dh/dx there is {h.tolist()}"
        )
    inverse = np.linalg.pinv(a, rcond=FAINT)
    off = difference(first, np.array(model.functions.observe(x, c)), shape.measurement_angles) / deviations
    reach = scales * np.abs(np.where(np.isfinite(off), off, 0.0) @ inverse.T).max(axis=0, initial=0.0)
    seen, scaling = inverse @ a, np.outer(scales, scales)
    unseen = np.eye(model.n) - seen
    found = seen @ (wide_cov(model, reach) / scaling) @ seen + unseen @ (model.prior_cov / scaling) @ unseen
    return (found + found.T) / 2 * scaling
