"""The information and square-root forms of the Kalman filter: the same estimates, each with its own strength."""

import math
from fractions import Fraction

import numpy as np
import pytest

from filters import KalmanFilter, run, thruster_model
from filters.engine.session import Session
from tests.models import affine, rescaled, simulated, wide_model
from tests.oracles import each_close
from thruster_env.core.compiled import interpreted

KEYS = np.zeros((1, 2))
FORMS = ["information", "square-root"]


@pytest.fixture(params=FORMS)
def form(request):
    return request.param


@pytest.mark.parametrize("kind", [wide_model, thruster_model])
def test_every_form_gives_the_same_estimates(form, kind):
    model = kind()
    inputs, z = simulated(model)
    z[0, 10, 0] = z[0, 20:23] = np.nan
    with interpreted():
        estimates = run(KalmanFilter(model=model, form=form), KEYS, inputs, z)
        expected = run(KalmanFilter(model=model), KEYS, inputs, z)
    each_close(estimates, expected, rtol=1e-10, atol=1e-10)


def test_compiled_batch_loop_session_and_python_agree(form):
    model = wide_model()
    inputs, z = simulated(model, 30)
    z[0, 7, 1] = z[0, 9] = np.nan
    filter_ = KalmanFilter(model=model, form=form)
    close = {"rtol": 1e-12, "atol": 1e-12}
    estimates = run(filter_, KEYS, inputs, z)
    with interpreted():
        each_close(run(filter_, KEYS, inputs, z), estimates, **close)
    session = Session(filter_)
    session.start(KEYS[0], z[0, 0])
    belief, _ = filter_.update(filter_.init(), z[0, 0])
    for k, u in enumerate(inputs[0], start=1):
        session.step(u, z[0, k])
        belief, innovation = filter_.update(filter_.predict(belief, u), z[0, k])
        np.testing.assert_allclose(session.mean, estimates.means[0, k], **close)
        np.testing.assert_allclose(session.cov, estimates.covs[0, k], **close)
        np.testing.assert_allclose(belief.mean, estimates.means[0, k], **close)
        np.testing.assert_allclose(belief.cov, estimates.covs[0, k], **close)
        assert innovation.log_likelihood == pytest.approx(estimates.log_likelihoods[0, k], rel=1e-11)


def test_covariances_are_symmetric_and_positive(form):
    model = wide_model()
    inputs, z = simulated(model)
    with interpreted():
        estimates = run(KalmanFilter(model=model, form=form), KEYS, inputs, z)
    for covs in (estimates.covs[0], estimates.innovation_covs[0]):
        assert (covs == covs.transpose(0, 2, 1)).all()
        assert (np.linalg.eigvalsh(covs) > 0).all()


def test_noise_may_vary_from_step_to_step(form):
    model = wide_model()
    inputs, z = simulated(model, 20)
    factors = np.random.default_rng(2).uniform(0.1, 10.0, size=21)[:, None, None]
    noise = {
        "process_noise_covs": factors[1:] * model.process_noise_cov,
        "measurement_noise_covs": factors * model.measurement_noise_cov,
    }
    with interpreted():
        estimates = run(KalmanFilter(model=model, form=form), KEYS, inputs, z, **noise)
        expected = run(KalmanFilter(model=model), KEYS, inputs, z, **noise)
    each_close(estimates, expected, rtol=1e-10, atol=1e-10)


def test_a_change_of_units_changes_no_estimate(form):
    model, units = wide_model(), np.array([1000.0, 0.01, 7.0])
    other = rescaled(model, units, np.ones(2))
    inputs, z = simulated(model)
    with interpreted():
        before = run(KalmanFilter(model=model, form=form), KEYS, inputs, z)
        after = run(KalmanFilter(model=other, form=form), KEYS, inputs, z)
    np.testing.assert_allclose(after.means / units, before.means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(after.covs / np.outer(units, units), before.covs, rtol=1e-9, atol=1e-9)


def test_the_square_root_form_starts_from_an_exact_state_and_the_information_form_refuses_it():
    model = wide_model(prior_cov=np.diag([1.0, 0.0, 0.0]))
    inputs, z = simulated(model)
    with interpreted():
        estimates = run(KalmanFilter(model=model, form="square-root"), KEYS, inputs, z)
        expected = run(KalmanFilter(model=model), KEYS, inputs, z)
    each_close(estimates, expected, rtol=1e-10, atol=1e-10)
    with pytest.raises(ValueError, match="prior_cov must be positive definite"):
        KalmanFilter(model=model, form="information")


def test_the_square_root_form_keeps_its_digits_where_covariances_lose_theirs():
    """Two nearly equal channels, almost without noise: P (2, 2) then has a condition of 1e18."""
    small = 1e-9
    slope = 1.0 + small
    prior = {"mean": [0.0, 0.0], "cov": [1.0, 1.0]}
    model = affine(
        np.eye(2), np.zeros((2, 1)), [[1.0, 1.0], [1.0, slope]], q=[0.0, 0.0], r=[small**2, small**2], **prior
    )
    filter_ = KalmanFilter(model=model, form="square-root")
    with interpreted():
        belief, _ = filter_.update(filter_.init(), [0.0, 0.0])
    root = belief.extras.reshape(2, 2)
    # Y = I + C' C / small^2 and its inverse, in fractions.
    e, weight = Fraction(slope), 1 / Fraction(small**2)
    y_00, y_01, y_11 = 1 + 2 * weight, (1 + e) * weight, 1 + (1 + e * e) * weight
    det = y_00 * y_11 - y_01 * y_01
    np.testing.assert_allclose(root[0, 0], math.sqrt(y_11 / det), rtol=1e-6)
    np.testing.assert_allclose(root[1, 0], -float(y_01 / det) / root[0, 0], rtol=1e-6)
    np.testing.assert_allclose(root[1, 1], math.sqrt(1 / y_11), rtol=1e-6)  # 1e-9 of root[0, 0]
    assert root[1, 1] ** 2 < 1e-17 * belief.cov[1, 1]  # of this the covariance has nothing left


def test_the_root_is_carried_in_the_belief():
    filter_ = KalmanFilter(model=wide_model(), form="square-root")
    with interpreted():
        belief = filter_.init()
        for _ in range(3):
            root = belief.extras.reshape(3, 3)
            assert (root == np.tril(root)).all()
            np.testing.assert_allclose(root @ root.T, belief.cov, rtol=1e-14, atol=1e-15)
            belief, _ = filter_.update(filter_.predict(belief, [1.0, 0.0]), [1.0, 2.0])


@pytest.mark.parametrize("name", ["cholesky", None, 3])
def test_an_unknown_form_is_refused(name):
    with pytest.raises(ValueError, match="form must be .*covariance.*information.*square-root.* but got"):
        KalmanFilter(model=wide_model(), form=name)
