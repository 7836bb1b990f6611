"""Filters of poses and directions: the invariant filter, sides, naive slopes, refusals."""

import numpy as np
import pytest

import filters
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted
from thruster_env.model import directions, poses, rotations, turns
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import Direction, ExtendedPose, Pose

DT, GRAVITY = 0.1, (0.0, 0.0, -9.81)


def fly(x, u, c):
    """An IMU advances the extended pose."""
    return poses.strapdown(x, u[:3], u[3:], GRAVITY, DT)


def position(x, c):
    """A receiver of positions, and the magnetic field in the axes of the body."""
    return *x[7:], *rotations.to_body(x[:4], (0.0, 0.6, -0.8))


def navigation(side):
    """Attitude, velocity and position."""
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
    estimates = filters.run(filters.ExtendedKalmanFilter(model=world), inputs=u, measurements=z)
    assert 6.4 < nees(world, truth, estimates)[:, 5:].mean() < 12.0
    of_sides = [
        filters.run(
            filters.ExtendedKalmanFilter(model=model.replace(process_noise_cov=np.zeros(9))),
            inputs=u,
            measurements=z,
        )
        for model in (world, body)
    ]
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
    """A pose, and a direction."""
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
        np.testing.assert_allclose(estimates.means[k], x, atol=1e-8)
        np.testing.assert_allclose(estimates.covs[k], P, atol=1e-8)


def test_what_is_no_direction_or_pose_is_refused():
    """Vectors without length 1, by what they must be."""
    with pytest.raises(ValueError, match="'field' must be .x, y, z. of length 1"):
        camera().replace(prior_mean=[1.0, *[0.0] * 6, 0.0, 0.0, 2.0])
    with pytest.raises(ValueError, match="'camera' must begin with a quaternion"):
        camera().replace(prior_mean=[2.0, *[0.0] * 6, 0.0, 0.0, 1.0])
    with pytest.raises(ValueError, match="'camera' and 'field' are of poses and directions: filters.run"):
        filters.AuxiliaryParticleFilter(model=camera()).kernels()
