"""Poses and directions: groups against matrices and scipy, steps and their Jacobians against differences."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation as Turned

from thruster_env.model import directions, poses, turns
from thruster_env.model.quantities import Quantity
from thruster_env.model.turns import Direction, ExtendedPose, Pose, Rotation

RNG = np.random.default_rng(3)
G, DT = (0.1, -0.2, -9.81), 0.1


def matrix_of(x):
    """[[R, r_1, r_2], [0, I]]."""
    k = (len(x) - 4) // 3
    result = np.eye(3 + k)
    result[:3, :3] = Turned.from_quat(np.array(x[:4]), scalar_first=True).as_matrix()
    result[:3, 3:] = np.reshape(x[4:], (k, 3)).T
    return result


def algebra_of(d):
    """[[[phi]x, nu_1, nu_2], [0, 0]], whose matrix exponential is the pose."""
    k = len(d) // 3 - 1
    result = np.zeros((3 + k, 3 + k))
    result[:3, :3] = poses.skew(d[:3])
    result[:3, 3:] = np.reshape(d[3:], (k, 3)).T
    return result


@pytest.mark.parametrize("t", [3, 6, 9])
@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 0.03, 0.4999, 0.5001, 2.0, 3.1])
def test_the_group_is_that_of_matrices(t, angle):
    """Products, exponential and logarithm, and the Jacobian, a series in ad(d) = [d, .]."""
    d, e = RNG.normal(size=t), RNG.normal(size=t)
    d[:3] *= angle / np.linalg.norm(d[:3])
    x, y = poses.exponential(d), poses.exponential(e)
    np.testing.assert_allclose(matrix_of(x), expm(algebra_of(d)), atol=2e-14)
    np.testing.assert_allclose(matrix_of(poses.product(x, y)), matrix_of(x) @ matrix_of(y), atol=1e-14)
    np.testing.assert_allclose(
        matrix_of(poses.product(x, poses.inverse(x))), np.eye(len(matrix_of(x))), atol=1e-14
    )
    np.testing.assert_allclose(poses.logarithm(x), d, atol=2e-14)
    ad = np.zeros((t, t))
    for i in range(t):
        A, B = algebra_of(d), algebra_of(np.eye(t)[i])
        C = A @ B - B @ A
        ad[:, i] = np.concatenate([[C[2, 1], C[0, 2], C[1, 0]], C[:3, 3:].T.ravel()])
    J, term = np.eye(t), np.eye(t)
    for k in range(1, 60):
        term = term @ ad / (k + 1)
        J = J + term
    np.testing.assert_allclose(poses.left_jacobian(d), J, atol=1e-13)
    np.testing.assert_allclose(np.array(poses.inverse_left_jacobian(d)) @ J, np.eye(t), atol=2e-13)


def parts(side):
    """A state with every part between numbers."""
    states = "a", ExtendedPose("craft", side=side), Direction("field"), "b", Pose("camera", "r", side, "c")
    return turns.with_rotations((*states, Rotation("mount", "m", side)))


def state_of(rng):
    """Its 26 stored numbers."""
    unit = lambda k: (lambda v: v / np.linalg.norm(v))(rng.normal(size=k))  # noqa: E731
    craft = rng.normal(), *unit(4), *rng.normal(size=6), *unit(3)
    return np.array([*craft, rng.normal(), *unit(4), *rng.normal(size=3), *unit(4)])


def slopes(function, size, step=1e-6):
    """Central differences at 0."""
    return np.array([(function(e) - function(-e)) / (2 * step) for e in step * np.eye(size)]).T


@pytest.mark.parametrize("side", ["body", "world"])
def test_steps_and_their_jacobians(side):
    """Round trips of every part, slopes by differences; small angles are series, and the sphere has two charts."""
    quantities, known = parts(side)
    n, t = len(quantities), len(quantities) - len(known)
    assert [q.symbol if isinstance(q, Quantity) else q for q in quantities[:8]] == [
        *("a", "q_w", "q_x", "q_y", "q_z", "v_x", "v_y", "v_z")
    ]
    for size in (1e-9, 0.07, 0.11, 1.5):
        x, d = state_of(RNG), RNG.normal(size=t)
        d *= size / np.linalg.norm(d)
        if size == 0.11:
            x[11:14] = 0.6 * 0.3, 0.8 * 0.3, -np.sqrt(0.91)  # in the mirrored chart
        y = np.array(turns.move(x, d, known))
        np.testing.assert_allclose(turns.difference(y, x, known), d, atol=1e-14)
        np.testing.assert_allclose(turns.unit(y, known), y, atol=1e-15)
        numeric = slopes(lambda e: np.array(turns.move(x, e, known)), t)  # noqa: B023
        np.testing.assert_allclose(turns.slopes_of_stored(x, known), numeric, atol=1e-9)
        scaled = x.copy()
        scaled[1:5], scaled[11:14] = 1.3 * scaled[1:5], 0.7 * scaled[11:14]
        to_unit = lambda e: np.array(turns.difference(turns.unit(scaled + e, known), x, known))  # noqa: B023, E731
        np.testing.assert_allclose(turns.slopes_of_tangent(scaled, known), slopes(to_unit, n), atol=1e-8)
        step = lambda e: np.array(turns.difference(turns.move(x, d + e, known), y, known))  # noqa: B023, E731
        reset = np.array(turns.reset_slopes(x, d, known))
        np.testing.assert_allclose(reset, slopes(step, t), atol=1e-8)
        np.testing.assert_allclose(turns.inverse_reset_slopes(x, d, known) @ reset, np.eye(t), atol=1e-13)


def test_strapdown_is_the_integral_of_the_motion():
    """Against four thousand midpoint steps, and at rest."""
    x = np.array([*poses.exponential(RNG.normal(size=9))])
    rate, force, n = np.array([0.3, -1.2, 0.8]), np.array([1.0, -2.0, 9.0]), 4000
    q, v, p = Turned.from_quat(x[:4], scalar_first=True), x[4:7].copy(), x[7:].copy()
    middles = q * Turned.from_rotvec(((np.arange(n) + 0.5) * DT / n)[:, None] * rate)
    for a in middles.apply(force) + G:
        p += v * DT / n + 0.5 * a * (DT / n) ** 2
        v += a * DT / n
    after = poses.strapdown(x, rate, force, G, DT)
    np.testing.assert_allclose(after[4:], [*v, *p], atol=1e-9)
    turned = Turned.from_quat(np.array(after[:4]), scalar_first=True)
    assert (turned.inv() * q * Turned.from_rotvec(rate * DT)).magnitude() < 2e-15
    rest = poses.strapdown((1.0, *np.zeros(9)), (0.0, 0.0, 0.0), (0.0, 0.0, 9.81), (0.0, 0.0, -9.81), 1.0)
    np.testing.assert_array_equal(rest, (1.0, *np.zeros(9)))


def test_the_error_of_an_extended_pose_is_linear():
    """Whatever its size: F of the invariant filter, without the state and the input, carries it exactly."""
    _, known = turns.with_rotations((ExtendedPose("craft", side="world"),))
    g = np.array(poses.skew(G))
    F = np.eye(9)
    F[3:6, :3], F[6:, :3], F[6:, 3:6] = g * DT, 0.5 * g * DT**2, np.eye(3) * DT
    rate, force = RNG.normal(size=3), 10.0 * RNG.normal(size=3)
    x = np.array(poses.exponential(RNG.normal(size=9)))
    error = np.array([0.5, -0.6, 0.4, 3.0, 1.0, -2.0, 5.0, 4.0, -1.0])
    a, b = (poses.strapdown(start, rate, force, G, DT) for start in (turns.move(x, error, known), x))
    np.testing.assert_allclose(turns.difference(a, b, known), F @ error, atol=1e-12)


def test_opposite_directions_have_no_shortest_way():
    """NaN, and not a wrong number; an angle near pi is exact."""
    u = (0.0, 0.6, 0.8)
    with np.errstate(all="ignore"):
        assert np.isnan(directions.difference((0.0, -0.6, -0.8), u)).all()
    for angle in (3.1415, 1e-5, 0.99e-4, 1.01e-4):
        d = angle * 0.6, angle * 0.8
        np.testing.assert_allclose(directions.difference(directions.move(u, d), u), d, atol=1e-14)
