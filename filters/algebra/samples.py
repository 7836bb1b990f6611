"""What pages of particle filters say of weighted samples: weights, sums over them, covariances.

A particle's x is a vector of a member, its weight w or the logarithm of that a number of a member: beside NumPy's
arrays (n, N) of vectors (N,).
"""

from __future__ import annotations

import math

import numpy as np

from filters.algebra.matrices import operation, same
from filters.algebra.operations import mirrored
from filters.algebra.scalars import logarithm
from thruster_env.core.exponential import LOWEST, parts
from thruster_env.graphs.graphs import Number, largest_of_members, over_members, where


@operation(same)
def weights(logarithms):
    """e^l, where l is at least -46: e^-46 is nothing beside 1, and takes the place of no number, too."""
    if not isinstance(logarithms, Number):
        return np.exp(np.where(logarithms > LOWEST, logarithms, LOWEST))
    series, power = parts(where(logarithms > LOWEST, logarithms, LOWEST))
    return series * power.graph.make("two_to", power)


@operation(same, reduces=True)
def total(a):
    """The sum of a number that each member has."""
    return over_members(a) if isinstance(a, Number) else a.sum()


@operation(lambda a, w: a, lambda a, w: a.symmetric, reduces=True)
def weighted_mean(a, w):
    """The sum of w a over the members, of vectors or matrices."""
    if a.dtype != object:
        return (a * w).sum(axis=-1, keepdims=True)
    return np.array([over_members(one * w) for one in a.ravel()], dtype=object).reshape(a.shape)


@operation(same, reduces=True)
def largest(a):
    """The largest of the numbers that the members have, of which NaN is none; NaN if none is above -inf."""
    most = largest_of_members(a) if isinstance(a, Number) else np.fmax.reduce(a, initial=-math.inf)
    return where(most > -math.inf, most, math.nan)


def normalised(logarithms):
    """Weights that sum to one, of their logarithms but for a constant, and the logarithm of the sum of all e^l.

    The latter is NaN if no l is above -inf.
    """
    top = largest(logarithms)
    scaled = weights(logarithms - top)
    some = total(scaled)
    return scaled / some, top + logarithm(some)


@operation(same, reduces=True)
def effective_size(w):
    """The ESS 1/sum of w^2 of weights that sum to one (Kong, Liu, Wong 1994)."""
    return 1.0 / total.compute(w * w)


@operation(lambda d, w: (*d, *d), lambda d, w: True, reduces=True)
def weighted_square(d, w):
    """The sum of w d d' over the members."""
    if d.dtype != object:
        return (d * w) @ d.T
    scaled = w * d
    return mirrored.compute(np.array([[over_members(one * other) for other in d] for one in scaled]))


@operation(same, reduces=True)
def spread_share(w):
    """1 less the sum of the squares of weights that sum to one, as the sum of w (1 - w).

    For a weight near 1 the others tell 1 - w without cancellation. Where one weight is all, it is what they say.
    """
    others = where(w > 0.5, 0.0, w) if isinstance(w, Number) else np.where(w > 0.5, 0.0, w)
    rest = total.compute(others)
    return total.compute(others * (1.0 - others)) + rest * (1.0 - rest)


def weighted_covariance(x, w):
    """The sample covariance: the sum of w (x - mean)(x - mean)' over 1 - sum of w^2.

    It is unbiased for weights that do not depend on x; for equal ones the divisor is N - 1.
    """
    return weighted_square(x - weighted_mean(x, w), w) / spread_share(w)
