"""The Kalman filter scheduled over the input against interpolated affine models, step by step."""

import numpy as np
import pytest

from filters import KalmanFilter, linearize, run, thruster_model
from tests.models import held_voltages, state_space
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate
from thruster_env.thruster.analysis import steady_state
from thruster_env.thruster.plant import make_plant

KEYS = np.zeros((1, 2))


def simulated(model, steps=100):
    inputs = held_voltages(1, steps // 10, hold=10, seed=1, limit=30.0)
    with interpreted():
        return simulate.simulate(model, episode_keys([1]), inputs).measurements, inputs


@pytest.mark.parametrize("count", [2, 5])
def test_it_is_the_kalman_filter_of_the_model_between_the_nearest_two(count):
    model = thruster_model()
    z, inputs = simulated(model)
    z[0, 5] = np.nan
    volts = np.linspace(-24.0, 24.0, count)
    states = [steady_state(make_plant().parameters, float(v))[:2] for v in volts]
    tables = [linearize(model, x, [v]).matrices() for x, v in zip(states, volts, strict=True)]

    def affine(u):
        """Each matrix by itself, linear in the voltage, constant beyond the ends."""
        stacked = [np.array([table[i] for table in tables]) for i in range(5)]
        right = int(np.clip(np.searchsorted(volts, u), 1, count - 1))
        part = np.clip((u - volts[right - 1]) / (volts[right] - volts[right - 1]), 0.0, 1.0)
        return [(1 - part) * matrix[right - 1] + part * matrix[right] for matrix in stacked]

    with interpreted():
        estimates = run(KalmanFilter(model=model, schedule=count), KEYS, inputs, z)
    x, p = model.prior_mean, model.prior_cov
    _, _, _, c, shift = affine(0.0)
    for k in range(101):
        if k > 0:
            a, b, offset, c, shift = affine(inputs[0, k - 1, 0])
            x = a @ x + b @ inputs[0, k - 1] + offset
            p = a @ p @ a.T + model.process_noise_cov
        if not np.isnan(z[0, k, 0]):
            s = c @ p @ c.T + model.measurement_noise_cov
            gain = p @ c.T / s
            x, p = x + gain @ (z[0, k] - c @ x - shift), p - gain @ c @ p
        np.testing.assert_allclose(estimates.means[0, k], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(estimates.covs[0, k], p, rtol=1e-9, atol=1e-9)


def test_compiled_batch_loop_and_python_agree():
    model = thruster_model()
    z, inputs = simulated(model)
    filter_ = KalmanFilter(model=model, schedule=5)
    estimates = run(filter_, KEYS, inputs, z)
    with interpreted():
        for one, other in zip(run(filter_, KEYS, inputs, z), estimates, strict=True):
            np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-12)
    belief, _ = filter_.update(filter_.init(), z[0, 0])
    for k, u in enumerate(inputs[0], start=1):
        belief, _ = filter_.update(filter_.predict(belief, u), z[0, k])
        np.testing.assert_allclose(belief.mean, estimates.means[0, k], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(belief.cov, estimates.covs[0, k], rtol=1e-12, atol=1e-12)


def test_on_the_thruster_it_is_much_better_than_the_filter_of_one_point():
    model = thruster_model()
    inputs = held_voltages(40, 20)
    drawn = simulate.simulate(model, episode_keys(range(40)), inputs)

    def rmse(filter_):
        errors = (run(filter_, np.zeros((40, 2)), inputs, drawn.measurements).means - drawn.states)[:, 50:]
        return np.sqrt(np.mean(errors**2, axis=(0, 1)))

    assert (rmse(KalmanFilter(model=model, schedule=9)) < 0.75 * rmse(KalmanFilter(model=model))).all()


def grow(x, u, c):
    return (x[0] * x[0] + u[0],)


def see(x, c):
    return (x[0],)


@pytest.mark.parametrize(
    ("numbers", "rule"),
    [
        ({"schedule": 3}, "schedule must come with .*operating points, but got schedule=3"),
        ({"schedule": 0}, "schedule must be a whole number of at least 1, but got 0"),
        ({"schedule": 2.5}, "schedule must be a whole number of at least 1, but got 2.5"),
    ],
)
def test_a_schedule_needs_points_to_lie_between(numbers, rule):
    model = state_space(
        grow, see, q=[0.1], r=[0.1], mean=[0.5], cov=[0.1], operating_state=[0.5], operating_input=[0.25]
    )
    with pytest.raises(ValueError, match=rule) as error:
        KalmanFilter(model=model, **numbers)
    assert "\n" not in str(error.value)


def test_a_schedule_has_the_covariance_form_only():
    with pytest.raises(ValueError, match="covariance form .*form='square-root'"):
        KalmanFilter(model=thruster_model(), schedule=5, form="square-root")
