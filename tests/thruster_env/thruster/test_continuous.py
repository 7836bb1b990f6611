"""The thruster in continuous time: the discrete one at its sample time, its equations solved at any other."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from thruster_env.model.continuous import noise_for_dt
from thruster_env.thruster.dynamics import rates
from thruster_env.thruster.model import continuous_thruster, logged_model


@pytest.mark.parametrize(
    "arguments",
    [{}, {"dt": 0.05}, {"dead_band": 0.5, "bias": {"thrust": 0.2}}, {"sensors": ["speed", "thrust"]}],
)
def test_at_its_sample_time_it_is_the_discrete_model(arguments):
    model, plant = logged_model(**arguments), continuous_thruster(**arguments)
    dt = model.constants.substep * model.substeps
    made = plant.at(dt)
    assert made.digest == model.digest
    assert (made.constants, made.substeps) == (model.constants, model.substeps)
    np.testing.assert_allclose(made.process_noise_cov, model.process_noise_cov, rtol=1e-12, atol=1e-15)
    for u in (-20.0, 0.3, 15.0):
        x = (40.0, 0.5)
        np.testing.assert_array_equal(
            made.transition(x, (u,), made.constants), model.transition(x, (u,), model.constants)
        )


@pytest.mark.parametrize("dt", [0.002, 0.013, 0.1])
def test_any_sample_time_follows_the_equations(dt):
    model = continuous_thruster().at(dt)
    x, c = (-60.0, -0.4), model.constants
    for _ in range(model.substeps):
        x = model.transition(x, (18.0,), c)
    exact = solve_ivp(
        lambda t, y: rates(tuple(y), (18.0, c.ambient_velocity), c),
        (0.0, dt),
        [-60.0, -0.4],
        rtol=1e-10,
        atol=1e-10,
    )
    np.testing.assert_allclose(x, exact.y[:, -1], rtol=1e-3)


def test_its_noise_is_that_of_the_definitions():
    plant, q = continuous_thruster(), logged_model().process_noise_cov
    for dt in (0.004, 0.03):
        np.testing.assert_allclose(plant.noise(dt), noise_for_dt(q, 0.01, dt, plant.slope), rtol=1e-9, atol=1e-15)
    small = plant.noise(1e-5)
    np.testing.assert_allclose(small, noise_for_dt(plant.densities, 1.0, 1e-5), rtol=5e-3)


def test_what_has_no_continuous_time_is_refused():
    with pytest.raises(ValueError, match="must have no lag"):
        continuous_thruster(lag={"thrust": 0.02})
    with pytest.raises(ValueError, match="process_noise_cov must be that of white noise in continuous time"):
        continuous_thruster(process_noise_cov=[1.0, 0.0])
