"""Rotations: against scipy, closed forms and differences, near 0 and near pi, as floats and traced."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from thruster_env.graphs.graphs import Graph
from thruster_env.graphs.programs import Place, values_of
from thruster_env.graphs.tracing import traced
from thruster_env.model import rotations

ANGLES = (0.0, 1e-200, 1e-12, 1e-5, 0.0099, 0.0101, 0.0316, 0.0317, 0.5, 2.0, np.pi - 1e-6, np.pi - 1e-12)
AXIS = np.array([2.0, -3.0, 6.0]) / 7.0


def of_scipy(q):
    w, x, y, z = q
    return Rotation.from_quat([x, y, z, w])


@pytest.mark.parametrize("angle", ANGLES)
def test_exponential_and_logarithm_go_round_and_are_those_of_scipy(angle):
    """Small and nearly half turns keep all digits, and -q has the logarithm of q."""
    d = angle * AXIS
    q = np.array(rotations.exponential(tuple(d)))
    np.testing.assert_allclose(np.array(rotations.matrix(q)), Rotation.from_rotvec(d).as_matrix(), atol=4e-16)
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
