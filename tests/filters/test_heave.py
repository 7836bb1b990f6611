"""The model `heave` in a simulated sea: its errors and its stated deviation, and how it depends on the period."""

import numpy as np
import pytest

from docs.scripts.attitude import errors, model_of, sea


@pytest.fixture(scope="module")
def waves():
    """Five minutes of a JONSWAP sea of 1.5 m and 6 s."""
    return sea(1.5, 6.0, 3.3, seed=0, seconds=300.0)


def test_heave_in_real_time(waves):
    """Within 2 % of the significant height, as its deviation says to 30 %; roll and pitch to the sensors' bias."""
    result = errors(model_of(1.5, 6.0), waves)
    assert result["heave"] < 0.02 * 1.5
    assert 0.7 < result["stated"] / result["heave"] < 1.3
    assert max(result["roll"], result["pitch"]) < 0.5


def test_a_wrong_period_costs_some_accuracy(waves):
    """A quarter of it, to either side, less than a high-pass filter's 10 %."""
    assert all(errors(model_of(1.5, 6.0 * factor), waves)["heave"] < 0.05 * 1.5 for factor in (0.8, 1.25))


def test_the_prior_is_that_of_the_sea():
    """A quarter of the significant height; the wave is stationary: F P F' + Q = P."""
    model = model_of(2.0, 8.0)
    x, c = model.prior_mean, model.constants
    F = np.array([model.transition(x + unit, np.zeros(3), c) for unit in np.eye(16)[11:15]])[:, 11:15].T
    P, Q = model.prior_cov[10:14, 10:14], model.process_noise_cov[10:14, 10:14]
    np.testing.assert_allclose(F @ P @ F.T + Q, P, rtol=1e-9, atol=1e-15)
    assert P[0, 0] ** 0.5 == pytest.approx(2.0 / 4.0 / (1.0 + (2 * np.pi / 8.0 / 2.5) ** 2))
