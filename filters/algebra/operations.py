"""Operations of pages besides + - @ * / ** and .T: symmetry, angles, missing channels, quotients, Joseph's form.

Each is a function of arrays, an operation on Matrices, and a derivative along a parameter, such as

    d (C S^-1) = (dC - K dS) S^-1,  K = C S^-1

Source: Magnus, Neudecker (2019), Matrix Differential Calculus with Applications in Statistics and Econometrics.
"""

from __future__ import annotations

import math

import numpy as np

from filters.algebra.matrices import Matrix, minus, multiply, operation, plus, same, through
from thruster_env.core.angles import wrapped
from thruster_env.graphs.graphs import where


def sym(a):
    """The symmetric part of a matrix that is symmetric but for rounding; a Matrix computes only its lower half.

    A P A', with a symmetric P, is computed from P A', because gains need P A', too.
    """
    if not isinstance(a, Matrix):
        return 0.5 * (a + a.T)
    if a.symmetric:
        return a
    if getattr(a.operation, "name", "") in ("add", "subtract"):
        return a.operation(*map(sym, a.arguments))
    if a.operation is multiply and a.arguments[0].operation is multiply:
        (left, p), right = a.arguments[0].arguments, a.arguments[1]
        if p.symmetric and left.T is right:
            return congruence(left, p, p @ right)
    return mirrored(a)


@operation(same, lambda a: True)
def mirrored(a):
    """The symmetric matrix whose entries on and below the diagonal are those of a."""
    at = np.arange(len(a))
    return a[np.maximum.outer(at, at), np.minimum.outer(at, at)]


@operation(lambda a, *shapes: (a[0], a[0]), lambda *arguments: True)
def congruence(a, p, pa):
    """The matrix A P A' of a symmetric P, from A and P A'."""
    return mirrored.compute(a @ pa)


@operation(same, lambda a: True)
def with_transposed(a):
    """The sum A + A'."""
    return a + a.T


@operation(lambda shape: (shape[0], shape[0]), lambda like: True)
def eye(like):
    """The identity matrix with as many rows as `like`."""
    return np.eye(len(like))


def wrap(x, angles):
    """A vector with its angles (flags) wrapped to (-pi, pi]."""
    return on_one_branch(x, tuple(angles)) if any(angles) else x


@operation(same)
def on_one_branch(x, angles):
    """`wrap`, if there are angles."""
    return np.array([wrapped(entry) if angle else entry for entry, angle in zip(x, angles, strict=True)])


# Missing channels: those that are NaN in z


@operation(same)
def present(z):
    """Which channels of z are measured."""
    return np.array([entry == entry for entry in z])


def _masked(keep, a, shape):
    return np.array([where(keep(*at), a[at], 0.0) for at in np.ndindex(*shape)], dtype=a.dtype).reshape(shape)


@operation(lambda measured, shape: shape)
def only(measured, a):
    """A vector, or rows of a matrix, with zeros for missing channels."""
    return _masked(lambda i, *_: measured[i], a, a.shape)


@operation(lambda measured, shape: shape, lambda measured, r: r.symmetric)
def uncorrelated(measured, r):
    """The covariance r without its correlations to missing channels."""
    return _masked(lambda i, j: True if i == j else measured[i] & measured[j], r, r.shape)


# Quotients


@operation(same)
def factor(s):
    """Unit lower triangular L, and d, with L diag(d) L' = s; NaN where s is not positive definite."""
    return pivoted(s, lambda d, variance: d > 0.0, math.nan)


def pivoted(s, counts, otherwise):
    """The factor by Cholesky's method, with another d, NaN or infinite, where counts(d, s_ii) is false."""
    lower, d = np.array(np.eye(len(s)), dtype=s.dtype), np.array(np.diag(s))
    used = np.array(d)  # zero in place of infinity, by which its column of L, zero, is not to be multiplied
    for j in range(len(s)):
        pivot = d[j] - sum(lower[j, k] * lower[j, k] * used[k] for k in range(j))
        is_number = counts(pivot, s[j, j])
        d[j] = where(is_number, pivot, otherwise)
        used[j] = where(is_number, pivot, 0.0) if otherwise == math.inf else d[j]
        for i in range(j + 1, len(s)):
            lower[i, j] = (s[i, j] - sum(lower[i, k] * lower[j, k] * used[k] for k in range(j))) / d[j]
    return lower, d


def divide(c, s):
    """The matrix C S^-1, or the vector S^-1 c, for a covariance S; its inverse is not formed."""
    return quotient(c, factor(s))


def forward(c, lower):
    """The quotient c L'^-1 by a unit lower triangular L."""
    y = np.array(c)
    for i in range(len(lower)):
        y[..., i] = y[..., i] - sum(y[..., k] * lower[i, k] for k in range(i))
    return y


@operation(same)
def quotient(c, of):
    """`divide`, from the factor of S. A vector may be a column, as in ensembles of NumPy's arrays."""
    lower, d = of
    x = forward(c.ravel() if c.shape == (len(d), 1) else c, lower)
    for i in reversed(range(len(d))):
        x[..., i] = x[..., i] / d[i] - sum(x[..., k] * lower[k, i] for k in range(i + 1, len(d)))
    return x.reshape(c.shape)


@operation(same, lambda of, measured: True)
def inverse(of, measured):
    """S^-1 from the factor of S, with zeros for missing channels."""
    result = quotient.compute(np.array(np.eye(len(measured)), dtype=of[1].dtype), of)
    return _masked(lambda i, j: measured[i] if i == j else True, result, result.shape)


def joseph(p, k, h, r):
    """(I - K H) P (I - K H)' + K R K', positive whatever the gain K; Bucy, Joseph (1968)."""
    a = eye(p) - k @ h
    value = sym(a @ p @ a.T) + sym(k @ r @ k.T)
    if isinstance(k, Matrix) and k.operation is quotient:
        c, of = k.arguments
        if c is p @ h.T and of.arguments[0] is sym(h @ p @ h.T) + r:
            return of_best_gain(value, p, c, of.arguments[0], k)
    return value


@operation(same, lambda *arguments: True)
def of_best_gain(value, p, c, s, k):
    """Joseph's form if K = P H' S^-1: then it is P - C S^-1 C' with C = P H'.

    So its derivative is dP - N - N', N = (dC - 1/2 K dS) K', and no dK is formed.
    """
    return value


# Derivatives of all these; slopes of None are zero


@mirrored.derivative
@with_transposed.derivative
@on_one_branch.derivative
def _of_linear(result, arguments, slopes):
    return through(
        lambda slope: slope if result.operation is on_one_branch else result.operation(slope), slopes[0]
    )


@congruence.derivative
def _of_congruence(result, arguments, slopes):
    """The slope M + M' + A dP A', M = dA P A'."""
    (a, _, pa), (da, dp, _) = arguments, slopes
    by_p = through(lambda slope: congruence(a, slope, slope @ a.T), dp)
    return plus(through(lambda slope: with_transposed(slope @ pa), da), by_p)


@eye.derivative
@present.derivative
def of_constant(result, arguments, slopes):
    """The slope None of a constant."""
    return None


for _masking in (only, uncorrelated):
    _masking.derivative(
        lambda result, arguments, slopes: through(lambda slope: result.operation(arguments[0], slope), slopes[1])
    )


@factor.derivative
def _of_factor(result, arguments, slopes):
    return slopes[0]  # the slope of S, which the derivatives of quotients and densities use


@quotient.derivative
def _of_quotient(result, arguments, slopes):
    of, (dc, ds) = arguments[1], slopes
    change = minus(dc, through(lambda slope: result @ slope, ds))
    return through(lambda slope: quotient(slope, of), change)


@multiply.derivative
def _of_product(result, arguments, slopes):
    (a, b), (da, db) = arguments, slopes
    return plus(through(lambda slope: _times(slope, b), da), through(lambda slope: a @ slope, db))


def _times(slope, b):
    """A slope times b. The slope of a gain times v is (dC - K dS) (S^-1 v), so that no dK is formed."""
    if slope.operation is quotient and len(b.shape) == 1:
        change, of = slope.arguments
        return change @ quotient(b, of)
    return slope @ b


@of_best_gain.derivative
def _of_best_gain(result, arguments, slopes):
    (_, _, _, _, k), (_, dp, dc, ds, _) = arguments, slopes
    half = minus(dc, through(lambda slope: (k @ slope) * 0.5, ds))
    return minus(dp, through(lambda slope: with_transposed(slope @ k.T), half))
