"""Fading memory, H-infinity and considered states: textbook recursions written naively, closed forms, FilterPy."""

import numpy as np
import pytest

from filters import make_filter, run
from tests.models import random_affine, scalar_model, simulated

NO_MORE = {"fading": {"fading": 1.0}, "h-infinity": {"theta": 1e-12}, "schmidt": {}}


def naive(model, inputs, z, correct, fading=1.0):
    """Means and covariances of a linear filter: correct(x, P, v, H) after each prediction."""
    a, b, offset, c, shift = model.matrices()
    x, p, found = np.array(model.prior_mean), model.prior_cov, []
    for k, seen in enumerate(z):
        if k:
            x = a @ x + b @ inputs[k - 1] + offset
            p = fading**2 * a @ p @ a.T + model.process_noise_cov
        x, p = correct(x, p, seen - c @ x - shift, c)
        found.append((x, p))
    return [np.array(one) for one in zip(*found, strict=True)]


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", NO_MORE)
def test_equals_the_textbook(name):
    model = random_affine()
    inputs, z = simulated(model, 30)
    prior = model.prior_cov
    r, scale, theta = model.measurement_noise_cov, np.array([1.0, 2.0, 4.0]), 0.05

    def of_kalman(x, p, v, h):
        k = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        return x + k @ v, (np.eye(3) - k @ h) @ p

    def of_game(x, p, v, h):  # Simon, eq. (11.89); the prior is taken as it is
        bound = 0.0 if p is prior else theta
        inner = np.eye(3) - bound * np.diag(scale**-2.0) @ p + h.T @ np.linalg.inv(r) @ h @ p
        p = p @ np.linalg.inv(inner)
        return x + p @ h.T @ np.linalg.inv(r) @ v, p

    def considered(x, p, v, h):  # Simon, section 10.1: the last state is considered, in blocks
        s = h @ p @ h.T + r
        k = (p @ h.T @ np.linalg.inv(s))[:2]
        estimated = p[:2, :2] - k @ (h @ p)[:, :2]
        crossed = p[:2, 2:] - k @ (h @ p)[:, 2:]
        return x + np.append(k @ v, 0.0), np.block([[estimated, crossed], [crossed.T, p[2:, 2:]]])

    cases = {
        "fading": ({"fading": 1.05}, of_kalman, 1.05),
        "h-infinity": ({"theta": theta, "scale": scale}, of_game, 1.0),
        "schmidt": ({"considered": [-1]}, considered, 1.0),
    }
    numbers, correct, fading = cases[name]
    found = run(make_filter(name, model, **numbers), None, inputs, z)
    means, covs = naive(model, inputs[0], z[0], correct, fading)
    np.testing.assert_allclose(found.means[0], means, rtol=1e-9, atol=1e-11)
    np.testing.assert_allclose(found.covs[0], covs, rtol=1e-9, atol=1e-12)
    plain = run(make_filter("ekf", model), None, inputs, z)
    assert abs(plain.means - found.means).max() > 0.01  # the numbers matter


def test_fading_equals_the_filter_of_filterpy():
    filterpy = pytest.importorskip("filterpy.kalman")
    model = random_affine(2, 1, 1)
    a, b, _, c, _ = model.replace(prior_mean=np.zeros(2)).matrices()
    inputs, z = np.zeros((1, 25, 1)), np.random.default_rng(3).normal(size=(1, 26, 1))
    other = filterpy.FadingKalmanFilter(alpha=1.1, dim_x=2, dim_z=1)
    other.F, other.H, other.Q = a, c, np.array(model.process_noise_cov)
    other.R, other.P = np.array(model.measurement_noise_cov), np.array(model.prior_cov)
    flat = model.replace(prior_mean=np.zeros(2))
    ours = make_filter("fading", flat, fading=1.1)
    offset, shift = model.matrices()[2], model.matrices()[4]
    belief, other.x = ours.init(), np.zeros((2, 1))
    for k in range(25):
        belief, _ = ours.update(ours.predict(belief, inputs[0, k]), z[0, k])
        other.predict()
        other.x += offset[:, None]
        other.update(z[0, k][:, None] - shift[:, None])
        np.testing.assert_allclose(belief.mean, other.x[:, 0], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(belief.cov, other.P, rtol=1e-10)


def test_the_steady_state_of_a_scalar_game():
    """With F = H = Q = R = 1 Simon's example has P = 1 + P/(1 + (1 - theta) P), as predicted."""
    theta = 1.0 / 3.0
    model = scalar_model(a=[[1.0]], c=[[1.0]], process_noise_cov=[1.0], measurement_noise_cov=[1.0])
    filter_ = make_filter("h-infinity", model, theta=theta, scale=[1.0])
    belief = filter_.init()
    for _ in range(200):
        belief = filter_.predict(filter_.update(belief, [0.0])[0], np.zeros(model.inputs))
    before = 1.0 / (1.0 / belief.cov[0, 0] + theta)  # theta acts at the end of a prediction here
    assert before == pytest.approx((1.0 + np.sqrt(7.0)) / 2.0, rel=1e-12)


def test_a_bound_that_nothing_keeps_is_a_divergence():
    model = scalar_model()
    filter_ = make_filter("h-infinity", model, theta=100.0, scale=[0.1])
    belief, _ = filter_.update(filter_.predict(filter_.init(), [0.0]), [0.0])
    assert belief.divergences == 1
