"""Poses and extended poses, groups of a rotation with vectors of the world: products, exponential, Jacobians.

A pose is a unit quaternion and a position, (q, p) in seven numbers, an extended pose has the velocity before the
position, (q, v, p) in ten. Both are SE_k(3), a rotation with k vectors r_i of the world; k = 0 is a rotation:

    product:      (q, r)(s, e) = (q s, R(q) e + r)
    exponential:  d = (phi, nu), exp(d) = (exp(phi), J_l(phi) nu),  phi [rad] of the rotation

`strapdown` advances an extended pose by a gyroscope and an accelerometer. Poses are tuples of components: floats,
arrays, or numbers that are traced, as in `rotations`.

Source: Barrau, Bonnabel (2017), "The invariant extended Kalman filter as a stable observer", IEEE Trans. Automatic
Control 62(4); Barfoot, Furgale (2014), "Associating uncertainty with three-dimensional poses for use in estimation
problems", IEEE Trans. Robotics 30(3), for Q below.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from thruster_env.model import rotations

Pose = tuple[Any, ...]
Rows = list[list[Any]]
SMALL = 0.25  # rad^2: the coefficients of angles with a smaller square are series


def product(a: Any, b: Any) -> Pose:
    """The pose b, then a: (q, r)(s, e) = (q s, R(q) e + r)."""
    turned = (rotations.to_world(a[:4], vector) for vector in vectors(b))
    moved_by = (x + y for new, old in zip(turned, vectors(a), strict=True) for x, y in zip(new, old, strict=True))
    return *rotations.product(a[:4], b[:4]), *moved_by


def inverse(a: Any) -> Pose:
    """The inverse pose: (q^-1, -R(q)' r)."""
    back = (rotations.to_body(a[:4], vector) for vector in vectors(a))
    return *rotations.inverse(a[:4]), *(-x for vector in back for x in vector)


def exponential(d: Any) -> Pose:
    """The pose of a tangent d = (phi, nu_1, ...): (exp(phi), J_l(phi) nu_1, ...)."""
    J = rotations.left_jacobian(d[:3]) if len(d) > 3 else ()
    return *rotations.exponential(d[:3]), *_by_matrix(J, d[3:])


def logarithm(a: Any) -> tuple:
    """The tangent d = (phi, nu_1, ...) of a pose, exponential(d) = a: phi = log(q), nu = J_l(phi)^-1 r."""
    phi = rotations.logarithm(a[:4])
    return *phi, *_by_matrix(rotations.inverse_left_jacobian(phi) if len(a) > 4 else (), a[4:])


def vectors(a: Any) -> list:
    """The vectors of a pose, three components each."""
    return [a[i : i + 3] for i in range(4, len(a), 3)]


def _by_matrix(rows: Any, components: Any) -> list:
    """A matrix (3, 3) times each vector of the components."""
    starts = range(0, len(components), 3)
    return [sum(row[j] * components[at + j] for j in range(3)) for at in starts for row in rows]


def left_jacobian(d: Any) -> Rows:
    """J_l(d), (t, t): exponential(d + e) = exponential(J_l(d) e) exponential(d) for small e.

        J_l = [[J, 0], [Q_i, J]] with J = J_l(phi) of the rotation,  Q_i = d(J nu_i)/dphi + [J nu_i]x J

    J_r(d) = J_l(-d) is that of the other side: exponential(d) exponential(J_r(d) e).
    """
    J = [list(row) for row in rotations.left_jacobian(d[:3])]
    return _triangle(J, [_coupling(d[:3], d[i : i + 3], J) for i in range(3, len(d), 3)])


def inverse_left_jacobian(d: Any) -> Rows:
    """The inverse of J_l(d), (t, t): [[J^-1, 0], [-J^-1 Q_i J^-1, J^-1]]."""
    J, back = rotations.left_jacobian(d[:3]), [list(row) for row in rotations.inverse_left_jacobian(d[:3])]
    couplings = (_coupling(d[:3], d[i : i + 3], J) for i in range(3, len(d), 3))
    return _triangle(back, [_product(_product(back, [[-x for x in row] for row in Q]), back) for Q in couplings])


def _triangle(on_diagonal: Rows, first_blocks: list[Rows]) -> Rows:
    """A block matrix with the same block on its diagonal and others in its first column."""
    t = 3 * (len(first_blocks) + 1)
    result = [[0.0] * t for _ in range(t)]
    for k in range(len(first_blocks) + 1):
        for i in range(3):
            if k:
                result[3 * k + i][:3] = first_blocks[k - 1][i]
            result[3 * k + i][3 * k : 3 * k + 3] = on_diagonal[i]
    return result


def _product(a: Any, b: Any) -> Rows:
    return [[sum(a[i][k] * b[k][j] for k in range(3)) for j in range(3)] for i in range(3)]


def skew(v: Any) -> Rows:
    """[v]x, with [v]x e the cross product of v and e."""
    x, y, z = v
    return [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]


def cross(a: Any, b: Any) -> tuple:
    """The cross product of two vectors."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def bracket(a: Any, b: Any) -> list:
    """The Lie bracket of two tangents: (phi x psi, phi x nu_b - psi x nu_a, ...)."""
    result = [*cross(a[:3], b[:3])]
    for i in range(3, len(a), 3):
        result += [x - y for x, y in zip(cross(a[:3], b[i : i + 3]), cross(b[:3], a[i : i + 3]), strict=True)]
    return result


def _coupling(phi: Any, nu: Any, J: Any) -> Rows:
    """Q of `left_jacobian`, from J nu = nu + b phi x nu + c phi x (phi x nu), b and c functions of |phi|^2."""
    b, c, of_b, of_c = _coefficients(phi)
    once = cross(phi, nu)
    twice = cross(phi, once)
    outer, of_nu, of_once = _product(skew(phi), skew(nu)), skew(nu), skew(once)
    by_J = _product(skew(_by_matrix(J, nu)), J)
    changes = [of_b * once[i] + of_c * twice[i] for i in range(3)]
    return [
        [
            2.0 * changes[i] * phi[j] - b * of_nu[i][j] - c * (of_once[i][j] + outer[i][j]) + by_J[i][j]
            for j in range(3)
        ]
        for i in range(3)
    ]


def _coefficients(phi: Any) -> tuple:
    """(1 - cos t)/t^2 and (t - sin t)/t^3, and their derivatives by t^2, where t = |phi|."""
    square, near, t = _square(phi)
    s, c = np.sin(t), np.cos(t)
    t2 = t * t
    half = np.sin(0.5 * t)
    closed = (
        2.0 * half * half / t2,
        (t - s) / (t2 * t),
        (0.5 * t * s - 2.0 * half * half) / (t2 * t2),
        (0.5 * t * (1.0 - c) - 1.5 * (t - s)) / (t2 * t2 * t),
    )
    terms = (1 / 2, 1 / 24, 1 / 720, 1 / 40320, 1 / 3628800, 1 / 479001600, 1 / 87178291200)
    more = (1 / 6, 1 / 120, 1 / 5040, 1 / 362880, 1 / 39916800, 1 / 6227020800, 1 / 1307674368000)
    series = (terms, more, *([-k * x for k, x in enumerate(of) if k] for of in (terms, more)))
    return tuple(np.where(near, _alternating(of, square), value) for of, value in zip(series, closed, strict=True))


def _square(phi: Any) -> tuple:
    """The square of |phi|, whether it is small, and |phi| if it is not, else 1."""
    square = phi[0] * phi[0] + phi[1] * phi[1] + phi[2] * phi[2]
    near = square < SMALL
    return square, near, np.sqrt(np.where(near, 1.0, square))


def _alternating(terms: Any, s: Any) -> Any:
    """The series terms[0] - s (terms[1] - s (...))."""
    value = terms[-1]
    for term in terms[-2::-1]:
        value = term - s * value
    return value


def strapdown(x: Any, rate: Any, force: Any, gravity: Any, dt: Any) -> Pose:
    """An extended pose (q, v, p) after dt [s], exact for a constant body rate and specific force.

        q exp(f),  v + g dt + R(q) J_l(f) a dt,  p + v dt + g dt^2/2 + R(q) N(f) a dt^2,  f = omega dt
        N(f) = I/2 + (t - sin t)/t^3 [f]x + (t^2/2 + cos t - 1)/t^4 [f]x^2,  t = |f|

    The error of such a state in the group of extended poses propagates linearly, with an F that depends on neither
    state nor input for an error of the world (the invariant extended Kalman filter).

    Args:
        x: (q, v, p), ten components; v [m/s] and p [m] of the world.
        rate: of the body, omega [rad/s], as a gyroscope measures it.
        force: specific force a [m/s^2] of the body, as an accelerometer measures it: +9.81 upwards at rest.
        gravity: g of the world [m/s^2], such as (0, 0, -9.81).
        dt: sample time [s].

    Returns:
        ten components.

    Source: Barrau, Bonnabel (2017).
    """
    q, v, p = x[:4], x[4:7], x[7:10]
    f = tuple(w * dt for w in rate)
    _, by_skew, *_ = _coefficients(f)
    square, near, t = _square(f)
    terms = (1 / 24, 1 / 720, 1 / 40320, 1 / 3628800, 1 / 479001600, 1 / 87178291200)
    by_square = np.where(
        near, _alternating(terms, square), (0.5 * t * t - 2.0 * np.sin(0.5 * t) ** 2) / (t * t * t * t)
    )
    once = cross(f, force)
    twice = cross(f, once)
    by_position = tuple(0.5 * a + by_skew * b + by_square * c for a, b, c in zip(force, once, twice, strict=True))
    gain = rotations.to_world(q, _by_matrix(rotations.left_jacobian(f), force))
    way = rotations.to_world(q, by_position)
    return (
        *rotations.product(q, rotations.exponential(f)),
        *(v[i] + (gravity[i] + gain[i]) * dt for i in range(3)),
        *(p[i] + (v[i] + (0.5 * gravity[i] + way[i]) * dt) * dt for i in range(3)),
    )
