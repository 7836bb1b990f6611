"""Baselines against closed forms: the open loop, the inverted measurement, and the inverted low-pass."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

from filters import Inversion, LowPass, OpenLoop, run, thruster_model
from filters.baselines import component_solver
from tests.models import state_space
from tests.oracles import each_close
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate

KEYS = np.zeros((1, 2))
KINDS = [OpenLoop, Inversion, LowPass]

pytestmark = pytest.mark.usefixtures("as_python")


def drift(x, u, c):
    return (0.8 * x[0] + u[0], 0.5 * x[1] + 0.1 * x[0])


def bump(x, c):
    """Two roots in x[1] below the top at 2 + x[0], none above."""
    return (2.0 + x[0] - (x[1] - 1.0) ** 2,)


def bumpy_model(**changes):
    return state_space(drift, bump, q=[0.1, 0.1], r=[0.2], mean=[1.0, 0.2], cov=[0.3, 0.15], **changes)


def open_loop(model, inputs):
    states = [np.array(model.prior_mean)]
    for u in inputs[0]:
        x = tuple(states[-1])
        for _ in range(model.substeps):
            x = model.transition(x, u, model.constants)
        states.append(np.array(x))
    return np.array(states)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("make", [bumpy_model, thruster_model])
def test_a_baseline_says_nothing_of_its_error(kind, make):
    model = make()
    inputs = np.random.default_rng(3).uniform(-5.0, 5.0, size=(1, 12, 1))
    z = simulate.simulate(model, episode_keys([4]), inputs).measurements
    estimates = run(kind(model=model), KEYS, inputs, z)
    assert not kind.has_covariance
    for part in (estimates.covs, estimates.innovation_covs, estimates.log_likelihoods, estimates.divergences):
        assert (part == 0.0).all()
    assert np.isfinite(estimates.means).all() and np.isfinite(estimates.innovations).all()


def test_the_open_loop_is_the_model_from_its_prior_mean_whatever_is_measured():
    model = thruster_model()
    inputs = np.random.default_rng(3).uniform(-12.0, 12.0, size=(1, 30, 1))
    z = np.random.default_rng(4).normal(size=(1, 31, 1)) * 100.0
    estimates = run(OpenLoop(model=model), KEYS, inputs, z)
    expected = open_loop(model, inputs)
    np.testing.assert_allclose(estimates.means[0], expected, rtol=1e-12)
    seen = [model.observe(tuple(x), model.constants) for x in expected]
    np.testing.assert_allclose(estimates.innovations[0], z[0] - seen, rtol=1e-9, atol=1e-9)


def inverted(model, x, z):
    """The closed form for `bump`: the root nearest to x[1], else the top."""
    height = 2.0 + x[0] - z
    if height < 0.0:
        return 1.0
    roots = 1.0 + np.array([-1.0, 1.0]) * math.sqrt(height)
    return roots[np.argmin(np.abs(roots - x[1]))]


def test_inversion_finds_the_nearest_root_and_else_the_extremum():
    model = bumpy_model()
    inputs = np.random.default_rng(1).normal(size=(1, 60, 1))
    z = simulate.simulate(model, episode_keys([4]), inputs).measurements
    z[0, 10::7] += 6.0  # above the top
    states = open_loop(model, inputs)
    expected = np.array([inverted(model, x, v[0]) for x, v in zip(states, z[0], strict=True)])
    assert 5 < (expected == 1.0).sum() < 40  # both cases occur
    estimates = run(Inversion(model=model, reach=20.0), KEYS, inputs, z)
    np.testing.assert_allclose(estimates.means[0, :, 0], states[:, 0], rtol=1e-12)
    np.testing.assert_allclose(estimates.means[0, :, 1], expected, atol=1e-7)  # a flat top is found to 1e-8


def test_on_the_thruster_the_flow_is_what_the_thrust_says():
    model = thruster_model()
    inputs = np.repeat(np.random.default_rng(2).uniform(-12.0, 12.0, size=(1, 5, 1)), 20, axis=1)
    z = simulate.simulate(model, episode_keys([2]), inputs).measurements
    found = run(Inversion(model=model), KEYS, inputs, z).means[0]
    states = open_loop(model, inputs)
    np.testing.assert_allclose(found[:, 0], states[:, 0], rtol=1e-12)
    for x, v, estimate in zip(states[60:], z[0, 60:, 0], found[60:], strict=True):

        def misfit(flow, omega=x[0], thrust=v):
            return model.observe((omega, flow), model.constants)[0] - thrust

        assert misfit(estimate[1]) == pytest.approx(0.0, abs=1e-8)
        root = brentq(misfit, x[1] - 3.0, x[1] + 3.0, xtol=1e-13)
        assert estimate[1] == pytest.approx(root, abs=1e-10)


def test_the_low_pass_filters_the_measurement_before_it_is_inverted():
    model = bumpy_model()
    inputs = np.zeros((1, 8, 1))
    z = np.array([[-1.0, 0.5, np.nan, 1.0, -2.0, 0.0, np.nan, np.nan, 0.3]])[..., None]
    keep = math.exp(-1.0 / 3.0)
    smooth, values = z[0, 0, 0], []
    for value in z[0, :, 0]:
        smooth = smooth if math.isnan(value) else keep * smooth + (1.0 - keep) * value
        values.append(smooth)
    estimates = run(LowPass(model=model, time_constant=3.0, reach=20.0), KEYS, inputs, z)
    states = open_loop(model, inputs)
    expected = [inverted(model, x, v) for x, v in zip(states, values, strict=True)]
    np.testing.assert_allclose(estimates.means[0, :, 1], expected, atol=1e-7)


def test_a_short_time_constant_makes_it_the_inversion():
    model = thruster_model()
    inputs = np.full((1, 20, 1), 6.0)
    z = simulate.simulate(model, episode_keys([2]), inputs).measurements
    one = run(LowPass(model=model, time_constant=1e-3), KEYS, inputs, z)
    other = run(Inversion(model=model), KEYS, inputs, z)
    np.testing.assert_allclose(one.means, other.means, rtol=1e-12)


@pytest.mark.parametrize("kind", [Inversion, LowPass])
def test_before_anything_is_measured_it_is_the_open_loop(kind):
    model = bumpy_model()
    inputs = np.ones((1, 5, 1))
    estimates = run(kind(model=model), KEYS, inputs, np.full((1, 6, 1), np.nan))
    np.testing.assert_allclose(estimates.means[0], open_loop(model, inputs), rtol=1e-12)
    assert (estimates.innovations == 0.0).all()


def pair(x, c):
    return (x[0] * x[0], x[0] + x[1])


def test_component_and_channel_can_be_chosen():
    model = bumpy_model(observe=pair, measurement_noise_cov=[0.1, 0.1])
    z = np.array([[[4.0, 7.0]]])
    of_first = run(Inversion(model=model, inverted=0, reach=9.0), KEYS, np.zeros((1, 0, 1)), z)
    of_second = run(Inversion(model=model, inverted=1, channel=-1, reach=9.0), KEYS, np.zeros((1, 0, 1)), z)
    each_close((of_first.means[0, 0], of_second.means[0, 0]), ([2.0, 0.2], [1.0, 6.0]))


def test_a_function_that_does_not_depend_on_the_component_leaves_it():
    solve = component_solver(drift_free, 2, 1, 0)
    assert solve((1.0, 5.0), 3.0, (), 10.0) == (1.0, 5.0)


def drift_free(x, c):
    return (x[0],)


def test_a_root_beyond_reach_is_none():
    solve = component_solver(pair, 2, 0, 0)
    assert solve((1.0, 0.0), 9.0, (), 3.0)[0] == pytest.approx(3.0)
    assert solve((1.0, 0.0), 9.0, (), 1.0)[0] == pytest.approx(2.0)  # as near as it comes
    assert solve((1.0, 0.0), -1.0, (), 3.0)[0] == pytest.approx(0.0, abs=1e-7)  # the extremum
