"""Weighted samples as a belief: moments, effective size, and the regularised kernel of resampled particles.

`filters.particles.kernels` defines the page of a particle filter.

Sources: Musso, Oudjane, Le Gland (2001), "Improving regularised particle filters"; Kotecha, Djuric (2003),
"Gaussian particle filtering"; Liu, West (2001), "Combined parameter and state estimation in simulation-based
filtering", section 10.2.3, whose discount factor d is b^2 = 1 - ((3 d - 1)/(2 d))^2 of `smooth`.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

from filters.algebra.members import mean as mean_of
from filters.algebra.members import on_branch
from filters.algebra.operations import only, present, uncorrelated, wrap
from filters.algebra.points import outer, root
from filters.algebra.samples import log_density, weighted_covariance, weighted_mean, weights
from filters.engine.belief import Belief, Kernels
from filters.ensembles.ensemble import LARGEST_ENSEMBLE
from filters.pages.page import Page
from filters.pages.page_filter import FilterWithPage
from filters.particles.kernels import particle_kernels
from thruster_env.core.checks import at_least, finite, positive

# Rejuvenation: functions that separate resampled particles, from mean and covariance P of the sample.


def spread(model, x, mean, P, e):
    """Add noise of a kernel, whose covariance is a part of P, to a particle."""
    return x + root(P) @ e * model.own.width


def kernel_width(count: int, size: int) -> float:
    """The width h = (4/(d + 2))^(1/(d + 4)) N^(-1/(d + 4)) of a kernel for N particles in d dimensions.

    It minimises the mean integrated square error of a Gaussian density.

    Source: Silverman (1986), Density Estimation for Statistics and Data Analysis, section 4.3.2.
    """
    return (4.0 / ((count + 2.0) * size)) ** (1.0 / (count + 4.0))


def draw(model, x, mean, P, e):
    """Draw a particle from N(mean, P), in place of x."""
    return mean + root(P) @ e


def smooth(model, x, mean, P, e):
    """Shrink the `smoothed` states towards their mean, and add noise so that their covariance stays."""
    parameters = model.own
    L = root(P * outer(parameters.smoothed, parameters.smoothed))
    return x - parameters.smoothed * (x - mean_of(x)) * parameters.drawn + L @ e * parameters.width


def initial_weighted(model, w):
    """Draw a particle from the prior."""
    return model.prior_mean + model.prior_root @ w


def expect(model, x, log_w, z):
    """The predicted measurement of a particle, zero in channels that are NaN in z; innovation and S of all."""
    measured, w = present(z), weights(log_w)
    y = on_branch(only(measured, model.h(x)), model.measurement_angles, w)
    v = only(measured, wrap(z - weighted_mean(y, w), model.measurement_angles))
    return y, v, weighted_covariance(y, w) + uncorrelated(measured, model.R)


def fit(model, y, z):
    """The logarithm of p(z | x) of a particle with the predicted measurement y."""
    measured = present(z)
    rest = only(measured, wrap(z - y, model.measurement_angles))
    return log_density(rest, uncorrelated(measured, model.R), measured)


@dataclass(frozen=True, kw_only=True, eq=False)
class WeightedFilter(FilterWithPage):
    """Base of the particle filters.

    Attributes:
        ensemble_size: number N of particles, from 2 to a million.
        regularisation: factor on the width of the Gaussian kernel that spreads resampled particles; 0 for none, 1
            for the best width for a Gaussian belief. With little or no process noise, nothing else separates the
            copies of a particle.
    """

    gaussian_likelihood: ClassVar[bool] = False
    any_step: ClassVar[bool] = False
    resampled: ClassVar[bool] = True
    ensemble_size: int = 1000
    regularisation: float = 0.0

    def __post_init__(self):
        size = at_least("ensemble_size", self.ensemble_size, 2)
        if size > LARGEST_ENSEMBLE:
            raise ValueError(f"ensemble_size must be at most {LARGEST_ENSEMBLE}, but got {size}")
        object.__setattr__(self, "ensemble_size", size)
        width = positive("regularisation", self.regularisation, zero_allowed=True)
        object.__setattr__(self, "regularisation", width)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameters of the page: the width of the kernel, over the standard deviations of all particles."""
        return {"width": self.regularisation * kernel_width(self.spread_states, self.ensemble_size)}

    @property
    def spread_states(self) -> int:
        """Number of states that the kernel spreads."""
        return self.model.n

    @property
    def written_page(self) -> Page:
        """The page, with the kernel if its width is not zero."""
        page = super().written_page
        return page if self.regularisation else page._replace(rejuvenate=None)

    @property
    def size(self) -> int:
        """Number of particles."""
        return self.ensemble_size

    def kernels(self) -> Kernels:
        """Kernels of the page for the model's functions; see `Filter.kernels`."""
        return particle_kernels(self.written_page, self.kernel_model.functions, self.kernel_model.shape)

    @staticmethod
    def effective_sample_size(belief: Belief) -> float:
        """The effective number of equally weighted particles, from 1 to N."""
        return float(belief.extras[0])


@dataclass(frozen=True, kw_only=True, eq=False)
class ResampledFilter(WeightedFilter):
    """Base of the particle filters that resample when few particles have most of the weight.

    Attributes:
        resampling_threshold: fraction of N; an effective sample size (ESS) below it triggers resampling; from 0
            (never) to 1.
    """

    resampling_threshold: float = 0.5

    def __post_init__(self):
        super().__post_init__()
        threshold = finite("resampling_threshold", self.resampling_threshold)
        if not 0.0 <= threshold <= 1.0:
            raise ValueError(f"resampling_threshold must be from 0 to 1, but got {threshold}")
        object.__setattr__(self, "resampling_threshold", threshold)

    @property
    def parameters(self) -> Mapping[str, Any]:
        """The parameters of the page and of resampling."""
        return {**super().parameters, "resampling_threshold": self.resampling_threshold}
