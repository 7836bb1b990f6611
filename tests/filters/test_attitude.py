"""States with rotations: an attitude filter against a naive one, its sides, its consistency, and refusals."""

import shutil
from functools import partial
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from scipy.linalg import sqrtm
from scipy.spatial.transform import Rotation as Turned

import filters
from filters.c.project import c_filter, write_project
from filters.consistency.report import consistency_report
from filters.estimators.foreign import Estimator, ForeignFilter
from filters.named import model_named
from filters.registry import FILTERS
from filters.sensitivity import ModelSlopes, sensitivity, state_score
from filters.starts import begun_at
from tests.filters.attitudes import (
    DT,
    ENSEMBLES,
    FIELD,
    GRAVITY,
    GYRO,
    OTHERS,
    SENSOR,
    TAKE_ROTATIONS,
    WALK,
    address,
    attitude_model,
    c_library,
    errors_of,
    naive,
    nees_of,
    ran,
    simulated,
    skew,
)
from tests.filters.checks import refused
from tests.oracles import each_close, each_equal
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted
from thruster_env.model import rotations
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import Rotation


@pytest.fixture(scope="module")
def data():
    return tuple(simulated(16, 100, 5.0))


@pytest.fixture(scope="module")
def of_side(data):
    """Estimates of all 16 runs by the extended filter, by the side of the error."""
    _, gyro, z = data
    return {side: ran(attitude_model(side), gyro, z) for side in ("body", "world")}


def test_the_extended_filter_is_the_error_state_filter(data, of_side):
    """Written with matrices and scipy's rotations it has the same estimates."""
    _, gyro, z = data
    q, bias, P = naive(gyro[0], z[0], 5.0)
    mean = of_side["body"].means[0, -1]
    assert (q.inv() * Turned.from_quat(mean[[1, 2, 3, 0]])).magnitude() < 1e-12
    np.testing.assert_allclose(mean[4:], bias, atol=1e-13)
    np.testing.assert_allclose(of_side["body"].covs[0, -1], P, atol=1e-15)


def test_estimates_do_not_depend_on_the_side_of_the_error(of_side):
    """With the exact reset; the covariance of the world's error is that of the body's, turned."""
    body, world = of_side["body"], of_side["world"]
    np.testing.assert_allclose(world.means, body.means, atol=1e-12)
    np.testing.assert_allclose(world.log_likelihoods, body.log_likelihoods, atol=1e-9)
    A = np.eye(6)
    A[:3, :3] = rotations.matrix(body.means[0, -1, :4])
    np.testing.assert_allclose(world.covs[0, -1], A @ body.covs[0, -1] @ A.T, atol=1e-15)


def test_errors_are_consistent_from_five_degrees(data, of_side):
    """The mean NEES of 16 runs is that of six states, at a level of 1e-4; quaternions keep length 1."""
    estimates = of_side["body"]
    assert 3.9 < nees_of(data[0], estimates)[:, 20:].mean() < 8.6
    np.testing.assert_allclose(np.linalg.norm(estimates.means[..., :4], axis=-1), 1.0, atol=4e-16)


def test_minus_q_is_the_same_rotation(data, of_side):
    _, gyro, z = data
    estimates = ran(attitude_model(start=(-1.0, 0.0, 0.0, 0.0)), gyro[0], z[0])
    each_equal((abs(estimates.means), estimates.covs), (abs(of_side["body"].means[0]), of_side["body"].covs[0]))


def test_the_iterated_filter_holds_from_sixty_degrees():
    """Gauss and Newton's steps on the rotation lose no run, and its first errors are consistent, too."""
    truth, gyro, z = simulated(16, 50, 60.0)
    estimates = ran(attitude_model(degrees=60.0), gyro, z, "iekf", iterations=8)
    nees, errors = nees_of(truth, estimates), errors_of(truth, estimates.means)
    assert 3.0 < nees[:, 0].mean() < 9.6  # the mean of 16 runs, at a level of 1e-4
    assert np.rad2deg(np.linalg.norm(errors[:, -1, :3], axis=-1)).max() < 5.0


def test_the_iterated_filter_does_not_depend_on_the_side(data):
    """Each iteration's Jacobian is brought into the tangent of the prediction."""
    body, world = (ran(attitude_model(side), *data[1:], "iekf", iterations=2) for side in ("body", "world"))
    np.testing.assert_allclose(world.means, body.means, atol=1e-12)


def naive_points(mean, P):
    """Sigma points of alpha = 1 and kappa = 0 as rotations and biases, 13 of each."""
    L = np.linalg.cholesky(P) * np.sqrt(6.0)
    D = np.vstack([np.zeros(6), L.T, -L.T])
    return Turned.from_quat(mean[[1, 2, 3, 0]]) * Turned.from_rotvec(D[:, :3]), mean[4:] + D[:, 3:], D


def naive_unscented(mean, P, gyro, z):
    """A prediction and an update of the unscented filter, in matrices: its rotation, bias and P."""
    q, bias, _ = naive_points(mean, P)
    q = q * Turned.from_rotvec((gyro - bias) * DT)
    D = np.hstack([(q[0].inv() * q).as_rotvec(), bias - bias[0]])[1:]
    s, G = D.sum(axis=0) / 12.0, np.eye(6)
    G[:3, :3] = rotations.left_jacobian(-s[:3])
    P = G @ (D.T @ D / 12.0 + np.outer(s, s)) @ G.T + np.diag([GYRO**2 * DT] * 3 + [WALK**2 * DT] * 3)
    x, y, zz, w = (q[0] * Turned.from_rotvec(s[:3])).as_quat()
    q, bias, D = naive_points(np.array([w, x, y, zz, *(bias[0] + s[3:])]), P)
    Y = np.hstack([q.inv().apply(GRAVITY), q.inv().apply(FIELD)])
    E, s = Y[1:] - Y[0], (Y[1:] - Y[0]).sum(axis=0) / 12.0
    S = E.T @ E / 12.0 + np.outer(s, s) + SENSOR**2 * np.eye(6)
    K = np.linalg.solve(S, E.T @ D[1:] / 12.0).T
    d, G = K @ (z - Y[0] - s), np.eye(6)
    G[:3, :3] = rotations.left_jacobian(-d[:3])
    return q[0] * Turned.from_rotvec(d[:3]), bias[0] + d[3:], G @ (P - K @ S @ K.T) @ G.T


def test_the_unscented_filter_is_that_of_points_on_the_rotation(data):
    _, gyro, z = data
    filter_ = filters.UnscentedKalmanFilter(model=attitude_model(degrees=20.0))
    start = filter_.init()
    belief, _ = filter_.update(filter_.predict(start, gyro[0, 0]), z[0, 1])
    q, bias, P = naive_unscented(start.mean, start.cov, gyro[0, 0], z[0, 1])
    assert (q.inv() * Turned.from_quat(belief.mean[[1, 2, 3, 0]])).magnitude() < 1e-14
    each_close((belief.mean[4:], belief.cov), (bias, P), atol=1e-15)


class Sensor(gym.Env):
    """An env that measures the directions of a body at rest."""

    action_space = gym.spaces.Box(-1.0, 1.0, (3,))
    observation_space = gym.spaces.Box(-2.0, 2.0, (6,))

    def reset(self, *, seed=None, options=None):
        return np.array([*GRAVITY, *FIELD], dtype=np.float32), {}

    def step(self, action):
        return self.reset()[0], 0.0, False, False, {}


def test_sessions_beliefs_wrapped_envs_and_python_have_the_numbers_of_a_batch(data, of_side):
    """The same run on each path; P has a row less than the state."""
    _, gyro, z = data
    filter_, expected = filters.ExtendedKalmanFilter(model=attitude_model()), of_side["body"]
    session, (belief, _) = filter_.session(), filter_.update(filter_.init(), z[0, 0])
    session.start(z=z[0, 0])
    for k in range(3):
        session.step(gyro[0, k], z[0, k + 1])
        belief, innovation = filter_.update(filter_.predict(belief, gyro[0, k]), z[0, k + 1])
    for mean, cov in ((session.mean, session.cov), (belief.mean, belief.cov)):
        np.testing.assert_allclose(mean, expected.means[0, 3], atol=1e-15)
        np.testing.assert_allclose(cov, expected.covs[0, 3], atol=1e-16)
    np.testing.assert_allclose(innovation.value, expected.innovations[0, 3], atol=1e-14)
    with interpreted():
        in_python = filters.run(filter_, inputs=gyro[0, :3], measurements=z[0, :4])
    np.testing.assert_allclose(in_python.means, expected.means[0, :4], atol=1e-15)
    env = filters.EstimateState(Sensor(), model=attitude_model(), filter="ekf", observation="belief")
    observation, info = env.reset(seed=1)
    observation, *_, info = env.step(np.zeros(3))
    assert observation.shape == (13,)
    assert info["estimate_cov"].shape == (6, 6)
    assert env.observation_space.contains(observation)


def test_smoothed_attitudes_are_better_and_do_not_depend_on_the_side(data, of_side):
    """The recursion backwards brings the later P into the tangent of the prediction."""
    truth, gyro, z = data
    body, world = (
        filters.smooth(
            filters.ExtendedKalmanFilter(model=attitude_model(side)), inputs=gyro[:4, :40], measurements=z[:4, :41]
        )
        for side in ("body", "world")
    )
    np.testing.assert_allclose(world.means, body.means, atol=1e-12)
    smoothed, filtered = (
        errors_of(truth[:4, :41], means) for means in (body.means, of_side["body"].means[:4, :41])
    )
    assert np.square(smoothed[..., :3]).mean() < 0.5 * np.square(filtered[..., :3]).mean()
    np.testing.assert_array_equal(body.covs[:, -1], of_side["body"].covs[:4, 40])


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_c_on_the_page_begins_at_the_attitude_of_gravity_and_field(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "attitude.md").read_text(encoding="utf-8")
    (tmp_path / "begin.c").write_text(page.split("```c\n")[1].split("```")[0])
    filter_ = filters.ExtendedKalmanFilter(model=attitude_model())
    c, memory = c_library(filter_, "attitude", tmp_path, tmp_path / "begin.c")
    half_turns = [[np.pi, 0, 0], [0, np.pi, 0], [0, 0, np.pi], [np.pi / 2**0.5, -np.pi / 2**0.5, 0]]
    for turn in [*half_turns, *np.random.default_rng(2).normal(size=(20, 3)), [0.0, 0.0, 0.0]]:
        world = Turned.from_rotvec(turn)
        z = np.concatenate([9.81 * world.inv().apply(GRAVITY), 48.0 * world.inv().apply(FIELD)])
        c.begin(address(memory), address(z))
        assert (world.inv() * Turned.from_quat(memory[:4], scalar_first=True)).magnitude() < 1e-7


@pytest.mark.parametrize("name", FILTERS)
def test_every_filter_runs_on_rotations_or_refuses_them(name):
    extra = {"low": -np.ones(7), "high": np.ones(7)} if name == "fuzzy" else {}
    make = lambda: FILTERS[name](model=attitude_model(), **extra)  # noqa: E731
    if name in {*TAKE_ROTATIONS, *ENSEMBLES, *OTHERS}:
        assert make().takes_rotations
    else:
        with pytest.raises(ValueError, match="is of rotations|must have an affine model"):
            make().kernels()


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", list(TAKE_ROTATIONS)[2:-1])
def test_filters_of_rotations_have_the_estimates_of_their_kin(name, data):
    """Parameters at their limits make one of the other."""
    parameters, other, of_other = TAKE_ROTATIONS[name]
    arguments = {"inputs": data[1][:2, :5], "measurements": data[2][:2, :6]}
    both = [filters.make_filter(name, attitude_model(), **parameters)]
    both.append(filters.make_filter(other, attitude_model(), **of_other))
    a, b = (filters.run(filter_, **arguments) for filter_ in both)
    each_close((a.means, a.covs), (b.means, b.covs), atol=1e-12)
    np.testing.assert_allclose(a.log_likelihoods, b.log_likelihoods, atol=1e-7)
    if name == "ckf":
        a, b = (filters.smooth(filter_, **arguments) for filter_ in both)
        each_close((a.means, a.covs), (b.means, b.covs), atol=1e-12)


@pytest.mark.usefixtures("as_python")
def test_the_smoother_by_points_is_that_of_matrices(data):
    """A step backwards from 20 degrees, with later estimates in the tangent of the predicted mean."""
    filter_ = filters.UnscentedKalmanFilter(model=attitude_model(degrees=20.0), beta=0.0)
    arguments = {"inputs": data[1][0, :1], "measurements": data[2][0, :2]}
    estimates, smoothed = filters.run(filter_, **arguments), filters.smooth(filter_, **arguments)
    (mean, later), (P, later_P) = estimates.means, estimates.covs
    q, bias, before = naive_points(mean, P)
    q = q * Turned.from_rotvec((arguments["inputs"][0] - bias) * DT)
    D = np.hstack([(q[0].inv() * q).as_rotvec(), bias - bias[0]])[1:]
    s, G = D.sum(axis=0) / 12.0, np.eye(6)
    G[:3, :3] = rotations.left_jacobian(-s[:3])
    D = (D - s) @ G.T
    predicted = D.T @ D / 12.0 + filter_.model.process_noise_cov
    gain = before[1:].T @ D / 12.0 @ np.linalg.inv(predicted)
    turned = ((q[0] * Turned.from_rotvec(s[:3])).inv() * Turned.from_quat(later[[1, 2, 3, 0]])).as_rotvec()
    change, J = np.concatenate([turned, later[4:] - bias[0] - s[3:]]), np.eye(6)
    J[:3, :3] = rotations.inverse_left_jacobian(-turned)
    d, back = gain @ change, P + gain @ (J @ later_P @ J.T - predicted) @ gain.T
    G[:3, :3] = rotations.left_jacobian(-d[:3])
    error = Turned.from_quat(smoothed.means[0, [1, 2, 3, 0]]).inv() * Turned.from_quat(mean[[1, 2, 3, 0]])
    assert (error * Turned.from_rotvec(d[:3])).magnitude() < 1e-14
    np.testing.assert_allclose(smoothed.means[0, 4:], mean[4:] + d[3:], atol=1e-15)
    np.testing.assert_allclose(smoothed.covs[0], G @ back @ G.T, atol=1e-14)


@pytest.mark.usefixtures("as_python")
def test_a_considered_rotation_keeps_its_prior(data):
    """Indices are of the errors: the bias is corrected, the attitude only propagated."""
    filter_ = filters.make_filter("schmidt", attitude_model(), considered=(0, 1, 2))
    estimates = filters.run(filter_, inputs=data[1][0, :1], measurements=data[2][0, :2])
    np.testing.assert_array_equal(estimates.means[0, :4], (1.0, 0.0, 0.0, 0.0))
    assert np.all(estimates.means[1, 4:] != 0.0)
    refused("considered must", filters.make_filter, "schmidt", attitude_model(), considered=(6,))


@pytest.mark.usefixtures("as_python")
def test_a_fixed_lag_in_an_env_takes_rotations():
    model = attitude_model(degrees=20.0)
    env = filters.EstimateState(Sensor(), model=model, filter="ekf", smoothing_lag=2)
    _, info = env.reset(seed=1)
    z = [np.array([*GRAVITY, *FIELD], dtype=np.float32).astype(float)]
    for _ in range(3):
        *_, info = env.step(np.array([0.3, -0.2, 0.1]))
        z.append(z[0])
    data = {"inputs": np.tile(np.float32([0.3, -0.2, 0.1]).astype(float), (3, 1)), "measurements": np.array(z)}
    smoothed = filters.smooth(filters.ExtendedKalmanFilter(model=model), lag=2, **data)
    each_close((info["smoothed"], info["smoothed_cov"]), (smoothed.means[1], smoothed.covs[1]), atol=1e-12)


@pytest.mark.usefixtures("as_python")
def test_an_ensemble_is_updated_in_the_tangent_at_its_mean(data):
    """The transform filter's members and moments are those of matrices and scipy's rotations."""
    filter_ = filters.EnsembleTransformFilter(model=attitude_model(degrees=20.0), ensemble_size=9)
    belief = filter_.predict(filter_.init((3, 4)), data[1][0, 0])
    updated, innovation = filter_.update(belief, data[2][0, 1])

    def moments(members):
        q, mean = Turned.from_quat(members[[1, 2, 3, 0], :9].T), members[4:7, :9].mean(axis=1)
        centre = q[0]
        for _ in range(50):
            centre = centre * Turned.from_rotvec((centre.inv() * q).as_rotvec().mean(axis=0))
        return centre, mean, np.column_stack([(centre.inv() * q).as_rotvec(), members[4:7, :9].T - mean])

    q, bias, D = moments(belief.members)
    Y = np.hstack([(q * Turned.from_rotvec(D[:, :3])).inv().apply(vector) for vector in (GRAVITY, FIELD)])
    d, R = Y - Y.mean(axis=0), SENSOR**2 * np.eye(6)
    S, C, v = d.T @ d / 8.0 + R, D.T @ d / 8.0, data[2][0, 1] - Y.mean(axis=0)
    middle = R @ sqrtm(np.linalg.solve(R, S)).real
    after = D + np.linalg.solve(S, C.T).T @ v - d @ np.linalg.solve(S + middle, C.T)
    np.testing.assert_allclose(innovation.value, v, atol=1e-12)
    np.testing.assert_allclose(updated.members[4:7, :9].T, bias + after[:, 3:], atol=1e-11)
    error = (q * Turned.from_rotvec(after[:, :3])).inv() * Turned.from_quat(updated.members[[1, 2, 3, 0], :9].T)
    assert error.magnitude().max() < 1e-8
    q, bias, D = moments(updated.members)
    assert (q.inv() * Turned.from_quat(updated.mean[[1, 2, 3, 0]])).magnitude() < 1e-9
    np.testing.assert_allclose(updated.cov, D.T @ D / 8.0, atol=1e-11)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["enkf", "ensrf"])
def test_ensembles_are_consistent_from_twenty_degrees(name):
    """From there the extended filter's NEES is 10 at the first measurement."""
    truth, gyro, z = simulated(16, 40, 20.0)
    nees = nees_of(truth, ran(attitude_model(degrees=20.0), gyro, z, name, ensemble_size=200))
    assert 3.0 < nees[:, 0].mean() < 9.6
    assert 3.0 < nees[:, 20:].mean() < 8.6


def with_heading(x, u, c):
    return x[0] + u[0], *rotations.product(x[1:], rotations.exponential((0.1, 0.0, 0.0)))


def heading_and_gravity(x, c):
    """The heading, and gravity in the axes of the body."""
    return x[0], *rotations.to_body(x[1:], GRAVITY)


@pytest.mark.usefixtures("as_python")
def test_angles_beside_rotations_are_wrapped():
    """A heading that turns by 3 rad in each step has the estimates of a scalar filter and smoother."""
    model = StateSpaceModel(
        transition=with_heading,
        observe=heading_and_gravity,
        process_noise_cov=[0.02] + [1e-4] * 3,
        measurement_noise_cov=[0.1] + [0.01] * 3,
        prior_mean=[3.0, 1.0, 0.0, 0.0, 0.0],
        prior_cov=[0.3] + [0.01] * 3,
        states=(Quantity("heading", "a", "rad", True), Rotation("attitude")),
        measurements=(Quantity("heading", "z_a", "rad", True), "z_x", "z_y", "z_z"),
        inputs=1,
    )
    z = np.column_stack([3.1 + 3.0 * np.arange(6), np.tile(GRAVITY, (6, 1))])
    data = {"inputs": np.full((5, 1), 3.0), "measurements": z}
    x, p, means, gain = 3.0, 0.3, [], 0.0
    for k in range(6):
        if k:
            gain = p / (p + 0.02)
            x, p = x + 3.0, p + 0.02
        x, p = x + p / (p + 0.1) * (z[k, 0] - x), 0.1 * p / (p + 0.1)
        means.append(x)
    wrapped = np.angle(np.exp(1j * np.array(means)))
    for name in ("ekf", "ukf"):
        estimates = filters.run(FILTERS[name](model=model), **data)
        np.testing.assert_allclose(estimates.means[:, 0], wrapped, atol=1e-12)
        np.testing.assert_allclose(estimates.covs[-1, 0, 0], p, rtol=1e-9)
    smoothed = filters.smooth(FILTERS["ekf"](model=model), **data)
    before = means[-2] + gain * (means[-1] - means[-2] - 3.0)
    np.testing.assert_allclose(smoothed.means[-2, 0], np.angle(np.exp(1j * before)), atol=1e-12)


def until_small(x, u, c):
    """Turn by smaller and smaller angles, which cannot be traced."""
    angle, q = u[0], x[:4]
    while abs(angle) > 1e-3:
        q, angle = rotations.product(q, rotations.exponential((angle, 0.0, 0.0))), 0.5 * angle
    return *q, *x[4:]


def test_a_model_that_is_too_large_or_cannot_be_traced_is_refused_by_a_rule():
    """Operations on rotations are parts of programs alone."""
    with pytest.raises(
        ValueError, match="a filter of rotations must have functions that can be traced, and .* 300000"
    ):
        filters.ExtendedKalmanFilter(model=attitude_model().replace(transition=until_small)).kernels()


def test_tables_and_pictures_of_runs_have_angles_in_degrees(data):
    _, u, z = data
    estimates = ran(attitude_model(), u[0], z[0])
    table, q = estimates.to_frame(), estimates.means[:, :4]
    yaw = Turned.from_quat(q, scalar_first=True).as_euler("ZYX", degrees=True)[:, 0]
    np.testing.assert_allclose(table["yaw_deg"], yaw, atol=1e-9)
    assert (table["std_yaw_deg"] > 0.0).all() and table.index.name == "time_s"
    assert len(estimates.plot().axes) > 3


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ekf", "iekf"])
def test_attitude_by_name_is_smoothed(name):
    """Its twelve errors need more operations than models of numbers may have."""
    model = model_named("attitude")(dt=0.01)
    rng, world = np.random.default_rng(0), Turned.from_rotvec([0.2, -0.1, 0.5])
    still = np.zeros(model.n)
    still[:4] = world.as_quat(scalar_first=True)
    z = np.array(model.observe(still, model.constants))
    z = z + rng.normal(size=(200, 6)) * np.sqrt(np.diag(model.measurement_noise_cov))
    data = {"inputs": np.zeros((199, 3)), "measurements": z}
    filter_ = filters.make_filter(name, model)

    def error(estimates):
        return (world.inv() * Turned.from_quat(estimates.means[20:, :4], scalar_first=True)).magnitude()

    filtered, smoothed = error(filters.run(filter_, **data)), error(filters.smooth(filter_, **data))
    assert np.sqrt(np.mean(smoothed**2)) < np.sqrt(np.mean(filtered**2)) < np.deg2rad(5.0)


def test_every_other_path_refuses_them():
    """Smoothers, C, gradients and models made of a model."""
    model, filter_ = attitude_model(), filters.ExtendedKalmanFilter(model=attitude_model())
    data = {"inputs": np.zeros((2, 3)), "measurements": np.zeros((3, 6))}
    batch = {name: np.tile(part, (2, 1, 1)) for name, part in data.items()}
    refusals = (
        lambda: filters.smooth(filters.EnsembleKalmanFilter(model=model), **data),
        lambda: filters.EnsembleTransformFilter(model=model, rotations=1).kernels(),
        lambda: c_filter(filters.EnsembleKalmanFilter(model=model), "a"),
        lambda: consistency_report(filters.run(filter_, **batch), None),
        lambda: ForeignFilter(model=model, estimator=Estimator()),
        lambda: write_project(filter_, "a folder"),
        lambda: filters.linearize(model, model.prior_mean, np.zeros(3)),
        lambda: filters.augmented_model(model, {0: filters.Unknown(0.1)}),
        lambda: filters.transformed_model(model, {"b_x": (-1.0, 1.0)}),
        lambda: model.replace(bounds={"b_x": (-1.0, 1.0)}),
    )
    for path in refusals:
        refused("rotations", path)


def test_what_is_no_rotation_is_refused():
    """Quaternions without length 1, other sides, covariances of stored numbers; a copy with other noise is one."""
    model = attitude_model()
    refused("'attitude' must be a quaternion", attitude_model, start=(1.0, 1.0, 0.0, 0.0))
    refused("must be 'body' or 'world', but got 'left'", attitude_model, side="left")
    refused("prior_cov must be 6 variances", model.replace, prior_cov=np.ones(7))
    changed = model.replace(process_noise_cov=np.ones(6)).replace(observe_jacobian=None)
    assert changed.turns == model.turns
    assert changed.digest == model.digest != attitude_model("world").digest
    filter_ = filters.ExtendedKalmanFilter(model=model)
    with pytest.raises(ValueError, match="'attitude' must be a quaternion"):
        filter_.predict(filter_.init()._replace(mean=np.ones(7)), np.zeros(3))


def slopes_by_differences(of, count, step=1e-4):
    """Central differences of values (B,) by parameters (count,), (B, count)."""
    return np.array([of(e) - of(-e) for e in step * np.eye(count)]).T / (2 * step)


def test_derivatives_of_the_likelihood():
    """Along Q, R, a constant and the prior: exact through the steps of the tangent."""
    model, (_, gyro, z) = attitude_model(), simulated(2, 12, 5.0)
    z[0, 3:6, 2] = np.nan
    q = np.zeros((4, 6, 6))
    q[0, :3, :3], q[0, 1, 4] = model.process_noise_cov[:3, :3], 1e-8
    q[0] += q[0].T
    r, c, mean = np.zeros_like(q), np.array([[0.0], [0.0], [DT], [0.0]]), np.zeros((4, 7))
    r[1], mean[3] = model.measurement_noise_cov, [0.0, 0.02, 0.0, -0.01, 0.0, 0.01, 0.0]
    slopes = ModelSlopes(c, q, r, mean, 1e-3 * r)

    def value(e):
        changed = model.replace(
            process_noise_cov=model.process_noise_cov + np.tensordot(e, q, 1),
            measurement_noise_cov=model.measurement_noise_cov + np.tensordot(e, r, 1),
            prior_cov=model.prior_cov + 1e-3 * np.tensordot(e, r, 1),
            constants=tuple(np.array(model.constants) + e @ c),
        )
        x = model.prior_mean + e @ mean
        x[:4] /= np.linalg.norm(x[:4])
        return ran(changed.replace(prior_mean=x), gyro, z).log_likelihoods.sum(axis=1)

    computed = sensitivity(model, gyro, z, slopes)
    np.testing.assert_allclose(computed.values, value(np.zeros(4)), rtol=1e-12)
    np.testing.assert_allclose(computed.gradients, slopes_by_differences(value, 4), rtol=1e-5, atol=1e-5)


@pytest.mark.parametrize("kind", slow_but(["ekf", "iekf", "ukf"], ["ekf"]))
def test_derivatives_of_errors(kind):
    """Errors are those of the tangent; a quaternion with a missing component does not count."""
    model, (truth, gyro, z) = attitude_model("body" if kind == "ekf" else "world"), simulated(2, 12, 5.0)
    counts, weights = np.ones((2, 13, 6)), np.arange(1.0, 7.0)
    truth[1, 4, 2] = truth[1, 7, 5] = np.nan
    counts[1, 4, :3] = counts[1, 7, 4] = 0.0
    q, r = np.zeros((2, 6, 6)), np.zeros((2, 6, 6))
    q[0, :3, :3], r[1] = model.process_noise_cov[:3, :3], model.measurement_noise_cov
    filter_ = filters.make_filter(kind, model)

    def value(score, e):
        changed = model.replace(
            process_noise_cov=model.process_noise_cov + np.tensordot(e, q, 1),
            measurement_noise_cov=model.measurement_noise_cov + np.tensordot(e, r, 1),
        )
        nothing = np.zeros((0, 6, 6))
        return state_score(changed, gyro, z, truth, nothing, nothing, score, filter=filter_).values

    for score in ("squares", "log-score"):
        computed = state_score(model, gyro, z, truth, q, r, score, filter=filter_).gradients
        np.testing.assert_allclose(computed, slopes_by_differences(partial(value, score), 2), rtol=1e-5, atol=1e-6)
    if kind == "ekf":
        means = filters.run(filter_, inputs=gyro, measurements=z).means
        errors = np.where(counts, errors_of(np.where(np.isnan(truth), means, truth), means), 0.0)
        squares = state_score(model, gyro, z, truth, q, r, "squares", weights, filter=filter_).values
        np.testing.assert_allclose(squares, -np.einsum("bki,i->b", errors**2, weights), rtol=1e-12)


def test_a_run_begins_at_its_first_measurement():
    """From anywhere, to the deviation of the sensors; without a magnetometer the tilt is known."""
    model, turned = attitude_model(degrees=115.0), Turned.random(6, random_state=1)
    z = np.column_stack([turned.inv().apply(vector) for vector in (GRAVITY, FIELD)])
    begun = begun_at(model, z)[:, [1, 2, 3, 0]]
    assert np.rad2deg((Turned.from_quat(begun).inv() * turned).magnitude()).max() < 0.5
    x, y, zz, w = (
        Turned.from_quat(begun_at(model, np.where(np.arange(6) < 3, z, np.nan))[:, [1, 2, 3, 0]]).as_quat().T
    )
    np.testing.assert_allclose(np.column_stack([2 * (x * zz - w * y), 2 * (y * zz + w * x)]), z[:, :2], atol=1e-2)


def test_a_measured_quaternion_is_refused_and_the_columns_of_its_matrix_have_its_covariance():
    def quaternion(x, c):
        return x[0], x[1], x[2], x[3]

    def columns(x, c):
        return tuple(v for axis in np.eye(3).tolist() for v in rotations.to_world(x[:4], axis))

    sigma, model = 0.01, attitude_model()
    rule = "observe must be the same for q and -q of 'attitude'.*make a quaternion a Rotation"
    refused(rule, model.replace, observe=quaternion, measurement_noise_cov=[sigma**2] * 4, measurements=None)
    of_columns = model.replace(observe=columns, measurement_noise_cov=[2.0 * sigma**2] * 9, measurements=None)
    z = Turned.from_rotvec([0.03, -0.05, 0.02]).as_matrix().T.ravel()
    estimates = filters.run(filters.make_filter("ekf", of_columns), inputs=np.zeros((0, 3)), measurements=[z])
    prior = np.deg2rad(5.0) ** 2
    np.testing.assert_allclose(estimates.stds[0, :3] ** 2, prior * sigma**2 / (prior + sigma**2), rtol=5e-3)


def navlie_update(q, bias, P, z, iterations):
    """navlie's IteratedKalmanFilter for a rotation of the body: each step in the tangent at the last iterate.

    e = log(x_0^-1 x),  P = J P_0 J',  J = J_r(e),  x := x exp(-J e + K (z - h(x) + H J e))
    """
    x, b, prior = q, bias, P
    for _ in range(iterations):
        e = np.concatenate([(q.inv() * x).as_rotvec(), b - bias])
        J = np.eye(6)
        J[:3, :3] = rotations.left_jacobian(-e[:3])
        back = J @ e
        P = J @ prior @ J.T
        expected = x.inv().apply([GRAVITY, FIELD])
        H = np.zeros((6, 6))
        H[:3, :3], H[3:, :3] = skew(expected[0]), skew(expected[1])
        S = H @ P @ H.T + SENSOR**2 * np.eye(6)
        K = np.linalg.solve(S, H @ P).T
        d = -back + K @ (z - expected.ravel() + H @ back)
        x, b, P = x * Turned.from_rotvec(d[:3]), b + d[3:], P - K @ S @ K.T
    return x, b, P


@pytest.mark.usefixtures("as_python")
def test_updates_are_those_of_navlie_and_of_ukfm(data):
    """navlie's iterated filter, once it has converged; ukfm's unscented filter, but for the reset.

    Sources: navlie, IteratedKalmanFilter; Brossard, Barrau, Bonnabel (2020), "A code for unscented Kalman
    filtering on manifolds (UKF-M)".
    """
    z, model = data[2][0, 0], attitude_model(degrees=30.0)
    iterated = filters.IteratedExtendedKalmanFilter(model=model, iterations=15)
    belief, _ = iterated.update(iterated.init(), z)
    q, bias, P = navlie_update(Turned.identity(), np.zeros(3), model.prior_cov, z, 15)
    assert (q.inv() * Turned.from_quat(belief.mean[[1, 2, 3, 0]])).magnitude() < 1e-10
    each_close((belief.mean[4:], belief.cov), (bias, P), atol=1e-10)

    unscented = filters.UnscentedKalmanFilter(model=model)  # beta = 2, whose weights are ukfm's
    belief, _ = unscented.update(unscented.init(), z)
    q, _, D = naive_points(model.prior_mean, model.prior_cov)
    Y = np.hstack([q.inv().apply(GRAVITY), q.inv().apply(FIELD)])
    w, of_centre = np.r_[0.0, np.full(12, 1.0 / 12.0)], np.r_[2.0, np.full(12, 1.0 / 12.0)]
    E = Y - w @ Y
    S = (E * of_centre[:, None]).T @ E + SENSOR**2 * np.eye(6)
    K = np.linalg.solve(S, (E * of_centre[:, None]).T @ D).T
    d, G = K @ (z - w @ Y), np.eye(6)
    G[:3, :3] = rotations.left_jacobian(-d[:3])  # the reset, which ukfm leaves out
    assert (Turned.from_rotvec(-d[:3]) * Turned.from_quat(belief.mean[[1, 2, 3, 0]])).magnitude() < 1e-13
    np.testing.assert_allclose(belief.mean[4:], d[3:], atol=1e-15)
    np.testing.assert_allclose(belief.cov, G @ (model.prior_cov - K @ S @ K.T) @ G.T, atol=1e-14)
