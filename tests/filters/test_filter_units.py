"""Filters whose estimates do not depend on the units of states and measurements."""

import numpy as np
import pytest

from filters import StateSpaceModel, run, thruster_model
from tests.models import KEY, rescaled, simulated, small, wide_model
from thruster_env.core.compiled import interpreted

KEYS = np.array([KEY])
UNIT_FREE = ["kf", "kf-steady", "ekf", "iekf", "ukf", "ckf", "enkf", "etkf", "ensrf", "denkf", "ienkf"]
UNIT_FREE += ["enkf-n", "rhf", "pf", "apf", "rbpf", "sage-husa", "vb", "ekf-robust", "mhe", "open-loop"]


# A power of two is exact; 1000 and 0.01 are what units do.
@pytest.mark.parametrize("name", UNIT_FREE)
@pytest.mark.parametrize(
    ("states", "channels"), [((1000.0, 0.01, 7.0), (60.0, 1e-3)), ((2.0**20,) * 3, (8.0, 1.0))]
)
def test_a_change_of_units_changes_no_estimate(name, states, channels):
    model = wide_model()
    other = rescaled(model, states, channels)
    inputs, measurements = simulated(model, 50)
    with interpreted():
        before = run(small(name, model), KEYS, inputs, measurements)
        after = run(small(name, other), KEYS, inputs, measurements * channels)
    np.testing.assert_allclose(after.means / states, before.means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(after.covs / np.outer(states, states), before.covs, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", ["kf", "kf-steady", "ukf"])
def test_units_that_differ_by_many_orders_change_no_estimate(name):
    test_a_change_of_units_changes_no_estimate(name, (1e9, 3e-9, 7e4), (2e-8, 5e8))


@pytest.mark.parametrize("name", UNIT_FREE)
@pytest.mark.parametrize("analytic", [True, False])
def test_a_change_of_units_of_a_nonlinear_model_changes_no_estimate(name, analytic):
    model, states, thrusts = thruster_model(), (2.0**10, 2.0**-7), 2.0**-10

    def physical(x):
        return x[0] / states[0], x[1] / states[1]

    def transition(x, u, c):
        omega, flow = model.transition(physical(x), u, c)
        return omega * states[0], flow * states[1]

    def transition_jacobian(x, u, c):
        rows = model.transition_jacobian(physical(x), u, c)
        return tuple(tuple(rows[i][j] * states[i] / states[j] for j in range(2)) for i in range(2))

    def observe(x, c):
        return (model.observe(physical(x), c)[0] * thrusts,)

    def observe_jacobian(x, c):
        (row,) = model.observe_jacobian(physical(x), c)
        return (tuple(row[j] * thrusts / states[j] for j in range(2)),)

    if not analytic:
        model = model.replace(transition_jacobian=None, observe_jacobian=None)
    other = StateSpaceModel(
        transition=transition,
        observe=observe,
        transition_jacobian=transition_jacobian if analytic else None,
        observe_jacobian=observe_jacobian if analytic else None,
        process_noise_cov=model.process_noise_cov * np.outer(states, states),
        measurement_noise_cov=model.measurement_noise_cov * thrusts**2,
        prior_mean=model.prior_mean * states,
        prior_cov=model.prior_cov * np.outer(states, states),
        constants=model.constants,
        substeps=model.substeps,
        operating_state=model.operating_state * states,
        operating_input=model.operating_input,
    )
    inputs, measurements = simulated(model, 50, level=8.0)
    with interpreted():
        before = run(small(name, model), KEYS, inputs, measurements)
        after = run(small(name, other), KEYS, inputs, measurements * thrusts)
    np.testing.assert_allclose(after.means / states, before.means, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(after.covs / np.outer(states, states), before.covs, rtol=1e-9, atol=1e-9)
