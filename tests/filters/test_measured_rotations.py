"""Measurements that turn: quaternions of a star tracker, directions and poses, against naive filters."""

import shutil

import gymnasium as gym
import numpy as np
import pytest
from scipy.spatial.transform import Rotation as Turned

import filters
from filters.logs.estimate import estimate
from filters.logs.findings import alarms_of, findings, verdict
from filters.monitoring import Monitor, watch_of
from filters.registry import FILTERS
from filters.sensitivity import likelihood
from filters.starts import begun_at
from tests.filters.attitudes import (
    BIAS,
    DT,
    ENSEMBLES,
    GYRO,
    OTHERS,
    TAKE_ROTATIONS,
    WALK,
    address,
    advance,
    c_library,
    ran,
)
from tests.filters.checks import refused
from tests.oracles import each_close, each_equal
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.env.model_env import ModelEnv
from thruster_env.model import poses, rotations
from thruster_env.model.simulate import simulate
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import Direction, Pose, Rotation, difference, move

SENSOR = np.array([0.01, 0.02, 0.05])  # rad, about the axes of the camera


def tracker_model(side="body", measured="body", degrees=5.0, sensor=SENSOR):
    """Attitude and bias of a gyroscope, and a star tracker."""
    return StateSpaceModel(
        transition=advance,
        observe=lambda x, c: x[:4],
        process_noise_cov=[GYRO**2 * DT] * 3 + [WALK**2 * DT] * 3,
        measurement_noise_cov=sensor**2,
        prior_mean=[1.0] + [0.0] * 6,
        prior_cov=[np.deg2rad(degrees) ** 2] * 3 + [BIAS**2] * 3,
        constants=(DT,),
        states=(Rotation("attitude", side=side), "b_x", "b_y", "b_z"),
        measurements=(Rotation("star tracker", "s", measured),),
        inputs=3,
    )


def tracked(degrees=5.0, sensor=SENSOR):
    """Gyroscope (30, 3) and quaternions (31, 4) of random signs, the errors in the axes of the camera."""
    draw, q = np.random.default_rng(3).normal, Turned.identity()
    q = q * Turned.from_rotvec(np.deg2rad(degrees) * draw(size=3))
    gyro, z = [], []
    for k in range(31):
        sign = -1.0 if k % 3 else 1.0
        z.append(sign * (q * Turned.from_rotvec(sensor * draw(size=3))).as_quat(scalar_first=True))
        rate = 0.5 * np.sin(0.3 * k + np.arange(3.0))
        gyro.append(rate + 0.02 + GYRO / DT**0.5 * draw(size=3))
        q = q * Turned.from_rotvec(rate * DT)
    return np.array(gyro[:-1]), np.array(z)


@pytest.fixture(scope="module")
def data():
    return tracked()


@pytest.fixture(scope="module")
def extended(data):
    return ran(tracker_model(), *data)


def naive(gyro, z, degrees=5.0, iterations=1):
    """The (iterated) error-state filter of the body in matrices: q, bias, P, log-likelihood, last innovation, S.

    The first iteration is the extended filter's. Later ones minimise |log(h(x)^-1 z)|^2 in R^-1 plus the prior.
    """
    q, bias, level = Turned.identity(), np.zeros(3), 0.0
    P = np.diag([np.deg2rad(degrees) ** 2] * 3 + [BIAS**2] * 3)
    Q, R = np.diag([GYRO**2 * DT] * 3 + [WALK**2 * DT] * 3), np.diag(SENSOR**2)
    for k, measured in enumerate(Turned.from_quat(z, scalar_first=True)):
        if k:
            turn = (gyro[k - 1] - bias) * DT
            F = np.eye(6)
            F[:3, :3], F[:3, 3:] = Turned.from_rotvec(turn).as_matrix().T, -DT * left_jacobian(-turn)
            q, P = q * Turned.from_rotvec(turn), F @ P @ F.T + Q
        d, G = np.zeros(6), np.eye(6)
        for i in range(iterations):
            v, H = ((q * Turned.from_rotvec(d[:3])).inv() * measured).as_rotvec(), np.eye(3, 6)
            if i:  # d log(h(x)^-1 z)/dd, by the derivatives of the logarithm and of the exponential
                H = np.linalg.inv(left_jacobian(v)) @ np.eye(3, 6) @ G
            S = H @ P @ H.T + R
            if i == 0:
                first, level = (
                    (v, S),
                    level - 0.5 * (v @ np.linalg.solve(S, v) + np.linalg.slogdet(2 * np.pi * S)[1]),
                )
            K = np.linalg.solve(S, H @ P).T
            d = K @ (v + H @ d)
            G[:3, :3] = left_jacobian(-d[:3])
        P = G @ (P - K @ S @ K.T) @ G.T
        q, bias = q * Turned.from_rotvec(d[:3]), bias + d[3:]
    return q, bias, P, level, *first


def left_jacobian(d):
    """J_l(d), by scipy's integral: the mean of the rotations by s d, s from 0 to 1."""
    nodes, weights = np.polynomial.legendre.leggauss(20)
    return np.einsum("i,ijk->jk", 0.5 * weights, Turned.from_rotvec(np.outer(0.5 + 0.5 * nodes, d)).as_matrix())


def is_at(mean, cov, q, bias, P, atol=1e-12):
    assert (q.inv() * Turned.from_quat(mean[:4], scalar_first=True)).magnitude() < atol
    np.testing.assert_allclose(mean[4:], bias, atol=atol)
    np.testing.assert_allclose(cov, P, atol=1e-3 * atol)


def test_the_extended_filter_is_the_naive_one(data, extended):
    """Innovations have three components, and q and -q are the same measurement."""
    q, bias, P, level, v, S = naive(*data)
    is_at(extended.means[-1], extended.covs[-1], q, bias, P)
    assert extended.innovations.shape == (31, 3)
    np.testing.assert_allclose(extended.innovations[-1], v, atol=1e-13)
    np.testing.assert_allclose(extended.innovation_covs[-1], S, atol=1e-15)
    assert extended.log_likelihoods.sum() == pytest.approx(level, abs=1e-8)


@pytest.mark.usefixtures("as_python")
def test_the_iterated_filter_is_gauss_and_newtons_method_at_the_measurement():
    """From an attitude 60 degrees off; one iteration is the extended filter, also at the measurement."""
    gyro, z = tracked(60.0)
    estimates = ran(tracker_model(degrees=60.0), gyro[:4], z[:5], "iekf", iterations=4)
    q, bias, P, level, *_ = naive(gyro[:4], z[:5], 60.0, 4)
    is_at(estimates.means[-1], estimates.covs[-1], q, bias, P)
    assert estimates.log_likelihoods.sum() == pytest.approx(level, abs=1e-8)


@pytest.mark.usefixtures("as_python")
def test_sides_of_both_errors_do_not_matter_if_the_sensor_is_the_same_about_all_axes(data):
    """R = sigma^2 I is the same for a rotation of the world."""
    gyro, z = data[0][:5], data[1][:6]
    sensor, sides = np.full(3, 0.02), ("body", "world")
    models = [tracker_model(side, measured, sensor=sensor) for side in sides for measured in sides]
    first, *rest = (ran(model, gyro, z) for model in models)
    for other in rest:
        np.testing.assert_allclose(other.means, first.means, atol=1e-12)
        np.testing.assert_allclose(other.log_likelihoods, first.log_likelihoods, atol=1e-9)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", [*list(TAKE_ROTATIONS)[1:], *ENSEMBLES])
def test_all_filters_of_rotations_measure_them(name, data, extended):
    """Each stays within its own deviations of the extended filter; parameters at limits make one of the other."""
    parameters, kin, of_kin = TAKE_ROTATIONS.get(name, ({"ensemble_size": 60}, "ekf", {}))
    gyro, z = data[0][:4], data[1][:5]
    estimates = ran(tracker_model(), gyro, z, name, **parameters)
    assert estimates.innovation_covs.shape == (5, 3, 3)
    if name in ENSEMBLES:
        off = difference(estimates.means[-1], extended.means[4], tracker_model().turns)
        assert (np.abs(off) < 1.5 * extended.stds[4]).all()
        assert np.abs(np.log(estimates.stds[-1, :3] / extended.stds[4, :3])).max() < 0.4
        return
    other = ran(tracker_model(), gyro, z, kin, **of_kin)
    each_close((estimates.means, estimates.covs), (other.means, other.covs), atol=1e-12)
    np.testing.assert_allclose(estimates.log_likelihoods, other.log_likelihoods, atol=1e-7)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", ["ekf", "iekf", "ukf"])
def test_gradients_are_the_slopes_of_the_likelihood(name, data):
    """Along Q and R, beside differences; a missing quaternion does not enter."""
    gyro, z = data[0][None, :3], data[1][None, :4].copy()
    z[0, 2, 1] = np.nan
    units = np.eye(6)[:, :, None] * np.eye(6)[:, None, :]
    q_slopes = np.array([units[:3].sum(axis=0) * 1e-5, np.zeros((6, 6))])
    r_slopes = np.array([np.zeros((3, 3)), np.array([[1e-4, 2e-5, 0], [2e-5, 1e-4, 0], [0, 0, 2e-4]])])
    model = tracker_model(degrees=20.0)

    def level(q, r):
        changed = model.replace(process_noise_cov=model.process_noise_cov + q)
        changed = changed.replace(measurement_noise_cov=model.measurement_noise_cov + r)
        return ran(changed, gyro, z, name).log_likelihoods.sum()

    exact = likelihood(model, gyro, z, q_slopes, r_slopes, filter=filters.make_filter(name, model))
    assert exact.values[0] == pytest.approx(level(0.0, 0.0), abs=1e-9)
    for slope, q, r in zip(exact.gradients[0], q_slopes, r_slopes, strict=True):
        assert slope == pytest.approx((level(1e-4 * q, 1e-4 * r) - level(-1e-4 * q, -1e-4 * r)) / 2e-4, rel=1e-6)


class Camera(gym.Env):
    """An env that measures the attitude of a body at rest."""

    action_space, observation_space = gym.spaces.Box(-1.0, 1.0, (3,)), gym.spaces.Box(-2.0, 2.0, (4,))

    def reset(self, *, seed=None, options=None):
        return np.array([1.0, 0.0, 0.0, 0.0], dtype=np.float32), {}

    def step(self, action):
        return self.reset()[0], 0.0, False, False, {}


def test_sessions_gates_python_and_wrapped_envs_have_the_numbers_of_a_batch(data, extended):
    """A quaternion beyond the gate is left out with all of its numbers, as one that misses a number is."""
    gyro, z = data
    filter_ = filters.ExtendedKalmanFilter(model=tracker_model())
    with interpreted():
        in_python = filters.run(filter_, inputs=gyro[:3], measurements=z[:4])
        lost = z[:4].copy()
        lost[2, 3], lost[3] = np.nan, np.nan
        in_part = filters.run(filter_, inputs=gyro[:3], measurements=lost)
    np.testing.assert_allclose(in_python.means, extended.means[:4], atol=1e-15)
    each_equal((in_part.innovations[2:], in_part.log_likelihoods[2:]), (0.0, 0.0))
    gated, strange = filter_.session(gate=5.0), rotations.product(z[2], rotations.exponential((0.0, 1.0, 0.0)))
    gated.start(z=z[0])
    for k, measured in enumerate([z[1], strange, lost[3]]):
        gated.step(gyro[k], measured)
    np.testing.assert_allclose(gated.mean, in_part.means[-1], atol=1e-14)
    np.testing.assert_array_equal(gated.rejected, [0, 1, 0])
    options = {"model": tracker_model(), "filter": "ekf", "observation": "measurement+estimate", "monitor": True}
    env = filters.EstimateState(Camera(), **options)
    env.reset(seed=1)
    observation, *_, info = env.step(np.zeros(3))
    assert observation.shape == (11,)
    assert info["innovation"].shape == (3,)
    assert info["health"].ok


@pytest.mark.skipif(shutil.which("gcc") is None, reason="needs gcc")
def test_the_filter_in_c_has_the_same_numbers(data, extended, tmp_path):
    """z has four numbers, the innovation three, and a missing one is not counted."""
    gyro, z = data
    c, memory = c_library(filters.ExtendedKalmanFilter(model=tracker_model()), "tracker", tmp_path)
    c.tracker_init(address(memory))
    for k in range(10):
        if k:
            c.tracker_predict(address(memory), address(gyro[k - 1].copy()))
        c.tracker_update(address(memory), address(z[k].copy()))
    expected = extended.means[9], extended.covs[9].ravel(), extended.innovations[9]
    each_close((memory[:7], memory[7:43], memory[43:46]), expected, atol=1e-14)
    assert memory[57:].view(np.int32)[0] == 3
    c.tracker_update(address(memory), address(np.array([1.0, 0.0, np.nan, 0.0])))
    assert memory[57:].view(np.int32)[0] == 0


@pytest.mark.usefixtures("as_python")
def test_a_first_attitude_is_where_the_star_tracker_points():
    """From a prior that holds for all attitudes; with two errors of the world, as well."""
    for turn in ([3.0, 0.0, 0.0], [0.3, -1.0, 2.0]):
        z = Turned.from_rotvec(turn).as_quat(scalar_first=True)
        for measured in ("body", "world"):
            (start,) = begun_at(tracker_model(measured=measured, degrees=1e4), -z)
            assert (
                Turned.from_quat(start[:4], scalar_first=True).inv() * Turned.from_rotvec(turn)
            ).magnitude() < 1e-3


@pytest.mark.usefixtures("as_python")
def test_a_direction_is_measured_of_a_state_of_numbers():
    """A camera sees where a target is: the update is that of the two angles, by matrices."""
    model = StateSpaceModel(
        transition=lambda x, u, c: x,
        observe=lambda x, c: x,  # its length does not matter
        process_noise_cov=[1e-6] * 3,
        measurement_noise_cov=[0.01**2] * 2,
        prior_mean=[3.0, 1.0, -2.0],
        prior_cov=[0.3**2] * 3,
        states=("x", "y", "z"),
        measurements=(Direction("camera"),),
        inputs=0,
    )
    z = np.array([3.2, 0.8, -1.9]) * 7.0  # nor does this one's
    belief, innovation = filters.ExtendedKalmanFilter(model=model).update(
        filters.ExtendedKalmanFilter(model=model).init(), z
    )
    x, u = model.prior_mean, z / np.linalg.norm(z)
    r, line = np.linalg.norm(x), model.prior_mean / np.linalg.norm(model.prior_mean)
    across = u - line * (line @ u)
    v = np.arccos(line @ u) * across / np.linalg.norm(across)  # in three dimensions, without a basis
    H = (np.eye(3) - np.outer(line, line)) / r
    K = 0.3**2 * H.T @ np.linalg.pinv(0.3**2 * H @ H.T + 0.01**2 * (np.eye(3) - np.outer(line, line)))
    each_close((belief.mean, belief.cov), (x + K @ v, (np.eye(3) - K @ H) * 0.3**2), atol=1e-12)
    assert np.linalg.norm(innovation.value) == pytest.approx(np.linalg.norm(v), abs=1e-14)


@pytest.mark.usefixtures("as_python")
def test_a_pose_is_measured_whole():
    """A motion capture system: with equal covariances the update goes half of the way, on the group."""
    model = StateSpaceModel(
        transition=lambda x, u, c: x,
        observe=lambda x, c: x,
        process_noise_cov=[1e-6] * 6,
        measurement_noise_cov=[0.1**2] * 6,
        prior_mean=[1.0] + [0.0] * 6,
        prior_cov=[0.1**2] * 6,
        states=(Pose("body"),),
        measurements=(Pose("motion capture", symbol="m", position="r"),),
        inputs=0,
    )
    d = np.array([0.2, -0.1, 0.3, 1.0, 2.0, -1.0])
    z = np.array(move(model.prior_mean, d, model.turns))
    filter_ = filters.ExtendedKalmanFilter(model=model)
    belief, innovation = filter_.update(filter_.init(), z)
    each_close((innovation.value, belief.mean), (d, poses.exponential(0.5 * d)), atol=1e-13)


def test_a_log_has_the_estimates_of_a_batch_for_either_sign(data, extended):
    """NIS and tables count innovations of the tangent; lengths and signs of columns are repaired."""
    gyro, z = data
    seen = z.copy()
    seen[7, 2] = np.nan
    model = tracker_model().replace(prior_mean=begun_at(tracker_model(), z[:1])[0])
    batch = ran(model, gyro, seen)
    symbols = [quantity.symbol for quantity in model.input_quantities]
    found = []
    for factor in (1.0, -1.3):
        table = {"time": DT * np.arange(31)}
        table |= dict(zip(symbols, np.vstack([gyro[:1], gyro]).T, strict=True))  # each acts until its row
        table |= {f"s_{axis}": factor * seen[:, i] for i, axis in enumerate("wxyz")}
        found.append(estimate(table, "ekf", tracker_model()))
        np.testing.assert_allclose(found[-1].means, batch.means, atol=1e-12)
        np.testing.assert_allclose(
            found[-1].innovations, np.where(np.arange(31)[:, None] == 7, np.nan, batch.innovations), atol=1e-12
        )
    assert "Quaternions of star tracker" in " ".join(verdict(found[1], findings(found[1])))
    result = findings(found[0], 1)
    v, S = batch.innovations[1:], batch.innovation_covs[1:]
    nis = np.einsum("ki,ki->k", v, np.linalg.solve(S, v[..., None])[..., 0])
    np.testing.assert_allclose(result.mean_nis, np.delete(nis, 6).sum() / 87, rtol=1e-9)
    assert [(part.quantity.symbol, part.quantity.unit, part.rows) for part in result.predictions] == [
        (f"s_{i}", "rad", 29) for i in (1, 2, 3)
    ]
    frame = batch.to_frame()
    np.testing.assert_array_equal(np.isnan(frame["innovation_s_1_rad"]), np.arange(31) == 7)
    assert {"measured_s_w", "innovation_std_s_3_rad"} < set(frame)
    assert len(batch.plot().axes) == 9
    watch = watch_of(Monitor(), found[0].filter)
    steps = zip(batch.innovations, batch.innovation_covs, seen, strict=True)
    assert "stuck" not in {alarm.test for step in steps for alarm in watch.step(*step).alarms}
    assert "stuck" not in {alarm.test for alarm in alarms_of(found[0], Monitor()).alarms}


def test_what_cannot_measure_rotations_says_so():
    model = tracker_model()
    for name in set(FILTERS) - {*TAKE_ROTATIONS, *ENSEMBLES, *OTHERS, "fuzzy", "kf"}:
        rule = "states and measurements must be numbers and angles here|must have an affine"
        refused(rule, lambda name=name: FILTERS[name](model=model).kernels())
    with pytest.raises(ValueError, match="make a quaternion a Rotation of `measurements`"):
        model.replace(measurements=("w", "x", "y", "z"), measured_turns=(), measurement_noise_cov=np.eye(4))
    rule = "observe must return a tuple of 4 measurements, as measurement_noise_cov"
    refused(rule, model.replace, observe=lambda x, c: x[:3])
    with pytest.raises(ValueError, match=r"must have shape \(K \+ 1, 4\)"):
        filters.run(
            filters.ExtendedKalmanFilter(model=model), inputs=np.zeros((1, 3)), measurements=np.ones((2, 3))
        )


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize(("name", "form"), [("ekf", "square-root"), ("ekf", "ud"), ("ukf", "square-root")])
def test_forms_have_the_same_estimates(name, form):
    """Of states and measurements that turn; the factors follow the reset."""
    gyro, z = tracked(20.0)
    model = tracker_model("body", "world", 20.0)
    plain, factored = (ran(model, gyro[:5], z[:6], name, form=kind) for kind in ("covariance", form))
    np.testing.assert_allclose(factored.means, plain.means, atol=1e-13)
    np.testing.assert_allclose(factored.covs, plain.covs, atol=1e-14)
    np.testing.assert_allclose(factored.log_likelihoods, plain.log_likelihoods, atol=1e-10)


def test_a_simulation_and_its_env_draw_errors_of_a_sensor_in_its_axes():
    """Both draw the same, and the mean NIS of the filter is that of three components, at a level of 1e-4."""
    model = tracker_model()
    keys, inputs = episode_keys(range(20)), np.full((20, 30, 3), 0.2)
    truth = simulate(model, keys, inputs)
    x, z = (Turned.from_quat(part.reshape(-1, part.shape[-1])[:, :4], scalar_first=True) for part in truth)
    errors = (x.inv() * z).as_rotvec() / SENSOR
    assert (np.abs(np.cov(errors.T) - np.eye(3)) < 0.25).all()
    estimates = ran(model, inputs, truth.measurements)
    v, S = estimates.innovations, estimates.innovation_covs
    nis = np.einsum("bki,bki->bk", v, np.linalg.solve(S, v[..., None])[..., 0])
    assert 2.6 < nis.mean() < 3.4
    env = ModelEnv(model)
    _, info = env.reset(seed=3)
    alone = simulate(model, episode_keys([3]), np.full((1, 2, 3), 0.2))
    for k in range(2):
        np.testing.assert_allclose(info["measurement"], alone.measurements[0, k], atol=1e-13)
        _, _, _, _, info = env.step(np.full(3, 0.2))
    assert info["measurement"].shape == (4,)
