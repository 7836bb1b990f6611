"""Directions as unit vectors, for the functions of a model: steps on the sphere.

An error d of a direction u has two components [rad], along the orthonormal tangents B(u):

    move(u, d) = cos|d| u + sin|d|/|d| B(u) d,    difference(v, u) = B(u)' v a/sin(a),  a the angle between both

No basis is continuous on the whole sphere: that of (0, 0, 1) serves above z = -0.9, its mirror image below.
Vectors are tuples of components, which may be floats, arrays, or numbers that are traced.

Source: Hertzberg, Wagner, Frese, Schroeder (2013), "Integrating generic sensor fusion algorithms with sound state
representations through encapsulation of manifolds", Information Fusion 14(1), for the two steps.
"""

from __future__ import annotations

from typing import Any

import numpy as np

SMALL = 1e-2  # rad^2: functions of angles with a smaller square are series
MIRRORED = -0.9  # z below which the basis is the mirror image

Vector = tuple[Any, Any, Any]


def length(u: Any) -> Any:
    """The length of a vector."""
    return np.sqrt(u[0] * u[0] + u[1] * u[1] + u[2] * u[2])


def unit(u: Any) -> Vector:
    """A vector with length 1: u/|u|."""
    scale = 1.0 / length(u)
    return u[0] * scale, u[1] * scale, u[2] * scale


def basis(u: Any) -> tuple[tuple[Any, Any], ...]:
    """B(u), three rows of two: orthonormal tangents of the sphere at u.

        B = [[1 - c x^2, -c x y], [-c x y, 1 - c y^2], [-s x, -s y]],  c = 1/(1 + s z),  s = 1, or -1 if z < -0.9

    The mirrored basis is left-handed.
    """
    x, y, z = u
    s = np.where(z < MIRRORED, -1.0, 1.0)
    c = 1.0 / (1.0 + s * z)
    return (1.0 - c * x * x, -c * x * y), (-c * x * y, 1.0 - c * y * y), (-s * x, -s * y)


def move(u: Any, d: Any) -> Vector:
    """The direction u turned by d = (d_1, d_2) [rad] of its tangent; d and -d + 2 pi d/|d| reach the same one."""
    cosine, ratio, _ = _circular(d)
    x, y, z = (cosine * u[i] + ratio * (row[0] * d[0] + row[1] * d[1]) for i, row in enumerate(basis(u)))
    return unit((x, y, z))


def difference(v: Any, u: Any) -> tuple[Any, Any]:
    """The d [rad] with move(u, d) = v, |d| < pi; NaN for opposite directions, which have no shortest way."""
    B = basis(u)
    p, q = (B[0][j] * v[0] + B[1][j] * v[1] + B[2][j] * v[2] for j in range(2))
    cosine, square = u[0] * v[0] + u[1] * v[1] + u[2] * v[2], p * p + q * q
    near = np.where(cosine > 0.0, square, 1.0) < 1e-8
    n, safe = np.sqrt(np.where(near, 1.0, square)), np.where(near, cosine, 1.0)
    ratio = square / (safe * safe)
    factor = np.where(near, (1.0 - ratio * (1.0 / 3 - 0.2 * ratio)) / safe, np.arctan2(n, cosine) / n)
    return factor * p, factor * q


def reset(u: Any, d: Any) -> list[list]:
    """G = d difference(move(u, d + e), move(u, d))/de at e = 0, (2, 2): B(u')' du'/dd with u' = move(u, d)."""
    _, ratio, change = _circular(d)
    B, after = basis(u), basis(move(u, d))
    way = [row[0] * d[0] + row[1] * d[1] for row in B]
    slopes = [[(change * way[i] - ratio * u[i]) * d[j] + ratio * B[i][j] for j in range(2)] for i in range(3)]
    return [[sum(after[i][k] * slopes[i][j] for i in range(3)) for j in range(2)] for k in range(2)]


def inverse(G: Any) -> list[list]:
    """The inverse of `reset`, by Cramer's rule: its determinant is sin|d|/|d| or its negative."""
    (a, b), (c, d) = G
    scale = 1.0 / (a * d - b * c)
    return [[d * scale, -b * scale], [-c * scale, a * scale]]


def _circular(d: Any) -> tuple[Any, Any, Any]:
    """Of t = |d|: cos t, sin t/t and (cos t - sin t/t)/t^2."""
    square = d[0] * d[0] + d[1] * d[1]
    near = square < SMALL
    t = np.sqrt(np.where(near, 1.0, square))
    cosine, ratio = np.cos(t), np.sin(t) / t
    s = square
    return (
        np.where(near, 1.0 - s / 2 * (1.0 - s / 12 * (1.0 - s / 30 * (1.0 - s / 56 * (1.0 - s / 90)))), cosine),
        np.where(near, 1.0 - s / 6 * (1.0 - s / 20 * (1.0 - s / 42 * (1.0 - s / 72))), ratio),
        np.where(
            near,
            -(1 / 3 - s * (1 / 30 - s * (1 / 840 - s * (1 / 45360 - s / 3991680)))),
            (cosine - ratio) / (t * t),
        ),
    )
