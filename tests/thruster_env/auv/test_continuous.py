"""The vehicle in continuous time is the discrete one at its sample time."""

import numpy as np
import pytest
from scipy.linalg import expm

from thruster_env.auv.model import auv_model, continuous_auv


@pytest.mark.parametrize(
    "arguments",
    [
        {},
        {"states": "velocities"},
        {"states": "velocities", "attitude": "level"},
        {"states": "velocities", "attitude": "measured"},
        {"states": "navigation"},
        {"states": "current", "dt": 0.1},
        {"propeller_torque": None},
    ],
)
def test_at_its_sample_time_it_is_the_discrete_model(arguments):
    model, plant = auv_model(**arguments), continuous_auv(**arguments)
    made = plant.at(arguments.get("dt", 0.05))
    assert made.digest == model.digest
    assert (made.constants, made.substeps) == (model.constants, model.substeps)
    np.testing.assert_allclose(made.process_noise_cov, model.process_noise_cov, rtol=1e-10, atol=1e-16)


def test_two_half_steps_are_a_whole_one_in_mean_and_noise():
    """A linear system's Q of a step is F Q_half F' + Q_half of two halves."""
    plant = continuous_auv(states="navigation")
    half, whole = plant.at(0.025), plant.at(0.05)
    x, u, c = tuple(plant.point[0]), tuple(plant.point[1]), half.constants
    middle = half.transition(x, u, c)
    np.testing.assert_allclose(
        half.transition(middle, u, c), whole.transition(x, u, whole.constants), rtol=1e-3, atol=2e-7
    )
    f, q = expm(0.025 * plant.slope), half.process_noise_cov
    np.testing.assert_allclose(f @ q @ f.T + q, whole.process_noise_cov, rtol=1e-8, atol=1e-14)


def test_a_model_of_other_rates_is_refused():
    with pytest.raises(ValueError, match="rates must be those of the model, whose step from"):
        continuous_auv(integration="euler")
