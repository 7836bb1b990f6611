"""The gradient of the likelihood of a model whose matrices are arrays, with channels that are missing."""

import numpy as np
import pytest

from filters.sensitivity import likelihood
from thruster_env.auv.model import auv_model
from thruster_env.core.compiled import interpreted

PLACES = (0, 4, 6)  # of Q; with them one of R


@pytest.mark.slow
def test_the_gradient_on_eight_states_is_that_of_central_differences():
    model, rng = auv_model(states="motion"), np.random.default_rng(1)
    n, m, steps = model.n, model.m, 4
    inputs = np.tile(model.operating_input, (2, steps, 1))
    measurements = np.eye(m)[0] + 0.03 * rng.standard_normal((2, steps + 1, m))
    measurements[0, 2, 1] = measurements[1, 1:3, 0] = np.nan
    logarithms = np.log([*np.diag(model.process_noise_cov)[list(PLACES)], model.measurement_noise_cov[0, 0]])

    def at(logarithms):
        q, r = model.process_noise_cov.copy(), model.measurement_noise_cov.copy()
        q[PLACES, PLACES], r[0, 0] = np.exp(logarithms[:3]), np.exp(logarithms[3])
        dq, dr = np.zeros((4, n, n)), np.zeros((4, m, m))
        dq[range(3), PLACES, PLACES], dr[3, 0, 0] = q[PLACES, PLACES], r[0, 0]
        changed = model.replace(process_noise_cov=q, measurement_noise_cov=r)
        return likelihood(changed, inputs, measurements, dq, dr)

    with interpreted():
        found = at(logarithms).gradients
        pairs = [[at(logarithms + sign * step).values for sign in (1, -1)] for step in 1e-4 * np.eye(4)]
    expected = np.array([(above - below) / 2e-4 for above, below in pairs]).T
    assert (abs(found) > 1e-4).all()
    np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-8)
