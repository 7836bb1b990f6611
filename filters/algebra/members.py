"""What pages of ensemble filters say of members: means, covariances, angles on one branch, spread.

A vector of a member is one for each of N members. Of NumPy's arrays it is a matrix (n, N) with a column a member,
beside which vectors that are the same for all are columns (n, 1).
"""

from __future__ import annotations

import numpy as np

from filters.algebra.matrices import operation, same
from filters.algebra.points import outer
from filters.algebra.scalars import choose, constant, exceeds
from thruster_env.core.angles import whole_turns
from thruster_env.graphs.graphs import Number, arctan2, over_members, size_of, where


def _of_numbers(x) -> bool:
    return x.ndim == 1


def _means(x):
    return np.array([one.graph.make("/", over_members(one), size_of(one)) if one.member else one for one in x])


def _deviations(x):
    return x - (_means(x) if _of_numbers(x) else x.mean(axis=1, keepdims=True))


@operation(same, reduces=True)
def mean(x):
    """The mean (n,) of a vector of the members."""
    return _means(x) if _of_numbers(x) else x.mean(axis=1, keepdims=True)


def covariance(x, y):
    """The sample covariance (n, m) of two vectors of the members, with the divisor N - 1."""
    return scatter(x) if x is y else cross_covariance(x, y)


@operation(lambda x, y: (*x, *y), reduces=True)
def cross_covariance(x, y):
    """The same of two that differ."""
    d, e = _deviations(x), _deviations(y)
    if not _of_numbers(x):
        return d @ e.T / (x.shape[1] - 1)
    factor = 1.0 / (size_of(x[0]) - 1.0)
    return np.array([[over_members(one * other) * factor for other in e] for one in d])


@operation(lambda x: (*x, *x), lambda x: True, reduces=True)
def scatter(x):
    """The same of one with itself."""
    return cross_covariance.compute(x, x)


@operation(same, reduces=True)
def variances(x):
    """The sample variances (n,) of the components of a vector of the members."""
    d = _deviations(x)
    if not _of_numbers(x):
        return d.var(axis=1, ddof=1, keepdims=True)
    factor = 1.0 / (size_of(x[0]) - 1.0)
    return np.array([over_members(one * one) * factor for one in d])


def correlations(x, y):
    """The sample correlations (n, m) of two vectors of the members; 0 of what is constant."""
    squares = outer(variances(x), variances(y))
    return covariance(x, y) / choose(exceeds(squares, 0.0), squares, constant(1.0, squares)) ** 0.5


@operation(same)
def centred(e):
    """Independent normals (N/(N - 1))^1/2 (e - mean(e)), whose mean is zero and whose variance is 1."""
    size = size_of(e[0]) if _of_numbers(e) else e.shape[1]
    return _deviations(e) * (size / (size - 1.0)) ** 0.5


def on_branch(x, angles, *weights):
    """Members whose angles (flags) lie within half a turn of their circular mean, by weights or not."""
    return on_one_branch(x, tuple(angles), *weights) if any(angles) else x


@operation(same)
def on_one_branch(x, angles, weights=1.0):
    """The same, if some are."""

    def moved(row):
        middle = arctan2(_total(weights * np.sin(row)), _total(weights * np.cos(row)))
        return row - whole_turns(row - middle)

    return np.array([moved(row) if angle else row for row, angle in zip(x, angles, strict=True)])


def _total(row):
    return over_members(row) if isinstance(row, Number) else row.sum()


@operation(same)
def stretches(before, after, part):
    """Factors (n,) 1 + part (b - a)/a, of variances b^2 before and a^2 after; 1 if a = 0.

    They give back `part` of what the standard deviation has lost.
    """

    def factor(b, a):
        there = a > 0.0
        return where(there, 1.0 + part * ((b / where(there, a, 1.0)) ** 0.5 - 1.0), 1.0)

    return np.array([factor(b, a) for b, a in zip(before, after, strict=True)])
