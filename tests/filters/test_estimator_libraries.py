"""FilterPy's, Stone Soup's, pykalman's and statsmodels' filters as estimators and as ours, angles included."""

import math

import numpy as np
import pytest

import filters
from filters import EstimateState, make_filter, run
from filters.consistency.nees import whiteness, whiteness_of
from filters.consistency.report import is_white, whiteness_sentence
from filters.estimators.foreign import Estimator
from filters.estimators.libraries import FilterPyEstimator, StoneSoupEstimator
from filters.logs.estimate import estimate
from filters.logs.findings import findings, verdict
from tests.filters.checks import refused
from tests.models import random_affine, scalar_model, simulated
from tests.thruster_env.core.test_angles import STEPS, data_of, rotated, turning
from thruster_env.core.angles import difference
from thruster_env.logs.log import Log
from tuning.evaluation.compare import compare, contender
from tuning.plants.thruster import find_scenario
from tuning.problems.data import held_out_seeds

UNSCENTED = "filters.estimators.libraries:unscented"


def assert_equal(one, other, rtol):
    for name, mine, theirs in zip(one._fields, one, other, strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=rtol, atol=rtol, err_msg=name)


def short(name, seeds=2, steps=60):
    data = find_scenario(name).data(held_out_seeds(0, seeds))
    z = data.measurements[:, : steps + 1].copy()
    z[0, 7] = np.nan
    return data.filter_keys, data.inputs[:, :steps], z


@pytest.mark.parametrize("name", ["nominal", "mismatch"])
def test_filterpy_s_unscented_filter_gives_what_ours_gives(name):
    pytest.importorskip("filterpy")
    problem = find_scenario(name)
    filters = [make_filter(kind, problem.model(**problem.true)) for kind in ("ukf", UNSCENTED)]
    ours, theirs = (run(one, *short(name)) for one in filters)
    assert_equal(ours, theirs, 1e-6)
    assert filters[1].name == "filterpy ukf" and filters[1].has_covariance


def test_it_stands_in_a_comparison_and_beside_an_env():
    pytest.importorskip("filterpy")
    import gymnasium as gym

    problem = find_scenario("nominal").replace(steps=60)
    (board,), _ = compare([contender("ukf"), contender(UNSCENTED)], [problem], held_out_seeds(0, 2))
    assert [row.label for row in board.rows] == ["ukf", UNSCENTED]
    assert board.rows[1].score_ratio.value == pytest.approx(1.0, abs=1e-9)
    assert board.rows[1].nees == pytest.approx(board.rows[0].nees, rel=1e-6)
    envs = [EstimateState(gym.make("BowThruster-v0"), filter=kind, observation="belief", alpha=0.5)
            for kind in ("ukf", UNSCENTED)]  # fmt: skip
    for seen in zip(
        *([env.reset(seed=1)[0]] + [env.step([9.0])[0] for _ in range(9)] for env in envs), strict=True
    ):
        np.testing.assert_allclose(*seen, rtol=1e-6, atol=1e-6)


def linear_filter(columns):
    """FilterPy's linear filter of an affine model without offset, x (n, 1) or (n,)."""
    peer = pytest.importorskip("filterpy.kalman")
    model = random_affine(n=3, m=2, p=2, seed=2)
    own = peer.KalmanFilter(3, 2, 2)
    own.F, own.B, f, own.H, h = model.matrices()
    own.x = model.prior_mean[:, None] if columns else model.prior_mean
    own.P, own.Q, own.R = model.prior_cov, model.process_noise_cov, model.measurement_noise_cov
    return model, own, f, h


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("columns", [True, False])
def test_its_linear_filter_leaves_out_missing_channels_as_ours(columns):
    model, own, f, h = linear_filter(columns)
    inputs, z = simulated(model)
    z[0, 4, 1] = z[0, 6] = np.nan

    def predict(filter, u):
        filter.predict(u=u)
        filter.x = filter.x + (f[:, None] if columns else f)  # the offset of the affine model

    theirs = make_filter(FilterPyEstimator(own, predict), model)
    ours = run(make_filter("kf", model), np.zeros((1, 2)), inputs, z)
    found = run(theirs, np.zeros((1, 2)), inputs, z - h)
    assert_equal(ours, found, 1e-9)
    assert theirs.name == "filterpy KalmanFilter"


def stone_soup_models(model):
    """The model's functions in Stone Soup's classes; the input is set before every step."""
    from stonesoup.models.base import GaussianModel
    from stonesoup.models.measurement import MeasurementModel
    from stonesoup.models.transition import TransitionModel
    from stonesoup.types.array import StateVectors

    def of_columns(function, state):
        return StateVectors(
            np.transpose([function(tuple(x)) for x in np.array(state.state_vector, dtype=float).T])
        )

    def moved(x, u):
        for _ in range(model.substeps):
            x = model.transition(x, u, model.constants)
        return x

    class Motion(TransitionModel, GaussianModel):
        ndim_state, input = model.n, None

        def function(self, state, noise=False, **kwargs):
            return of_columns(lambda x: moved(x, self.input), state)

        def jacobian(self, state, **kwargs):
            x, chain = tuple(state.state_vector.ravel()), np.eye(model.n)
            for _ in range(model.substeps):
                chain = np.array(model.transition_jacobian(x, self.input, model.constants)) @ chain
                x = model.transition(x, self.input, model.constants)
            return chain

        def covar(self, **kwargs):
            return model.process_noise_cov

    class Sensors(MeasurementModel, GaussianModel):
        ndim_meas = model.m

        def function(self, state, noise=False, **kwargs):
            return of_columns(lambda x: model.observe(x, model.constants), state)

        def jacobian(self, state, **kwargs):
            return np.array(model.observe_jacobian(tuple(state.state_vector.ravel()), model.constants))

        def covar(self, **kwargs):
            return model.measurement_noise_cov

    return Motion(), Sensors(ndim_state=model.n, mapping=tuple(range(model.n)))


def test_stone_soup_s_extended_filter_gives_what_ours_gives():
    pytest.importorskip("stonesoup")
    from stonesoup.predictor.kalman import ExtendedKalmanPredictor
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import ExtendedKalmanUpdater

    problem = find_scenario("mismatch")

    def extended(model):
        motion, sensors = stone_soup_models(model)
        predictor, updater = ExtendedKalmanPredictor(motion), ExtendedKalmanUpdater(sensors)
        prior = GaussianState(model.prior_mean, model.prior_cov)
        return StoneSoupEstimator(predictor, updater, prior, 0.01, lambda own, u: setattr(own, "input", tuple(u)))

    model = problem.model(**problem.true)
    ours, theirs = (run(make_filter(kind, model), *short("mismatch", 2, 30)) for kind in ("ekf", extended))
    assert_equal(ours, theirs, 1e-6)


pytestmark = pytest.mark.usefixtures("as_python")


@pytest.mark.parametrize("heading", [0.0, math.pi - 0.2, -3.0])
def test_filterpy_s_unscented_filter_crosses_the_cut_as_ours(heading):
    pytest.importorskip("filterpy")
    keys, inputs, measurements = data_of(turning(angles=False))
    model, seen = turning(heading, wraps=True), rotated(measurements, heading)
    ours, theirs = (run(make_filter(name, model), keys, inputs, seen) for name in ("ukf", UNSCENTED))
    assert np.abs(difference(theirs.means, ours.means, (False, True))).max() < 1e-8
    for part in ("covs", "innovations", "innovation_covs", "log_likelihoods"):
        np.testing.assert_allclose(getattr(theirs, part), getattr(ours, part), rtol=1e-7, atol=1e-8)
    assert np.isnan(seen).any() and inputs.shape[1] == STEPS


def extended_filter(peer, model):
    """FilterPy's extended filter of a model with n = m = 2."""
    own = peer.ExtendedKalmanFilter(2, 2)
    own.x, own.P, own.R = model.prior_mean.copy(), model.prior_cov.copy(), model.measurement_noise_cov.copy()
    return own


def test_what_does_not_know_angles_is_refused_in_one_line():
    peer = pytest.importorskip("filterpy.kalman")
    model = turning()
    points = peer.MerweScaledSigmaPoints(2, 1.0, 2.0, 0.0)
    plain = peer.UnscentedKalmanFilter(2, 2, 1.0, hx=lambda x: x, fx=lambda x, dt: x, points=points)
    lacking = "residual_x, x_mean_fn, residual_z, z_mean_fn"
    for estimator, said in (
        (FilterPyEstimator(plain), lacking),
        (
            FilterPyEstimator(extended_filter(peer, model), update_arguments={"HJacobian": None, "Hx": None}),
            "residual",
        ),
        (FilterPyEstimator(peer.KalmanFilter(2, 2)), "residual"),
    ):
        refused(
            f"must treat angles as such on a model with angles, but has no {said}$", make_filter, estimator, model
        )
        assert make_filter(estimator, turning(angles=False)).estimator is estimator


def test_an_extended_filter_with_a_residual_keeps_it_where_channels_are_missing():
    peer = pytest.importorskip("filterpy.kalman")
    model = turning()
    angles, asked = model.shape.measurement_angles, []

    def residual(a, b):
        asked.append(len(a))
        return difference(a, b, angles)

    def look(x):
        return np.array(model.observe(tuple(x), model.constants))

    arguments = {"HJacobian": lambda x: np.array([[0.0, 1.0], [1.0, 0.0]]), "Hx": look, "residual": residual}
    estimator = FilterPyEstimator(extended_filter(peer, model), update_arguments=arguments)
    make_filter(estimator, model)
    found = [estimator.reset((0, 0), z) for z in ([3.2, np.nan], [3.2, 0.1], [3.2 - 2 * math.pi, np.nan])]
    np.testing.assert_allclose(found[0].innovation, found[2].innovation, atol=1e-12)
    assert set(asked) == {2} and found[0].innovation[1] == 0.0 and abs(found[0].innovation[0]) <= math.pi


def test_stone_soup_s_numbers_are_no_angles():
    pytest.importorskip("stonesoup")
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import ExtendedKalmanUpdater

    prior = GaussianState([[1.0], [2.0]], np.eye(2))
    model = turning()
    good = CartesianToBearingRange(ndim_state=2, mapping=(0, 1), noise_covar=np.eye(2))
    make_filter(StoneSoupEstimator(None, ExtendedKalmanUpdater(good), prior, 1.0), model)
    plain = LinearGaussian(ndim_state=2, mapping=(0, 1), noise_covar=np.eye(2))
    with pytest.raises(ValueError, match="gives angles as such .* but gives numbers of z$"):
        make_filter(StoneSoupEstimator(None, ExtendedKalmanUpdater(plain), prior, 1.0), model)


class Told(Estimator):
    """An estimator that tells a mean and a variance, and what else it is asked to."""

    def __init__(self, *parts):
        self._parts = parts

    def reset(self, key, z):
        return (np.zeros(1), np.ones(1), *self._parts)

    def step(self, u, z):
        return self.reset(None, z)


def log_of_scalars():
    model = scalar_model()
    inputs, measurements = simulated(model, 60)
    return model, Log("run", 0.1, inputs[0], measurements[0], model.input_quantities, model.measurements)


def test_without_innovations_their_metrics_are_blank_and_a_sentence_says_so():
    model, log = log_of_scalars()
    found = estimate(log, Told(), model)
    told = findings(found)
    assert all(math.isnan(one.rmse) for one in told.predictions) and told.whiteness is None
    assert math.isnan(told.mean_nis) and math.isnan(told.log_likelihood) and told.rows == 46
    silent = "This estimator gives no innovation, so there is no NIS, no whiteness and no likelihood."
    assert verdict(found, told)[-1] == silent


def test_of_innovations_without_a_covariance_there_is_a_size_but_no_test():
    model, log = log_of_scalars()
    told = findings(estimate(log, Told(np.array([0.5])), model))
    assert told.predictions[0].rmse == 0.5 and math.isnan(told.mean_nis) and told.whiteness is None
    at_once = run(make_filter(Told(), model), np.zeros((2, 2)), np.zeros((2, 9, 1)), np.ones((2, 10, 1)))
    assert np.isnan(at_once.innovations).all() and np.isnan(at_once.innovation_covs).all()
    assert np.isnan(at_once.log_likelihoods).all() and (at_once.covs == 1.0).all()


def test_whiteness_of_nothing_is_no_whiteness():
    none = whiteness(np.full((2, 40, 1), np.nan), np.full((2, 40, 1, 1), np.nan))
    assert math.isnan(none.p_value) and math.isnan(none.share_inside) and is_white(none)
    assert whiteness_sentence(none).startswith("No test of whiteness")
    e = np.random.default_rng(1).normal(size=(3, 60, 1))
    silent = np.concatenate([e, np.zeros_like(e)], axis=2)
    present = np.broadcast_to([True, False], silent.shape)
    one, other = whiteness_of(e), whiteness_of(silent, present)
    assert other.p_value == pytest.approx(one.p_value) and other.share_inside == one.share_inside


F, H = np.array([[1.0, 0.1], [0.0, 0.9]]), np.array([[1.0, 0.0]])
Q, R = np.array([[0.02, 0.01], [0.01, 0.05]]), np.array([[0.3]])
Z = np.cumsum(np.random.default_rng(0).normal(size=60))


def close(ours, theirs):
    np.testing.assert_allclose(ours, theirs, rtol=1e-9, atol=1e-9)


def filterpy_filter(B=None):
    kalman = pytest.importorskip("filterpy.kalman")
    kf = kalman.KalmanFilter(dim_x=2, dim_z=1, dim_u=0 if B is None else 1)
    kf.F, kf.H, kf.Q, kf.R, kf.B = F.copy(), H.copy(), Q.copy(), R.copy(), B
    kf.x, kf.P = np.array([[0.5], [-1.0]]), np.array([[2.0, 0.3], [0.3, 1.0]])
    return kf


@pytest.mark.parametrize("update_first", [False, True])
def test_filterpy_gives_the_same_means_and_covariances(update_first):
    kf = filterpy_filter()
    ours = filters.run(filters.from_filterpy(kf, update_first=update_first), Z)
    means, covs, _, _ = kf.batch_filter(Z, update_first=update_first)
    close(ours.means, means[..., 0])
    close(ours.covs, covs)


def test_filterpy_with_inputs_from_its_present_state_and_back():
    b = np.array([[0.0], [0.5]])
    kf, u = filterpy_filter(b), np.sin(np.arange(60.0))
    for k in range(10):
        kf.predict(u[k])
        kf.update(Z[k])
    filter_ = filters.from_filterpy(kf, first_input=u[10:11])
    ours = filters.run(filter_, inputs=u[11:], measurements=Z[10:])
    back = filters.to_filterpy(filter_)
    back.update(Z[10])
    close(back.x[:, 0], ours.means[0])
    for k in range(10, 60):
        kf.predict(u[k])
        kf.update(Z[k])
    close(kf.x[:, 0], ours.means[-1])
    close(kf.P, ours.covs[-1])


def test_filterpy_with_an_input_for_each_measurement_predicts_before_the_first():
    kf, u = filterpy_filter(np.array([[0.3], [0.5]])), np.sin(0.4 + np.arange(60.0))
    filter_, after = filters.from_filterpy(kf), filters.from_filterpy(kf, update_first=True)
    started = filters.from_filterpy(kf, first_input=u[:1])
    means, covs, _, _ = kf.batch_filter(Z, us=u)
    runs = (
        filters.run(filter_, inputs=u, measurements=Z),
        filters.run(filter_, inputs=u[:, None, None], measurements=Z[:, None, None]),
        filters.run(after, inputs=u, measurements=Z, update_first=False),
        filters.run(started, inputs=u[1:], measurements=Z),
    )
    for estimates in runs:
        close(estimates.means, means[..., 0])
        close(estimates.covs, covs)
    with pytest.raises(ValueError, match="one fewer than measurements where the first is first_input="):
        filters.run(started, inputs=u, measurements=Z)
    with pytest.raises(ValueError, match="has done so: from_filterpy.kf, update_first=True"):
        filters.run(filter_, inputs=u, measurements=Z, update_first=False)


def test_pykalman_gives_the_same_with_offsets_and_missing_numbers():
    pykalman = pytest.importorskip("pykalman")
    kf = pykalman.KalmanFilter(
        transition_matrices=F,
        observation_matrices=H,
        transition_covariance=Q,
        observation_covariance=R,
        transition_offsets=[0.1, -0.2],
        observation_offsets=[0.7],
        initial_state_mean=[0.5, -1.0],
    )
    z = np.ma.masked_array(Z, np.arange(60) % 7 == 3)
    means, covs = kf.filter(z)
    ours = filters.run(filters.from_pykalman(kf), z.filled(np.nan))
    close(ours.means, means)
    close(ours.covs, covs)
    smoothed, _ = kf.smooth(z)
    close(filters.smooth(filters.from_pykalman(kf), z.filled(np.nan)).means, smoothed)


def test_a_matrix_of_each_step_is_an_input_of_a_model():
    pykalman = pytest.importorskip("pykalman")
    price = 50.0 + Z.cumsum()
    measured = 1.4 * price + 3.0 + 0.1 * Z
    kf = pykalman.KalmanFilter(
        transition_matrices=np.eye(2),
        observation_matrices=np.column_stack([price, np.ones_like(price)])[:, None, :],
        transition_covariance=1e-4 * np.eye(2),
        observation_covariance=[[1.0]],
        initial_state_mean=[0.0, 0.0],
        initial_state_covariance=np.eye(2),
    )
    refused(r"what changes is an input of a model.*other_packages\.md", filters.from_pykalman, kf)
    model = filters.StateSpaceModel(
        transition=lambda x, u, c: x,
        observe=lambda x, u, c: (x[0] * u[0] + x[1],),
        process_noise_cov=[1e-4, 1e-4],
        measurement_noise_cov=[1.0],
        prior_mean=[0.0, 0.0],
        prior_cov=[1.0 - 1e-4, 1.0 - 1e-4],
        inputs=1,
    )
    run = {"inputs": price, "measurements": measured, "update_first": False}
    close(filters.run(filters.make_filter("ekf", model), **run).means, kf.filter(measured)[0])
    close(filters.smooth(filters.make_filter("ekf", model), **run).means, kf.smooth(measured)[0])


def test_statsmodels_gives_the_same_states_and_likelihood():
    structural = pytest.importorskip("statsmodels.tsa.statespace.structural")
    model = structural.UnobservedComponents(Z, "lltrend")
    results = model.filter([0.3, 0.02, 0.05])
    ours = filters.run(filters.from_statsmodels(results), Z)
    scale = np.abs(results.filtered_state).max()
    np.testing.assert_allclose(ours.means, results.filtered_state.T, rtol=1e-9, atol=1e-9 * scale)
    close(ours.log_likelihoods, results.filter_results.llf_obs)
    without_noise = pytest.importorskip("statsmodels.tsa.statespace.sarimax").SARIMAX(Z, order=(1, 0, 0))
    refused("measurement_error=True", filters.from_statsmodels, without_noise.filter([0.5, 1.0]))


def test_a_continuous_system_is_sampled_and_its_gain_is_that_of_riccati():
    from scipy.linalg import expm, solve_discrete_are
    from scipy.signal import StateSpace, TransferFunction

    a, b, c = np.array([[0.0, 1.0], [-4.0, -0.4]]), np.array([[0.0], [1.0]]), np.array([[1.0, 0.0]])
    filter_ = filters.from_control(StateSpace(a, b, c, 0.0), [0.2], [0.3], dt=0.1, noise_input=b)
    f, g, _, h, _ = filter_.model.matrices()
    np.testing.assert_allclose(f, expm(0.1 * a), rtol=1e-12)
    np.testing.assert_allclose(g, np.linalg.solve(a, (f - np.eye(2)) @ b), rtol=1e-12)
    times = np.linspace(0.0, 0.1, 2001)
    flows = np.array([expm(a * t) @ b for t in times])[..., 0]
    q = 0.2 * np.trapezoid(flows[:, :, None] * flows[:, None, :], times, axis=0)
    np.testing.assert_allclose(filter_.model.process_noise_cov, q, rtol=1e-6)
    p = solve_discrete_are(f.T, h.T, filter_.model.process_noise_cov, [[0.3]])
    np.testing.assert_allclose(filter_.model.prior_cov, p, rtol=1e-8)
    sampled = StateSpace(f, g, h, 0.0, dt=0.1)
    again = filters.from_control(sampled, filter_.model.process_noise_cov, [0.3])
    np.testing.assert_allclose(again.model.numbers, filter_.model.numbers, rtol=1e-8)
    assert filters.from_control(TransferFunction([1.0], [1.0, 0.4, 4.0]), [0.0, 1.0], [0.3], dt=0.1).model.n == 2


def test_a_cross_covariance_of_the_noises_is_an_input_of_the_measurement():
    """As docs/other_packages.md says; against the joint Gaussian of all states and measurements."""
    a, b, c = np.array([[0.9, 0.2], [-0.3, 0.7]]), np.array([[0.5], [1.0]]), np.array([[1.0, 0.4]])
    q, r, n = np.array([[0.3, 0.1], [0.1, 0.2]]), np.array([[0.4]]), np.array([[0.2], [-0.1]])
    steps, rng = 12, np.random.default_rng(4)
    u, z = rng.normal(size=(steps - 1, 1)), rng.normal(size=(steps, 1))
    # Each state and measurement is a mean and a linear function of x_0 and all (w_k, v_k).
    size = 2 + 3 * steps
    x, row, rows, states = np.zeros(2), np.eye(2, size), [], []
    for k in range(steps):
        states.append((x, row))
        rows.append((c @ x, c @ row + np.eye(1, size, 4 + 3 * k)))
        x, row = a @ x + (b @ u[k] if k < steps - 1 else 0.0), a @ row + np.eye(2, size, 2 + 3 * k)
    cov = np.kron(np.eye(steps + 1), np.block([[q, n], [n.T, r]]))[1:, 1:]
    cov[:2, :2] = np.eye(2)

    def conditioned(k, last):
        of_z = np.concatenate([part for _, part in rows[: last + 1]])
        residual = z[: last + 1, 0] - np.concatenate([mean for mean, _ in rows[: last + 1]])
        gain = np.linalg.solve(of_z @ cov @ of_z.T, of_z @ cov @ states[k][1].T).T
        return states[k][0] + gain @ residual

    moved = n @ np.linalg.inv(r)
    model = filters.affine_model(
        A=a - moved @ c, B=np.hstack([b, moved]), C=c, Q=q - moved @ n.T, R=r, P0=np.eye(2)
    )
    for name in ("kf", "ekf", "ukf"):
        arguments = filters.make_filter(name, model), None, np.hstack([u, z[:-1]]), z
        expected = [conditioned(k, k) for k in range(steps)]
        np.testing.assert_allclose(filters.run(*arguments).means, expected, rtol=1e-9, atol=1e-12)
        expected = [conditioned(k, steps - 1) for k in range(steps)]
        np.testing.assert_allclose(filters.smooth(*arguments).means, expected, rtol=1e-9, atol=1e-12)


def test_what_does_not_fit_is_refused():
    from scipy.signal import StateSpace

    class Fading:
        F, H, Q, R, x, P, alpha = F, H, Q, R, np.zeros(2), np.eye(2), 1.02

    refused("alpha = 1, but got 1.02", filters.from_filterpy, Fading())
    refused("has no F", filters.from_filterpy, 3)
    kf = filterpy_filter(np.array([0.0, 0.5]))  # which FilterPy multiplies by u, too
    assert filters.from_filterpy(kf).model.matrices()[1].tolist() == [[0.0], [0.5]]
    kf.B = 0.5
    refused("must have shapes", filters.from_filterpy, kf)
    for converter in (filters.from_pykalman, filters.from_statsmodels):
        refused("but got 3", converter, 3)
    refused("dt=", filters.from_control, StateSpace([[-1.0]], [[1.0]], [[1.0]], [[0.0]]), [1.0], [1.0])
    with pytest.raises(ValueError, match=r"D must be zero, but got \[\[1.0\]\]: filter z - D u"):
        filters.from_control(StateSpace([[-1.0]], [[1.0]], [[1.0]], [[1.0]]), [1.0], [1.0], dt=0.1)
    resting = StateSpace(np.zeros((2, 2)), np.ones((2, 1)), [[1.0, 0.0]], 0.0)
    refused(r"\(prior_cov=\), but got none", filters.from_control, resting, [1.0, 1.0], [1.0], dt=0.1)
    with pytest.raises(ValueError, match=r"noise_input must have shape \(n, w\) with n = 2, but got \(3, 1\)"):
        filters.from_control(resting, [1.0], [1.0], dt=0.1, noise_input=[1.0, 0.0, 0.0])
    refused("must be 'kf' of an affine model", filters.to_filterpy, 3)


def test_filterpy_is_smoothed_as_by_its_own_smoother():
    kf = filterpy_filter()
    means, covs, _, _ = kf.batch_filter(Z)
    smoothed, smoothed_covs, _, _ = kf.rts_smoother(means, covs)
    kf = filterpy_filter()
    ours = filters.smooth(filters.from_filterpy(kf), Z)
    close(ours.means, smoothed[..., 0])
    close(ours.covs, smoothed_covs)
    started = filters.from_filterpy(filterpy_filter(np.array([[0.3], [0.5]])), first_input=[1.0])
    assert filters.smooth(started, inputs=np.ones(59), measurements=Z, lag=2).means.shape == (60, 2)
