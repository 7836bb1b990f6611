"""Poses, directions and rotations: the invariant filter, sides, naive slopes, gtsam 4.3.0's numbers."""

import json
from pathlib import Path

import numpy as np
import pytest

import filters
from tests.filters.attitudes import ran
from tests.oracles import each_close
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted
from thruster_env.model import directions, poses, rotations, turns
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import Direction, ExtendedPose, Pose, Rotation

DT, GRAVITY = 0.1, (0.0, 0.0, -9.81)


def fly(x, u, c):
    """An IMU advances the extended pose."""
    return poses.strapdown(x, u[:3], u[3:], GRAVITY, DT)


def position(x, c):
    """A receiver of positions, and the magnetic field in the axes of the body."""
    return *x[7:], *rotations.to_body(x[:4], (0.0, 0.6, -0.8))


def navigation(side):
    return StateSpaceModel(
        transition=fly,
        observe=position,
        process_noise_cov=[1e-6] * 3 + [1e-4] * 3 + [1e-6] * 3,
        measurement_noise_cov=[0.04] * 3 + [0.01] * 3,
        prior_mean=[1.0, *[0.0] * 9],
        prior_cov=[0.05] * 3 + [0.2] * 3 + [1.0] * 3,
        states=(ExtendedPose("craft", side=side),),
        inputs=6,
    )


def flown(runs, steps):
    """True extended poses (runs, steps + 1, 10) about the prior, inputs and measurements."""
    draw = np.random.default_rng(2).normal
    known, start = navigation("world").turns, np.zeros((runs, 10))
    start[:, 0] = 1.0
    error = draw(size=(9, runs)) * np.sqrt([0.05] * 3 + [0.2] * 3 + [1.0] * 3)[:, None]
    x = np.array(turns.move(start.T, error, known))
    truth, u = [x], []
    for k in range(steps):
        rate, force = np.sin(0.2 * k + np.arange(3)), np.array([1.0, np.cos(0.3 * k), 9.81])
        u.append(np.tile([*rate, *force], (runs, 1)))
        noise = draw(size=(9, runs)) * np.sqrt([1e-6] * 3 + [1e-4] * 3 + [1e-6] * 3)[:, None]
        x = np.array(turns.move(fly(x, u[-1].T, ()), noise, known))
        truth.append(x)
    z = [
        np.array(position(x, ())) + draw(size=(6, runs)) * np.sqrt([0.04] * 3 + [0.01] * 3)[:, None] for x in truth
    ]
    return np.moveaxis(truth, 2, 0), np.moveaxis(u, 0, 1), np.moveaxis(z, 2, 0)


@pytest.fixture(scope="module")
def data():
    return flown(16, 30)


def nees(model, truth, estimates):
    """Squares of the errors in units of P, (runs, steps)."""
    errors = np.moveaxis(
        turns.difference(np.moveaxis(truth, 2, 0), np.moveaxis(estimates.means, 2, 0), model.turns), 0, -1
    )
    return np.einsum("bki,bki->bk", errors, np.linalg.solve(estimates.covs, errors[..., None])[..., 0])


def test_the_extended_filter_of_an_extended_pose_is_the_invariant_one(data):
    """Its F does not depend on the state and the input: covariances of all runs without updates are the same."""
    model = navigation("world")
    F, g = np.eye(9), np.array(poses.skew(GRAVITY))
    F[3:6, :3], F[6:, :3], F[6:, 3:6] = g * DT, 0.5 * g * DT**2, np.eye(3) * DT
    filter_ = filters.ExtendedKalmanFilter(model=model)
    P, belief = model.prior_cov, filter_.init()
    truth, u, _ = data
    for k in range(3):
        belief = filter_.predict(belief._replace(mean=truth[k, k]), u[k, k])
        P = F @ P @ F.T + model.process_noise_cov
        np.testing.assert_allclose(belief.cov, P, atol=1e-12)


def test_estimates_of_extended_poses_do_not_depend_on_the_side_of_the_error(data):
    """With the exact reset, and without process noise, whose axes are of the side; errors are consistent."""
    truth, u, z = data
    world, body = navigation("world"), navigation("body")
    estimates = ran(world, u, z)
    assert 6.4 < nees(world, truth, estimates)[:, 5:].mean() < 12.0
    of_sides = [ran(model.replace(process_noise_cov=np.zeros(9)), u, z) for model in (world, body)]
    np.testing.assert_allclose(of_sides[1].means, of_sides[0].means, atol=1e-10)
    np.testing.assert_allclose(of_sides[1].log_likelihoods, of_sides[0].log_likelihoods, atol=1e-8)


def turning(x, u, c):
    """A camera moves and turns; the field of the world wanders."""
    return *poses.product(x[:7], poses.exponential(u)), *x[7:]


def marks(x, c):
    """A mark of the world in the camera's axes, and the field."""
    return *poses.product(poses.inverse(x[:7]), (1.0, 0.0, 0.0, 0.0, 2.0, 1.0, 3.0))[4:], *rotations.to_body(
        x[:4], x[7:]
    )


def camera(side="body"):
    start = directions.unit((0.2, 0.3, -1.0))
    return StateSpaceModel(
        transition=turning,
        observe=marks,
        process_noise_cov=[1e-4] * 6 + [1e-5] * 2,
        measurement_noise_cov=[0.01] * 6,
        prior_mean=[1.0, *[0.0] * 6, *start],
        prior_cov=[0.02] * 3 + [0.3] * 3 + [0.05] * 2,
        states=(Pose("camera", side=side), Direction("field")),
        inputs=6,
    )


@pytest.mark.parametrize("name", slow_but(["ekf", "iekf", "ukf", "fading"], ["ekf"]))
def test_filters_of_poses_and_directions(name):
    """A step of each equals that in Python, and the naive linear one with slopes by differences (ekf)."""
    model, rng = camera(), np.random.default_rng(4)
    u, z = 0.1 * rng.normal(size=(2, 6)), rng.normal(size=(3, 6)) * 0.1 + np.array(marks(model.prior_mean, ()))
    filter_ = filters.make_filter(name, model)
    estimates = filters.run(filter_, inputs=u, measurements=z)
    with interpreted():
        np.testing.assert_allclose(
            filters.run(filter_, inputs=u, measurements=z).means, estimates.means, atol=1e-13
        )
    np.testing.assert_allclose(np.linalg.norm(estimates.means[:, 7:], axis=1), 1.0, atol=4e-16)
    if name != "ekf":
        return
    x, P, known = model.prior_mean, model.prior_cov, model.turns

    def slopes(of):
        return np.array([(np.array(of(e)) - np.array(of(-e))) / 2e-6 for e in 1e-6 * np.eye(8)]).T

    for k in range(3):
        if k:
            after = turning(x, u[k - 1], ())
            F = slopes(lambda d: turns.difference(turning(turns.move(x, d, known), u[k - 1], ()), after, known))  # noqa: B023
            x, P = np.array(after), F @ P @ F.T + model.process_noise_cov
        H = slopes(lambda d: marks(turns.move(x, d, known), ()))  # noqa: B023
        S = H @ P @ H.T + model.measurement_noise_cov
        K = np.linalg.solve(S, H @ P).T
        d = K @ (z[k] - marks(x, ()))
        after = turns.move(x, d, known)
        G = slopes(lambda e: turns.difference(turns.move(x, d + e, known), after, known))  # noqa: B023
        x, P = np.array(after), G @ (P - K @ S @ K.T) @ G.T
        each_close((estimates.means[k], estimates.covs[k]), (x, P), atol=1e-8)


def test_what_is_no_direction_or_pose_is_refused():
    with pytest.raises(ValueError, match="'field' must be .x, y, z. of length 1"):
        camera().replace(prior_mean=[1.0, *[0.0] * 6, 0.0, 0.0, 2.0])
    with pytest.raises(ValueError, match="'camera' must begin with a quaternion"):
        camera().replace(prior_mean=[2.0, *[0.0] * 6, 0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="'camera' and 'field' are of poses and directions: filters.run"):
        filters.AuxiliaryParticleFilter(model=camera()).kernels()


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
    each_close((rotations.logarithm(of_matrix(C)), rotations.left_jacobian(-d)), (d, right), atol=1e-12)
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
