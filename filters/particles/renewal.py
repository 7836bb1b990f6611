"""What is done with resampled particles, copies of one another, of a sample with some mean and covariance P.

Sources: Musso, Oudjane, Le Gland (2001), "Improving regularised particle filters"; Kotecha, Djuric (2003),
"Gaussian particle filtering"; Liu, West (2001), "Combined parameter and state estimation in simulation-based
filtering", section 10.2.3, whose discount factor d is b^2 = 1 - ((3 d - 1)/(2 d))^2 of `smooth`.
"""

from __future__ import annotations

from filters.algebra.members import mean as mean_of
from filters.algebra.points import outer, root


def spread(model, x, mean, P, e):
    """Particles that are copies of one, spread by a kernel with a part of the covariance of all."""
    return x + root(P) @ e * model.own.width


def kernel_width(count: int, size: int) -> float:
    """The width h = (4/(d + 2))^(1/(d + 4)) N^(-1/(d + 4)) of a kernel for N particles in d dimensions.

    It makes the mean integrated square error of the density least where that is Gaussian.

    Source: Silverman (1986), Density Estimation for Statistics and Data Analysis, section 4.3.2.
    """
    return (4.0 / ((count + 2.0) * size)) ** (1.0 / (count + 4.0))


def draw(model, x, mean, P, e):
    """Particles of a Gaussian, in the place of others."""
    return mean + root(P) @ e


def smooth(model, x, mean, P, e):
    """The states that are `smoothed` drawn together by a, and spread so that their covariance stays."""
    own = model.own
    L = root(P * outer(own.smoothed, own.smoothed))
    return x - own.smoothed * (x - mean_of(x)) * own.drawn + L @ e * own.width
