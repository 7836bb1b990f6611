"""Rotations, extended poses and a filter's step against gtsam 4.3.0, whose numbers are in tests/data."""

import json
from pathlib import Path

import numpy as np
import pytest

import filters
from thruster_env.model import poses, rotations
from thruster_env.model.turns import Rotation

GTSAM = json.loads((Path(__file__).parents[1] / "data" / "gtsam_rotations.json").read_text())
NORTH, Q, R = (0.5, 0.1, -0.86), 1e-3, 0.02  # as gtsam_rotations.py has them


def of_matrix(rows):
    """The quaternion of a rotation matrix, by the largest of its components (Shepperd 1978)."""
    C = np.asarray(rows)
    trace = np.trace(C)
    squares = np.array([trace, *(2.0 * np.diag(C) - trace)])
    i = int(np.argmax(squares))
    skew = np.array([C[2, 1] - C[1, 2], C[0, 2] - C[2, 0], C[1, 0] - C[0, 1]])
    q = np.array([1.0 + trace, *skew]) if i == 0 else np.array([skew[i - 1], *(C + C.T)[i - 1]])
    q[i] = 1.0 + squares[i]
    return q / np.linalg.norm(q)


@pytest.mark.parametrize("case", GTSAM["rotations"])
def test_rotations(case):
    d, C, back, right, inverse = map(np.array, case)
    np.testing.assert_allclose(rotations.matrix(rotations.exponential(d)), C, atol=1e-15)
    np.testing.assert_allclose(rotations.logarithm(rotations.exponential(d)), back, atol=1e-14)
    np.testing.assert_allclose(rotations.logarithm(of_matrix(C)), d, atol=1e-12)
    np.testing.assert_allclose(rotations.left_jacobian(-d), right, atol=1e-12)
    np.testing.assert_allclose(rotations.inverse_left_jacobian(-d), inverse, atol=1e-12)


@pytest.mark.parametrize("case", GTSAM["poses"])
def test_extended_poses(case):
    first, second, C, velocity, position, product = map(np.array, case)
    pose = poses.exponential(first)
    np.testing.assert_allclose(rotations.matrix(pose[:4]), C, atol=1e-14)
    np.testing.assert_allclose(pose[4:], [*velocity, *position], atol=1e-12)
    np.testing.assert_allclose(
        poses.logarithm(poses.product(pose, poses.exponential(second))), product, atol=1e-12
    )


def turned(x, u, c):
    return rotations.product(x, rotations.exponential(u))


def north(x, c):
    return rotations.to_body(x, NORTH)


@pytest.mark.parametrize("case", GTSAM["steps"])
def test_a_step_of_the_filter(case):
    """Predicted and updated state and covariance; gtsam leaves out the reset of errors in the world's axes."""
    C, P, d, z, C_after, P_after = map(np.array, case)
    model = filters.StateSpaceModel(
        transition=turned,
        observe=north,
        states=(Rotation("attitude", "q", "world"),),
        inputs=3,
        prior_mean=of_matrix(C),
        prior_cov=C @ P @ C.T,
        process_noise_cov=[Q] * 3,
        measurement_noise_cov=[R] * 3,
    )
    session = filters.make_filter("ekf", model).session()
    session.start()
    session.predict(d)
    predicted = of_matrix(C @ rotations.matrix(rotations.exponential(d)))
    np.testing.assert_allclose(rotations.matrix(session.mean), rotations.matrix(predicted), atol=1e-13)
    session.update(z)
    np.testing.assert_allclose(rotations.matrix(session.mean), C_after, atol=1e-12)
    correction = rotations.logarithm(rotations.product(session.mean, rotations.inverse(predicted)))
    back = np.array(rotations.inverse_left_jacobian(correction))
    np.testing.assert_allclose(back @ session.cov @ back.T, C_after @ P_after @ C_after.T, atol=1e-12)
