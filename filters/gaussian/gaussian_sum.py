"""A Gaussian sum filter: each update splits the belief, so that it may have several modes, and merges it again."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, ClassVar

import numpy as np

from filters.algebra.densities import dot
from filters.algebra.points import outer
from filters.algebra.scalars import choose, exceeds
from filters.baselines.baselines import place_of
from filters.gaussian import extended
from filters.gaussian.mixture_filter import MixtureFilter, MixturePage
from thruster_env.core.checks import at_least

FEWEST_PARTS, MOST_PARTS = 7, 1000
REACH = 4.5  # of the outermost parts, in standard deviations of the split component
OVERLAP = 0.6  # standard deviation of a part, over the distance from one to the next


def begin(model, x, P):
    """Weights of the parts before a measurement, and the direction g = P e/sqrt(e' P e) of the split."""
    e = model.own.unit
    variance = dot(e, P @ e)
    return model.own.weights, P @ e * choose(exceeds(variance, 0.0), variance**-0.5, variance * 0.0)


def update(model, t, g, x, P, z):
    """The part at the node t, after the measurement z."""
    return extended.update(model, x + g * t, P - outer(g, g) * model.own.narrower, z)


@dataclass(frozen=True, kw_only=True, eq=False)
class GaussianSumFilter(MixtureFilter):
    """Gaussian sum filter: an extended filter whose belief is a sum of Gaussians within each update.

        predict: the extended filter's
        split:   along g = P e_i/sqrt(P_ii), the way in which the state goes with its component i, into parts
                 N(mean + t_k g, P - (1 - s^2) g g') of weight a_k; nodes t_k, weights a_k and s < 1 are those of a
                 sum of N(t_k, s^2) with mean 0 and variance 1, so that mean and covariance stay the belief's
        update:  each part by the extended filter, with h and H at its own mean;
                 its weight becomes a_k N(z; h(x_k), S_k)/L,  L = sum of a_k N(z; h(x_k), S_k)
        merge:   mean and P of the weighted parts: P within the parts and between them

    A measurement may thus have several solutions in component i; one linearisation at the mean finds only one. The
    log-likelihood is log L; innovation and S are those of the mixture before the measurement. On an affine model
    this is the Kalman filter to some thousandths of a standard deviation, for the sum has thinner tails than a
    Gaussian.

    `Belief.extras` holds what the last update made of each part: mean, covariance, innovation, its covariance and
    its log-likelihood; then the weights. `part_estimates` takes it apart.

    Attributes:
        parts: number of Gaussians, at least 7.
        component: index i of the component along which the belief is split; -1 is the last.

    Raises:
        ValueError: if parts or component is out of its range.

    Source: Alspach, Sorenson (1972), "Nonlinear Bayesian estimation using Gaussian sum approximations"; splitting
    along one direction: Faubel, McDonough, Klakow (2009), "The split and merge unscented Gaussian mixture filter".
    """

    name: ClassVar[str] = "gsf"
    page: ClassVar[MixturePage] = MixturePage(begin, update)
    gaussian_likelihood: ClassVar[bool] = False
    parts: int = 15
    component: int = -1

    def __post_init__(self):
        """Check the parameters; raise ValueError that states the rule and the value."""
        object.__setattr__(self, "parts", at_least("parts", self.parts, FEWEST_PARTS, MOST_PARTS))
        object.__setattr__(self, "component", place_of("component", self.component, self.model.n))

    @cached_property
    def standard_split(self) -> tuple[np.ndarray, np.ndarray, float]:
        """Nodes t (parts,), weights a (parts,) and variance s^2 of a sum of Gaussians like N(0, 1)."""
        nodes = np.linspace(-REACH, REACH, self.parts)
        variance = (OVERLAP * (nodes[1] - nodes[0])) ** 2
        weights = np.exp(-0.5 * nodes**2)
        weights /= weights.sum()
        return nodes * np.sqrt((1.0 - variance) / (weights @ nodes**2)), weights, float(variance)

    @cached_property
    def parameters(self) -> dict[str, Any]:
        """The unit vector of the component, 1 - s^2, and the weights."""
        _, weights, variance = self.standard_split
        return {"unit": np.eye(self.model.n)[self.component], "narrower": 1.0 - variance, "weights": weights}

    @cached_property
    def of_parts(self) -> np.ndarray:
        """The nodes."""
        return self.standard_split[0]
