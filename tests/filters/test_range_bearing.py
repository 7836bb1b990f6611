"""A target seen by range and bearing: against filters as textbooks have them, and against Stone Soup."""

import datetime
import math

import numpy as np
import pytest

from filters import make_filter, run
from tests.models import state_space
from thruster_env.core.angles import difference, wrapped
from thruster_env.core.streams import filter_keys
from thruster_env.model.quantities import Quantity

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


def textbook_ekf(measurements):
    x, p, found = target().prior_mean, P_0, []
    for k, z in enumerate(measurements):
        if k:
            x, p = F @ x, F @ p @ F.T + Q
        h = jacobian_of(x)
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + R)
        x = x + gain @ difference(z, np.array(see(x, ())), FLAGS)
        p = (np.eye(4) - gain @ h) @ p
        found.append((x, p))
    return [np.array(part) for part in zip(*found, strict=True)]


def textbook_ukf(measurements, alpha, beta, kappa):
    """With all points and weights, and the circular mean of bearings."""
    n, c = 4, alpha**2 * (4 + kappa)
    mean_weights = np.full(2 * n + 1, 0.5 / c)
    mean_weights[0] = 1.0 - n / c
    weights = mean_weights + np.eye(2 * n + 1)[0] * (1.0 - alpha**2 + beta)
    x, p, found = target().prior_mean, P_0, []
    for k, z in enumerate(measurements):
        if k:
            x, p = F @ x, F @ p @ F.T + Q
        root = np.sqrt(c) * np.linalg.cholesky(p)
        points = np.vstack([x, x + root.T, x - root.T])
        y = np.array([see(point, ()) for point in points])
        bearing = math.atan2(mean_weights @ np.sin(y[:, 0]), mean_weights @ np.cos(y[:, 0]))
        expected = np.array([bearing, mean_weights @ y[:, 1]])
        e, d = difference(y, expected, FLAGS), points - x
        s = (weights[:, None] * e).T @ e + R
        gain = (weights[:, None] * d).T @ e @ np.linalg.inv(s)
        x, p = x + gain @ difference(z, expected, FLAGS), p - gain @ s @ gain.T
        found.append((x, p))
    return [np.array(part) for part in zip(*found, strict=True)]


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
    start, found = datetime.datetime(2024, 1, 1), []
    state = GaussianState(target().prior_mean, P_0, timestamp=start)
    for k, z in enumerate(measurements):
        moment = start + datetime.timedelta(seconds=k * DT)
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
        assert_alike(estimated("ekf", measurements), textbook_ekf(measurements), 1e-7)

    def test_a_textbook_s_unscented_filter(self, measurements):
        assert_alike(estimated("ukf", measurements, **UKF), textbook_ukf(measurements, **UKF), 1e-6)

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
