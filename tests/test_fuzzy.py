"""The fuzzy Kalman filter against the Kalman filter, a naive one with its rules, and its memberships."""

import itertools

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import FuzzyKalmanFilter, KalmanFilter, StateSpaceModel, run, thruster_model, truth
from filters.gaussian.fuzzy import memberships
from tests.models import random_affine, simulated
from thruster_env.streams import episode_keys

KEYS = np.zeros((1, 2))

pytestmark = pytest.mark.usefixtures("as_python")


def turn(x, u, c):
    return tuple(0.9 * x[i] + 0.05 * x[i - 1] * x[i] + 0.1 * u[0] for i in range(6))


def look(x, c):
    return (x[0] + 0.1 * x[1] * x[1] + x[5],)


def six_states():
    return StateSpaceModel(
        transition=turn,
        observe=look,
        process_noise_cov=[0.1] * 6,
        measurement_noise_cov=[0.2],
        prior_mean=[0.1, 0.2, -0.1, 0.0, 0.3, 0.0],
        prior_cov=[0.5] * 6,
        state_low=[-1.0, -2.0, -1.0, -3.0, -1.0, -1.0],
        state_high=[1.0, 1.0, 2.0, 1.0, 1.0, 1.5],
    )


@pytest.mark.parametrize("n", [1, 2, 3, 6])
def test_with_equal_rules_it_is_the_kalman_filter(n):
    model = random_affine(n, p=1, seed=n)
    inputs, z = simulated(model, 40, level=1.0)
    z[0, 5], z[0, 11, 0] = np.nan, np.nan
    exact = run(KalmanFilter(model=model), KEYS, inputs, z)
    found = run(FuzzyKalmanFilter(model=model, low=[-3.0] * n, high=[2.0] * n), KEYS, inputs, z)
    for one, other in zip(found, exact, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-10)


def test_an_affine_model_needs_no_range():
    model = random_affine(2, p=1)
    z = np.ones((1, 5, 2))
    found = run(FuzzyKalmanFilter(model=model), KEYS, np.zeros((1, 4, 1)), z)
    exact = run(KalmanFilter(model=model), KEYS, np.zeros((1, 4, 1)), z)
    np.testing.assert_allclose(found.means, exact.means, rtol=1e-10)


@pytest.mark.parametrize("n", [1, 2, 6])
def test_memberships_are_products_and_sum_to_one(n):
    rng = np.random.default_rng(n)
    low, high = -rng.uniform(1.0, 2.0, n), rng.uniform(1.0, 3.0, n)
    for x in rng.uniform(-4.0, 4.0, size=(50, n)):  # outside of the range as well
        found = memberships(n)(x, low, high)
        of_high = np.clip((x - low) / (high - low), 0.0, 1.0)
        # Bit i of the rule's number belongs to state i, so state 0 changes fastest.
        products = [
            np.prod([of_high[i] if bits[n - 1 - i] else 1 - of_high[i] for i in range(n)])
            for bits in itertools.product([0, 1], repeat=n)
        ]
        assert len(found) == 2**n and sum(found) == pytest.approx(1.0, rel=1e-14)
        assert min(found) >= 0.0
        np.testing.assert_allclose(found, products, rtol=1e-13, atol=1e-16)


def test_in_a_corner_one_rule_holds():
    weights = memberships(2)((5.0, -1.0), (1.0, -1.0), (5.0, 2.0))
    assert weights == (0.0, 1.0, 0.0, 0.0)  # high in state 0, low in state 1


def test_six_states_have_64_rules_and_each_a_filter():
    filter_ = FuzzyKalmanFilter(model=six_states())
    belief, _ = filter_.update(filter_.predict(filter_.init(), [0.5]), [0.7])
    means, covs, weights = filter_.rule_estimates(belief)
    assert len(filter_.rules) == 64
    assert (means.shape, covs.shape, weights.shape) == ((64, 6), (64, 6, 6), (64,))
    assert weights.sum() == pytest.approx(1.0)
    assert len(np.unique(means.round(12), axis=0)) > 32  # rules differ
    np.testing.assert_allclose(weights @ means, belief.mean, rtol=1e-12)
    apart = means - belief.mean
    spread = np.einsum("r,rij->ij", weights, covs + apart[:, :, None] * apart[:, None, :])
    np.testing.assert_allclose(spread, belief.cov, rtol=1e-11)


def test_rules_are_the_model_s_tangents_in_the_corners():
    model = thruster_model()
    filter_ = FuzzyKalmanFilter(model=model)
    corners = [
        (omega, flow)
        for flow in (model.state_low[1], model.state_high[1])
        for omega in (model.state_low[0], model.state_high[0])
    ]
    for rule, x in zip(filter_.rules, corners, strict=True):
        moved = x
        for _ in range(model.substeps):
            moved = model.transition(moved, model.operating_input, model.constants)
        of_rule = rule.transition(x, model.operating_input, rule.constants)
        np.testing.assert_allclose(of_rule, moved, rtol=1e-10)
        np.testing.assert_allclose(rule.observe(x, rule.constants), model.observe(x, model.constants), rtol=1e-10)


def test_on_the_thruster_it_is_the_naive_one():
    model = thruster_model()
    filter_ = FuzzyKalmanFilter(model=model, low=[-200.0, -4.0], high=[190.0, 3.5])
    inputs = np.random.default_rng(5).uniform(-12.0, 12.0, size=(1, 30, 1))
    z = truth.simulate(model, episode_keys([2]), inputs).measurements
    found = run(filter_, KEYS, inputs, z)
    parts = [rule.matrices() for rule in filter_.rules]
    means, covs = [model.prior_mean] * 4, [model.prior_cov] * 4
    mean = model.prior_mean
    weights = memberships(2)(mean, filter_.low, filter_.high)
    q, r = model.process_noise_cov, model.measurement_noise_cov
    for k in range(31):
        if k > 0:
            weights = np.array(memberships(2)(mean, filter_.low, filter_.high))
            for j, (a, b, offset, _, _) in enumerate(parts):
                means[j] = a @ means[j] + b @ inputs[0, k - 1] + offset
                covs[j] = a @ covs[j] @ a.T + q
        innovations, spreads = [], []
        for j, (_, _, _, c, shift) in enumerate(parts):
            s = c @ covs[j] @ c.T + r
            gain = covs[j] @ c.T / s
            innovations.append((z[0, k] - c @ means[j] - shift)[0])
            spreads.append(s[0, 0])
            means[j] = means[j] + gain[:, 0] * innovations[-1]
            covs[j] = covs[j] - gain @ s @ gain.T
        mean = np.dot(weights, means)
        innovation = np.dot(weights, innovations)
        s = np.dot(weights, spreads + (innovations - innovation) ** 2)
        np.testing.assert_allclose(found.means[0, k], mean, rtol=1e-8)
        np.testing.assert_allclose(found.innovations[0, k, 0], innovation, rtol=1e-7, atol=1e-9)
        np.testing.assert_allclose(found.innovation_covs[0, k, 0, 0], s, rtol=1e-8)
        likelihood = multivariate_normal.logpdf(innovation, 0.0, s)
        assert found.log_likelihoods[0, k] == pytest.approx(likelihood, rel=1e-7)


def test_the_thruster_s_range_is_that_of_its_voltages():
    model = thruster_model(ambient_velocity=-0.4)
    still = thruster_model()
    np.testing.assert_allclose(still.state_low, -still.state_high)
    np.testing.assert_allclose(model.state_high, still.state_high)
    np.testing.assert_allclose(model.state_low, still.state_low - [0.0, 0.4])
    filter_ = FuzzyKalmanFilter(model=model)
    np.testing.assert_array_equal([filter_.low, filter_.high], [model.state_low, model.state_high])


@pytest.mark.parametrize(
    ("numbers", "rule"),
    [
        ({"low": [0.0, 1.0]}, "low must be 6 finite numbers, but got"),
        ({"high": ["a"] * 6}, "high must be 6 finite numbers, but got"),
        ({"low": [2.0] * 6}, "low must be below high in every state, but got"),
    ],
)
def test_a_range_that_is_none_is_refused(numbers, rule):
    with pytest.raises(ValueError, match=rule):
        FuzzyKalmanFilter(model=six_states(), **numbers)


def test_a_nonlinear_model_without_a_range_is_refused():
    model = six_states().replace(state_low=None)
    with pytest.raises(ValueError, match="must know the range of the states, but got neither"):
        FuzzyKalmanFilter(model=model)
    assert len(FuzzyKalmanFilter(model=model, low=[-5.0] * 6).rules) == 64


def test_more_rules_than_sense_are_refused():
    with pytest.raises(ValueError, match="at most 8 states, but got 9"):
        FuzzyKalmanFilter(model=random_affine(9, p=1))
