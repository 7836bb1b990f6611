"""Log densities of innovations, and their derivatives along a parameter.

    d log N(v; 0, S) = -w' dv + 1/2 tr((w w' - S^-1) dS),  w = S^-1 v

Channels that are missing have v = 0 and no correlations in S; they count for nothing.
"""

from __future__ import annotations

import math

import numpy as np

from filters.algebra.matrices import minus, operation, through
from filters.algebra.operations import factor, forward, inverse, quotient
from thruster_env.graphs.graphs import where

LEVEL = 0.5 * math.log(2.0 * math.pi)


def log_density(v, s, seen):
    """The number log N(v; 0, S) over the channels that are seen."""
    return density(v, factor(s), seen)


@operation(lambda *shapes: ())
def density(v, of, seen):
    """The same, of the factor of S."""
    lower, d = of
    y = forward(np.ravel(v), lower)
    logs = (where(seen[i], 0.5 * np.log(d[i]) + LEVEL, 0.0) for i in range(len(d)))
    return -sum(0.5 * y[i] * y[i] / d[i] for i in range(len(d))) - sum(logs)


@operation(lambda *shapes: ())
def dot(a, b):
    """The product a' b of vectors."""
    return np.ravel(a) @ np.ravel(b)


@operation(lambda *shapes: ())
def stretch(w, other, e, ds):
    """1/2 tr((w other' - e) dS), the slope of a log density along a covariance."""
    return 0.5 * ((w[:, None] * other[None, :] - e) * ds).sum()


@density.derivative
def _of_density(result, arguments, slopes):
    v, of, seen = arguments
    return density_slope(quotient(v, of), quotient(v, of), inverse(of, seen), *slopes[:2])


def density_slope(w, weighted, e, dv, ds):
    """-w' dv + 1/2 tr((w w' - e) dS), of w or of that times a weight."""
    by_cov = through(lambda slope: stretch(w, weighted, e, slope), ds)
    return minus(by_cov, through(lambda slope: dot(weighted, slope), dv))


# Outliers: Student's t density with the covariance S in place of the normal one


@operation(lambda *shapes: ())
def heavier(q, seen, tail):
    """The difference log t(v) - log N(v; 0, S) for q = v' S^-1 v over d channels; see `tail_of`."""
    inverse, d = tail[0], sum(where(one, 1.0, 0.0) for one in seen)
    level = sum(where(d == k, tail[1 + k], 0.0) for k in range(len(seen) + 1))
    some = where(inverse > 0.0, inverse, 0.25)
    larger = level + 0.5 * q - 0.5 * (1.0 / some + d) * np.log(1.0 + some * q / (1.0 - 2.0 * some))
    return where(inverse > 0.0, larger, 0.0)


@operation(lambda *shapes: ())
def outlier_weight(q, seen, tail):
    """(nu + d)/(nu - 2 + q), times which what depends on v changes for log t; 1 for the normal density."""
    inverse, d = tail[0], sum(where(one, 1.0, 0.0) for one in seen)
    return (1.0 + inverse * d) / (1.0 - 2.0 * inverse + inverse * q)


def tail_of(degrees: float, channels: int) -> list[float]:
    """What densities need of nu degrees of freedom: 1/nu, and a level for each number d of channels; or zeros.

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
