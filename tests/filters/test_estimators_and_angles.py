"""Estimators of other packages on models with angles, and those that give no innovation."""

import math

import numpy as np
import pytest

from filters import make_filter, run
from filters.consistency.nees import whiteness, whiteness_of
from filters.consistency.report import is_white, whiteness_sentence
from filters.estimators.foreign import Estimator
from filters.estimators.libraries import FilterPyEstimator, StoneSoupEstimator
from filters.logs.estimate import estimate
from filters.logs.findings import findings, verdict
from tests.models import scalar_model, simulated
from tests.thruster_env.core.test_angles import STEPS, data_of, rotated, turning
from thruster_env.core.angles import difference
from thruster_env.logs.log import Log

UNSCENTED = "filters.estimators.libraries:unscented"
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


def extended(peer, model):
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
        (FilterPyEstimator(extended(peer, model), update_arguments={"HJacobian": None, "Hx": None}), "residual"),
        (FilterPyEstimator(peer.KalmanFilter(2, 2)), "residual"),
    ):
        with pytest.raises(
            ValueError, match=f"must treat angles as such on a model with angles, but has no {said}$"
        ):
            make_filter(estimator, model)
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
    estimator = FilterPyEstimator(extended(peer, model), update_arguments=arguments)
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
