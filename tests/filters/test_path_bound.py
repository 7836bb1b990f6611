"""The Riccati covariance along the noise-free path: by naive loops, and with parts of measurements missing."""

import numpy as np
import pytest

from filters.bounds import path_bound, posterior_bound, riccati_covariances
from tuning.plants.thruster import find_scenario

pytestmark = pytest.mark.usefixtures("as_python")


def naive(model, inputs, missing):
    x, p, found = np.array(model.prior_mean), np.array(model.prior_cov), []
    for k in range(len(inputs) + 1):
        if k > 0:
            for _ in range(model.substeps):
                f = np.array(model.transition_jacobian(tuple(x), tuple(inputs[k - 1]), model.constants))
                x, p = np.array(model.transition(tuple(x), tuple(inputs[k - 1]), model.constants)), f @ p @ f.T
            p = p + model.process_noise_cov
        h = np.array(model.observe_jacobian(tuple(x), model.constants))[~missing[k]]
        r = model.measurement_noise_cov[~missing[k]][:, ~missing[k]]
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        p = p - gain @ h @ p
        found.append(p)
    return np.array(found)


@pytest.mark.parametrize("sensors", [["thrust"], ["thrust", "speed"]])
def test_the_bound_is_the_naive_recursion_also_where_measurements_are_missing(sensors):
    model = find_scenario("nominal").replace(sensors=sensors, measurement_noise_cov=[0.25] * len(sensors)).model()
    rng = np.random.default_rng(0)
    inputs, missing = rng.uniform(-12, 12, (2, 30, 1)), rng.random((2, 31, len(sensors))) < 0.4
    found = path_bound(model, inputs, missing)
    for b in range(2):
        np.testing.assert_allclose(found[b], naive(model, inputs[b], missing[b]), rtol=1e-8, atol=1e-15)
    whole = np.zeros_like(missing[0])
    np.testing.assert_allclose(path_bound(model, inputs)[1], naive(model, inputs[1], whole), rtol=1e-8, atol=1e-15)


def test_for_a_linear_model_it_tends_to_the_steady_state_and_is_the_posterior_bound():
    model = find_scenario("published_tunnel").model()
    inputs = np.zeros((1, 60, 1))
    found = path_bound(model, inputs)[0]
    np.testing.assert_allclose(found[-1], riccati_covariances(model)[1], rtol=1e-10)
    np.testing.assert_allclose(found, posterior_bound(model, inputs, truths=2)[0], rtol=1e-8)
