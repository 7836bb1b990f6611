"""Rotations, poses and directions: against matrices and scipy, steps and their Jacobians against differences."""

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.spatial.transform import Rotation as Turned

from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.programs import Place, values_of
from thruster_env.graphs.tracing import traced
from thruster_env.model import directions, poses, rotations, turns
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


ANGLES = (0.0, 1e-200, 1e-12, 1e-5, 0.0099, 0.0101, 0.0316, 0.0317, 0.5, 2.0, np.pi - 1e-6, np.pi - 1e-12)
AXIS = np.array([2.0, -3.0, 6.0]) / 7.0


def of_scipy(q):
    w, x, y, z = q
    return Turned.from_quat([x, y, z, w])


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_and_logarithm_go_round_and_are_those_of_scipy(angle):
    """Small and nearly half turns keep all digits, and -q has the logarithm of q."""
    d = angle * AXIS
    q = np.array(rotations.exponential(tuple(d)))
    np.testing.assert_allclose(np.array(rotations.matrix(q)), Turned.from_rotvec(d).as_matrix(), atol=4e-16)
    for turned in (q, -q):
        np.testing.assert_allclose(rotations.logarithm(tuple(turned)), d, rtol=1e-15, atol=1e-15)


def test_products_turn_first_by_the_second_and_vectors_go_there_and_back():
    """R(p q) = R(p) R(q); R(q)' takes a vector back."""
    p, q, v = np.random.default_rng(1).normal(size=(3, 4))
    p, q, v = rotations.normalised(p), rotations.normalised(q), v[:3]
    both = of_scipy(p) * of_scipy(q)
    np.testing.assert_allclose(rotations.matrix(rotations.product(p, q)), both.as_matrix(), atol=1e-15)
    np.testing.assert_allclose(rotations.to_world(q, v), of_scipy(q).apply(v), atol=1e-15)
    np.testing.assert_allclose(rotations.to_body(q, rotations.to_world(q, v)), v, atol=1e-15)


@pytest.mark.parametrize("angle", ANGLES)
def test_jacobians_are_those_of_differences_and_inverses_of_each_other(angle):
    """exponential(d + e) = exponential(J e) exponential(d), to the accuracy of differences."""
    d, h = angle * AXIS, 1e-6
    J = np.array(rotations.left_jacobian(d))
    inverse = rotations.inverse(rotations.exponential(d))
    columns = [
        [
            rotations.logarithm(rotations.product(rotations.exponential(d + sign * h * unit), inverse))
            for sign in (1, -1)
        ]
        for unit in np.eye(3)
    ]
    np.testing.assert_allclose(J, np.array([np.subtract(*both) / (2 * h) for both in columns]).T, atol=1e-9)
    np.testing.assert_allclose(J @ np.array(rotations.inverse_left_jacobian(d)), np.eye(3), atol=2e-15)
    np.testing.assert_allclose(rotations.matrix(rotations.exponential(d)) @ J.T, J, atol=1e-15)  # J_l = R J_r


def test_traced_functions_have_the_same_values():
    """Graphs of numbers choose between series and closed form as floats do."""
    functions = rotations.exponential, rotations.left_jacobian, rotations.inverse_left_jacobian

    def model(x):
        q = rotations.exponential(x)  # by the name of its module, too
        return *q, *rotations.logarithm(q)

    graph = Graph()
    numbers = tuple(graph.given(Place("numbers", k)) for k in range(3))
    for function in (*functions, model):
        of_numbers = np.ravel(np.array(traced(function)(numbers), dtype=object))
        points = np.array([angle * AXIS for angle in ANGLES])
        computed = values_of([graph.number(number) for number in of_numbers], points.T).T
        expected = [np.ravel(function(tuple(point))) for point in points]
        np.testing.assert_allclose(computed, expected, rtol=1e-14, atol=1e-15)
