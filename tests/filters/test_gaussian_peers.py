"""Extended and unscented filters against other packages and textbooks: the thruster, range and bearing."""

import json
import math
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from filters import ExtendedKalmanFilter, UnscentedKalmanFilter, make_filter, run, thruster_model
from filters.bounds import posterior_bound
from tests.filters.textbooks import extended_filter
from tests.models import state_space
from thruster_env.core.angles import wrapped
from thruster_env.core.streams import filter_keys
from thruster_env.model.quantities import Quantity

# The thruster of `data/dynamax_thruster.py`: written a second time, from the print.
THRUSTER = json.loads((Path(__file__).parents[1] / "data" / "dynamax_thruster.json").read_text())
INPUTS = np.array(THRUSTER["voltages"])[None, :, None]
every_case = pytest.mark.parametrize("case", THRUSTER["cases"], ids=lambda case: case["channels"])
both_kinds = pytest.mark.parametrize("kind", ["ekf", "ukf"])


def model_of(case):
    channels = case["channels"].split(" and ")
    model = thruster_model(sensors=channels, measurement_noise_cov=case["r"], process_noise_cov=[1.0, 4e-4])
    return model.replace(prior_mean=[20.0, 0.3], prior_cov=[1.0, 0.01])


def filter_of(kind, case):
    if kind == "ekf":
        return ExtendedKalmanFilter(model=model_of(case))
    return UnscentedKalmanFilter(model=model_of(case), **numbers_of(case))


def numbers_of(case):
    return dict(zip(("alpha", "beta", "kappa"), case["points"], strict=True))


def assert_same(found, means, covs):
    """Means and covariances of every step agree, to 1e-6 of the standard deviations."""
    spread = np.sqrt(np.einsum("kii->ki", covs))
    assert np.abs((found.means[0] - means) / spread).max() < 1e-6
    assert np.abs((found.covs[0] - covs) / (spread[:, :, None] * spread[:, None, :])).max() < 1e-6


@pytest.mark.usefixtures("as_python")
@both_kinds
@every_case
def test_every_step_is_that_of_dynamax(case, kind):
    rows = np.array(case[kind])
    means, covs = rows[:, :2], rows[:, [2, 3, 3, 4]].reshape(-1, 2, 2)
    estimates = run(filter_of(kind, case), np.zeros((1, 2)), INPUTS, np.array([case["z"]]))
    assert_same(estimates, means, covs)  # dynamax adds 1e-9 to the diagonal of S before it solves: 4e-9 of S
    np.testing.assert_allclose(np.cumsum(estimates.log_likelihoods[0]), rows[:, 5], rtol=1e-6)


def test_the_bound_is_that_of_another_implementation_with_truths_of_its_own():
    rows = np.array(THRUSTER["bound"])
    bound = posterior_bound(model_of(THRUSTER["cases"][0]), INPUTS, truths=20_000, seed=3)[0]
    found = np.stack([bound[:, 0, 0], bound[:, 1, 1]])
    expected = rows[:, [0, 2]].T
    # The scored average of variances, as standard errors; and no step strays, start-up included.
    scored = np.sqrt(found[:, 50:].mean(axis=1)), np.sqrt(expected[:, 50:].mean(axis=1))
    np.testing.assert_allclose(*scored, rtol=1e-3)
    np.testing.assert_allclose(found, expected, rtol=1e-2)


DT, STEPS = 1.0, 30
SPECTRAL_DENSITY = 0.05  # of the acceleration, m^2/s^3
BEARING = Quantity("bearing", "b", "rad", True)
FLAGS = (True, False)  # of bearing and range
UKF = {"alpha": 0.5, "beta": 2.0, "kappa": -1.0}
TRUTH_0 = np.array([-800.0, -3.0, 45.0, -4.0])  # it passes the cut behind the sensor
BLOCK = np.array([[1.0, DT], [0.0, 1.0]])
F = np.kron(np.eye(2), BLOCK)
Q = np.kron(np.eye(2), SPECTRAL_DENSITY * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]]))
R = np.diag([0.005**2, 4.0])
P_0 = np.diag([25.0, 1.0, 25.0, 1.0])


def move(x, u, c):
    return (x[0] + DT * x[1], x[1], x[2] + DT * x[3], x[3])


def see(x, c):
    return (math.atan2(x[2], x[0]), math.hypot(x[0], x[2]))


def jacobian_of(x):
    square = x[0] ** 2 + x[2] ** 2
    root = math.sqrt(square)
    return np.array([[-x[2] / square, 0.0, x[0] / square, 0.0], [x[0] / root, 0.0, x[2] / root, 0.0]])


def target():
    prior = {"mean": TRUTH_0 + [3.0, 0.5, -4.0, -0.5], "cov": P_0}
    return state_space(move, see, q=Q, r=R, **prior, inputs=0, measurements=[BEARING, ("range", "r", "m")])


@pytest.fixture(scope="module")
def measurements():
    """Bearings and ranges (STEPS + 1, 2) of a target that crosses the cut."""
    rng, x, seen = np.random.default_rng(4), TRUTH_0, []
    for k in range(STEPS + 1):
        x = F @ x + rng.multivariate_normal(np.zeros(4), Q) if k else x
        z = np.array(see(x, ())) + rng.multivariate_normal(np.zeros(2), R)
        seen.append([wrapped(z[0]), z[1]])
    assert np.ptp(np.array(seen)[:, 0]) > 6.0
    return np.array(seen)


def estimated(name, measurements, **numbers):
    filter_ = make_filter(name, target(), **numbers)
    found = run(filter_, filter_keys([0]), np.empty((1, STEPS, 0)), measurements[None])
    return found.means[0], found.covs[0]


def stone_soup(name, measurements):
    """Means and covariances of Stone Soup's filter on the same numbers."""
    from stonesoup.models.measurement.nonlinear import CartesianToBearingRange
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import ExtendedKalmanPredictor, UnscentedKalmanPredictor
    from stonesoup.types.detection import Detection
    from stonesoup.types.hypothesis import SingleHypothesis
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import ExtendedKalmanUpdater, UnscentedKalmanUpdater

    class Sensor(CartesianToBearingRange):
        """With the exact Jacobian: its own is of one-sided differences, good to 5e-5 only."""

        def jacobian(self, state, **_):
            return jacobian_of(np.ravel(state.state_vector).astype(float))

    motion = CombinedLinearGaussianTransitionModel([ConstantVelocity(SPECTRAL_DENSITY)] * 2)
    sensor = Sensor(ndim_state=4, mapping=(0, 2), noise_covar=R)
    if name == "ekf":
        predictor, updater = ExtendedKalmanPredictor(motion), ExtendedKalmanUpdater(sensor)
    else:
        predictor, updater = UnscentedKalmanPredictor(motion, **UKF), UnscentedKalmanUpdater(sensor, **UKF)
    start, found = datetime(2024, 1, 1), []
    state = GaussianState(target().prior_mean, P_0, timestamp=start)
    for k, z in enumerate(measurements):
        moment = start + timedelta(seconds=k * DT)
        state = predictor.predict(state, timestamp=moment) if k else state
        seen = Detection(sensor.function(state, noise=False) * 0 + z[:, None], timestamp=moment)
        state = updater.update(SingleHypothesis(state, seen))
        found.append((np.ravel(state.mean).astype(float), np.asarray(state.covar, dtype=float)))
    return [np.array(part) for part in zip(*found, strict=True)]


def assert_alike(found, expected, tolerance):
    """Means within a part of their standard deviations, covariances relative to these."""
    spread = np.sqrt(np.einsum("kii->ki", expected[1]))
    assert (np.abs(found[0] - expected[0]) / spread).max() < tolerance
    assert (np.abs(found[1] - expected[1]) / (spread[:, :, None] * spread[:, None, :])).max() < tolerance


@pytest.mark.usefixtures("as_python")
class TestAgainst:
    def test_a_textbook_s_extended_filter(self, measurements):
        slopes = {"transition_jacobian": lambda x, u, c: F, "observe_jacobian": lambda x, c: jacobian_of(x)}
        means, covs, *_ = extended_filter(target().replace(**slopes), np.empty((STEPS, 0)), measurements)
        assert_alike(estimated("ekf", measurements), (means, covs), 1e-7)

    @pytest.mark.parametrize(("name", "numbers"), [("ekf", {}), ("ukf", UKF)])
    def test_stone_soup(self, name, numbers, measurements):
        pytest.importorskip("stonesoup")
        assert_alike(estimated(name, measurements, **numbers), stone_soup(name, measurements), 1e-6)

    def test_what_a_filter_makes_of_bearings_as_numbers(self, measurements):
        """Without its angle the extended filter is thrown off at the cut: it is this that is mended."""
        model = target().replace(measurements=None)
        found = run(make_filter("ekf", model), filter_keys([0]), np.empty((1, STEPS, 0)), measurements[None])
        mended, _ = estimated("ekf", measurements)
        assert np.abs(found.means[0] - mended)[:, 2].max() > 500.0
