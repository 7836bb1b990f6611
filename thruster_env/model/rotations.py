"""Rotations as unit quaternions, for the functions of a model: products, exponential, logarithm, Jacobians.

A quaternion q = (w, x, y, z) is Hamilton's (i j = k), scalar first, and turns vectors of the body into the world:
v_world = R(q) v_body. With the body rate omega, dq/dt = q (0, omega)/2, so

    q(t + dt) = product(q, exponential(omega dt)),  exact if omega is constant

q and -q are the same rotation. Vectors and quaternions are tuples of components, which may be floats, arrays, or
numbers that are traced: a model's f and h call these functions. Near 0 they are series, with exact derivatives.

Source: Sola (2017), "Quaternion kinematics for the error-state Kalman filter", arXiv 1711.02508; Jacobians: Sola,
Deray, Atchuthan (2018), "A micro Lie theory for state estimation in robotics", arXiv 1812.01537, eqs. (143)-(146).
"""

from __future__ import annotations

from typing import Any

import numpy as np

Quaternion = tuple[Any, Any, Any, Any]
Vector = tuple[Any, Any, Any]
Rows = tuple[Vector, Vector, Vector]


def product(p: Any, q: Any) -> Quaternion:
    """The rotation q, then p: R(product(p, q)) = R(p) R(q); p and q are (w, x, y, z)."""
    a, b, c, d = p
    e, f, g, h = q
    return (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )


def inverse(q: Any) -> Quaternion:
    """The inverse rotation of a unit quaternion: (w, -x, -y, -z)."""
    w, x, y, z = q
    return w, -x, -y, -z


def normalised(q: Any) -> Quaternion:
    """A quaternion with length 1: q/|q|."""
    w, x, y, z = q
    scale = 1.0 / np.sqrt(w * w + x * x + y * y + z * z)
    return w * scale, x * scale, y * scale, z * scale


def matrix(q: Any) -> Rows:
    """R(q) of a unit quaternion, three rows: v_world = R v_body."""
    w, x, y, z = q
    return (
        (1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        (2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        (2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def to_world(q: Any, v: Any) -> Vector:
    """A vector of the body in the world: R(q) v."""
    (a, b, c), (d, e, f), (g, h, i) = matrix(q)
    x, y, z = v
    return a * x + b * y + c * z, d * x + e * y + f * z, g * x + h * y + i * z


def to_body(q: Any, v: Any) -> Vector:
    """A vector of the world in the body, as a sensor that turns with it measures it: R(q)' v."""
    return to_world(inverse(q), v)


def euler(q: Any) -> Vector:
    """Roll, pitch and yaw [rad] of a rotation: yaw about z, then pitch about y, then roll about x of the body.

    At a pitch of 90 degrees roll and yaw are not determined.
    """
    (ahead, _, _), (starboard, _, _), (x, y, z) = matrix(q)
    return np.arctan2(y, z), np.arctan2(-x, np.sqrt(y * y + z * z)), np.arctan2(starboard, ahead)


def exponential(d: Any) -> Quaternion:
    """The rotation by the angle |d| [rad] about d: (cos(t/2), sin(t/2)/t d), t = |d|."""
    x, y, z = d
    square = x * x + y * y + z * z
    near = square < 1e-4
    t = np.sqrt(np.where(near, 1.0, square))
    s = np.where(near, 0.5 - square * (1.0 / 48 - square * (1.0 / 3840 - square / 645120)), np.sin(0.5 * t) / t)
    c = np.where(near, 1.0 - square * (1.0 / 8 - square * (1.0 / 384 - square / 46080)), np.cos(0.5 * t))
    return c, s * x, s * y, s * z


def logarithm(q: Any) -> Vector:
    """The rotation vector d [rad] of a unit quaternion: exponential(d) = q or -q, |d| <= pi.

    By arctan2(|v|, w), which is exact near 0 and near pi; the arc cosine of a trace is not. At pi itself, d and -d
    are the same rotation.
    """
    w, x, y, z = q
    sign = np.where(w < 0.0, -1.0, 1.0)
    w, square = w * sign, x * x + y * y + z * z
    near = square < 1e-8
    n, safe = np.sqrt(np.where(near, 1.0, square)), np.where(near, w, 1.0)
    ratio = square / (safe * safe)
    series = 2.0 / safe * (1.0 - ratio * (1.0 / 3 - 0.2 * ratio))
    factor = sign * np.where(near, series, 2.0 * np.arctan2(n, w) / n)
    return factor * x, factor * y, factor * z


def left_jacobian(d: Any) -> Rows:
    """J_l(d), three rows: exponential(d + e) = exponential(J_l(d) e) exponential(d) for small e.

        J_l = I + (1 - cos t)/t^2 [d]x + (t - sin t)/t^3 [d]x^2,  t = |d|

    J_r(d) = J_l(-d) = J_l(d)' is that of the other side: exponential(d) exponential(J_r(d) e).
    """
    square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    near = square < 1e-3
    t2 = np.where(near, 1.0, square)
    t = np.sqrt(t2)
    half = np.sin(0.5 * t)
    series = 0.5 - square * (1.0 / 24 - square * (1.0 / 720 - square / 40320))
    by_skew = np.where(near, series, 2.0 * half * half / t2)
    series = 1.0 / 6 - square * (1.0 / 120 - square * (1.0 / 5040 - square / 362880))
    by_square = np.where(near, series, (t - np.sin(t)) / (t2 * t))
    return _polynomial_of_skew(d, by_skew, by_square)


def inverse_left_jacobian(d: Any) -> Rows:
    """The inverse of J_l(d), three rows: I - [d]x/2 + (1/t^2 - cot(t/2)/(2 t)) [d]x^2, t = |d| < 2 pi."""
    square = d[0] * d[0] + d[1] * d[1] + d[2] * d[2]
    near = square < 1e-3
    t2 = np.where(near, 1.0, square)
    t = np.sqrt(t2)
    series = 1.0 / 12 + square * (1.0 / 720 + square * (1.0 / 30240 + square / 1209600))
    by_square = np.where(near, series, 1.0 / t2 - np.cos(0.5 * t) / (2.0 * t * np.sin(0.5 * t)))
    return _polynomial_of_skew(d, -0.5, by_square)


def _polynomial_of_skew(d: Any, by_skew: Any, by_square: Any) -> Rows:
    """The matrix I + a [d]x + b [d]x^2, where [d]x e is the cross product of d and e."""
    x, y, z = d
    xx, yy, zz = by_square * x * x, by_square * y * y, by_square * z * z
    xy, xz, yz = by_square * x * y, by_square * x * z, by_square * y * z
    x, y, z = by_skew * x, by_skew * y, by_skew * z
    return (1.0 - yy - zz, xy - z, xz + y), (xy + z, 1.0 - xx - zz, yz - x), (xz - y, yz + x, 1.0 - xx - yy)
