"""Operations on weighted samples, and log densities of innovations.

A particle's x is a vector for each member, its weight or the logarithm of it a number for each member; in NumPy
these are arrays (n, N) and (N,).

    d log N(v; 0, S) = -w' dv + 1/2 tr((w w' - S^-1) dS),  w = S^-1 v

Missing channels have v = 0 and no correlations in S, so they do not contribute.
"""

from __future__ import annotations

import math

import numpy as np

from filters.algebra.matrices import minus, operation, same, through
from filters.algebra.operations import factor, forward, inverse, mirrored, quotient
from filters.algebra.scalars import logarithm
from thruster_env.core.streams import LOWEST, parts
from thruster_env.graphs.graphs import Number, largest_of_members, over_members, where


@operation(same)
def weights(logarithms):
    """e^l of l, at least -46: e^-46 is negligible beside 1. NaN becomes e^-46, too."""
    if not isinstance(logarithms, Number):
        return np.exp(np.where(logarithms > LOWEST, logarithms, LOWEST))
    series, power = parts(where(logarithms > LOWEST, logarithms, LOWEST))
    return series * power.graph.make("two_to", power)


@operation(same, reduces=True)
def total(a):
    """The sum over the members of a number."""
    return over_members(a) if isinstance(a, Number) else a.sum()


@operation(lambda a, w: a, lambda a, w: a.symmetric, reduces=True)
def weighted_mean(a, w):
    """The sum of w a over the members, for vectors or matrices a."""
    if a.dtype != object:
        return (a * w).sum(axis=-1, keepdims=True)
    return np.array([over_members(entry * w) for entry in a.ravel()], dtype=object).reshape(a.shape)


@operation(same, reduces=True)
def largest(a):
    """The largest of the members' numbers, without NaN; NaN if none is above -inf."""
    most = largest_of_members(a) if isinstance(a, Number) else np.fmax.reduce(a, initial=-math.inf)
    return where(most > -math.inf, most, math.nan)


def normalised(logarithms):
    """Weights that sum to one, proportional to e^l, and the logarithm of the sum of all e^l.

    The latter is NaN if no l is above -inf.
    """
    top = largest(logarithms)
    scaled = weights(logarithms - top)
    scale = total(scaled)
    return scaled / scale, top + logarithm(scale)


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
    return mirrored.compute(np.array([[over_members(first * other) for other in d] for first in scaled]))


@operation(same, reduces=True)
def spread_share(w):
    """1 less the sum of the squares of weights that sum to one, as the sum of w (1 - w).

    For a weight above 1/2, 1 - w is the sum of the others, which avoids cancellation.
    """
    minor = where(w > 0.5, 0.0, w) if isinstance(w, Number) else np.where(w > 0.5, 0.0, w)
    rest = total.compute(minor)
    return total.compute(minor * (1.0 - minor)) + rest * (1.0 - rest)


def weighted_covariance(x, w):
    """The sample covariance: the sum of w (x - mean)(x - mean)' over 1 - sum of w^2.

    It is unbiased for weights that do not depend on x; for equal ones the divisor is N - 1.
    """
    return weighted_square(x - weighted_mean(x, w), w) / spread_share(w)


# Log densities of innovations, and their derivatives along a parameter.

LEVEL = 0.5 * math.log(2.0 * math.pi)


def log_density(v, s, measured):
    """The number log N(v; 0, S) over the measured channels."""
    return density(v, factor(s), measured)


@operation(lambda *shapes: ())
def density(v, of, measured):
    """`log_density`, from the factor of S."""
    lower, d = of
    y = forward(np.ravel(v), lower)
    logs = (where(measured[i], 0.5 * np.log(d[i]) + LEVEL, 0.0) for i in range(len(d)))
    return -sum(0.5 * y[i] * y[i] / d[i] for i in range(len(d))) - sum(logs)


@operation(lambda *shapes: ())
def dot(a, b):
    """The product a' b of vectors."""
    return np.ravel(a) @ np.ravel(b)


@operation(lambda *shapes: ())
def half_trace(w, other, e, ds):
    """1/2 tr((w other' - e) dS), the slope of a log density along a covariance."""
    return 0.5 * ((w[:, None] * other[None, :] - e) * ds).sum()


@density.derivative
def _of_density(result, arguments, slopes):
    v, of, measured = arguments
    return density_slope(quotient(v, of), quotient(v, of), inverse(of, measured), *slopes[:2])


def density_slope(w, weighted, e, dv, ds):
    """-w' dv + 1/2 tr((w w' - e) dS), where the second w, `weighted`, may be w times a weight."""
    by_cov = through(lambda slope: half_trace(w, weighted, e, slope), ds)
    return minus(by_cov, through(lambda slope: dot(weighted, slope), dv))


# Outliers: Student's t density with the covariance S in place of the normal one


@operation(lambda *shapes: ())
def heavier(q, measured, tail):
    """The difference log t(v) - log N(v; 0, S) for q = v' S^-1 v over d channels; see `tail_of`."""
    inverse, d = tail[0], sum(where(channel, 1.0, 0.0) for channel in measured)
    level = sum(where(d == k, tail[1 + k], 0.0) for k in range(len(measured) + 1))
    safe_inverse = where(inverse > 0.0, inverse, 0.25)
    larger = (
        level
        + 0.5 * q
        - 0.5 * (1.0 / safe_inverse + d) * np.log(1.0 + safe_inverse * q / (1.0 - 2.0 * safe_inverse))
    )
    return where(inverse > 0.0, larger, 0.0)


@operation(lambda *shapes: ())
def outlier_weight(q, measured, tail):
    """(nu + d)/(nu - 2 + q), the factor of the slope of log t to that of log N by v; 1 for the normal density."""
    inverse, d = tail[0], sum(where(channel, 1.0, 0.0) for channel in measured)
    return (1.0 + inverse * d) / (1.0 - 2.0 * inverse + inverse * q)


def tail_of(degrees: float, channels: int) -> list[float]:
    """The argument `tail` for nu degrees of freedom: 1/nu, and the level for each number d of channels.

    All are zero for the normal density, nu = inf.

    log t = log N + q/2 + level - (nu + d)/2 log(1 + q/(nu - 2)),
    level = d/2 log(2/(nu - 2)) + log G((nu + d)/2) - log G(nu/2)
    """
    if degrees == math.inf:
        return [0.0] * (channels + 2)
    half, level = 0.5 * degrees, 0.5 * math.log(2.0 / (degrees - 2.0))
    return [
        1.0 / degrees,
        *(d * level + math.lgamma(half + d / 2) - math.lgamma(half) for d in range(channels + 1)),
    ]
