"""The Gaussian sum and the fuzzy Kalman filter against the Kalman filter and naive recursions."""

import itertools
import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import (
    ExtendedKalmanFilter,
    FuzzyKalmanFilter,
    GaussianSumFilter,
    KalmanFilter,
    StateSpaceModel,
    run,
    thruster_model,
)
from filters.gaussian.mixtures import BLENDINGS
from filters.gaussian.sigma_points import memberships
from tests.filters.checks import refused
from tests.models import line_model, pendulum, random_affine, simulated, state_space
from tests.oracles import each_close, kalman_update

KEYS = np.zeros((1, 2))


def stay(x, u, c):
    return (0.9 * x[0] + 0.1 * x[1], x[1])


def square(x, c):
    return (x[1] * x[1] + 0.1 * x[0], x[0])


def square_model(mean=0.2):
    return state_space(
        stay, square, q=[0.1, 0.2], r=[[0.05, 0.01], [0.01, 0.5]], mean=[0.5, mean], cov=[[0.5, 0.2], [0.2, 1.0]]
    )


@pytest.mark.parametrize("parts", [7, 15, 40])
def test_the_standard_split_has_mean_zero_and_variance_one(parts):
    nodes, weights, variance = GaussianSumFilter(model=line_model(), parts=parts).standard_split
    assert len(nodes) == len(weights) == parts
    assert 0.0 < variance < 1.0 and (weights > 0.0).all()
    moments = weights.sum(), weights @ nodes, weights @ nodes**2 + variance
    assert moments == pytest.approx((1.0, 0.0, 1.0), abs=1e-14)


@pytest.mark.parametrize("component", [0, 1])
def test_an_update_is_the_naive_one(component):
    model = square_model()
    filter_ = GaussianSumFilter(model=model, parts=9, component=component)
    z, r = np.array([2.0, 0.3]), model.measurement_noise_cov
    belief = filter_.init()
    updated, innovation = filter_.update(belief, z)
    nodes, weights, variance = filter_.standard_split
    g = belief.cov[:, component] / math.sqrt(belief.cov[component, component])
    p = belief.cov - (1.0 - variance) * np.outer(g, g)
    means, covs, likelihoods, seen, spreads = [], [], [], [], []
    for node in nodes:
        x = belief.mean + node * g
        h = np.array([[0.1, 2.0 * x[1]], [1.0, 0.0]])
        y, s = np.array(square(x, ())), h @ p @ h.T + r
        gain = p @ h.T @ np.linalg.inv(s)
        means.append(x + gain @ (z - y))
        covs.append(p - gain @ s @ gain.T)
        likelihoods.append(multivariate_normal.pdf(z, y, s))
        seen.append(y)
        spreads.append(s)
    before = np.dot(weights, seen)
    apart = np.array(seen) - before
    s = np.einsum("k,kij->ij", weights, spreads + apart[:, :, None] * apart[:, None, :])
    np.testing.assert_allclose(innovation.value, z - before, rtol=1e-9)
    np.testing.assert_allclose(innovation.cov, s, rtol=1e-6)
    assert innovation.log_likelihood == pytest.approx(math.log(weights @ likelihoods), rel=1e-6)
    weights = weights * likelihoods / (weights @ likelihoods)
    mean = weights @ means
    apart = np.array(means) - mean
    cov = np.einsum("k,kij->ij", weights, covs + apart[:, :, None] * apart[:, None, :])
    each_close((updated.mean, updated.cov), (mean, cov), rtol=1e-6)
    each_close(filter_.part_estimates(updated), (means, covs, weights), rtol=1e-5, atol=1e-7)


def test_on_an_affine_model_it_is_nearly_the_kalman_filter():
    model = line_model()
    inputs, z = simulated(model, 60, level=1.0)
    z[0, 10:15] = np.nan
    exact = run(KalmanFilter(model=model), KEYS, inputs, z)
    found = run(GaussianSumFilter(model=model), KEYS, inputs, z)
    spread = np.sqrt(np.einsum("bkii->bki", exact.covs))
    assert np.abs((found.means - exact.means) / spread).max() < 0.005
    np.testing.assert_allclose(found.innovation_covs, exact.innovation_covs, rtol=0.005)
    np.testing.assert_allclose(found.log_likelihoods, exact.log_likelihoods, atol=0.005)


def test_it_sees_both_roots_of_a_measurement():
    filter_ = GaussianSumFilter(model=square_model(mean=0.0), parts=15)
    belief, _ = filter_.update(filter_.init(), [1.44, np.nan])
    extended = ExtendedKalmanFilter(model=filter_.model)
    tangent, _ = extended.update(extended.init(), [1.44, np.nan])
    means, _, weights = filter_.part_estimates(belief)
    assert weights[means[:, 1] > 1.0].sum() > 0.4 and weights[means[:, 1] < -1.0].sum() > 0.4
    assert abs(belief.mean[1]) < 0.1 and belief.cov[1, 1] == pytest.approx(1.44, rel=0.1)
    assert abs(tangent.mean[1]) < 0.6 and tangent.cov[1, 1] > 0.8  # the flat tangent knows nothing of them


def test_a_component_that_is_known_is_not_split():
    model = line_model().replace(prior_cov=[[1.0, 0.0], [0.0, 0.0]])
    exact, _ = KalmanFilter(model=model).update(KalmanFilter(model=model).init(), [2.0])
    found, _ = GaussianSumFilter(model=model).update(GaussianSumFilter(model=model).init(), [2.0])
    np.testing.assert_allclose(found.mean, exact.mean, rtol=1e-12)
    np.testing.assert_allclose(found.cov, exact.cov, rtol=1e-12, atol=1e-15)


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


def pendulum_rules(**changes):
    """The pendulum's four rules, in a range that it leaves now and then."""
    return FuzzyKalmanFilter(model=pendulum(), low=[-0.8, -1.5], high=[0.9, 1.7], **changes)


@pytest.mark.parametrize("blending", BLENDINGS)
@pytest.mark.parametrize("n", [1, 2, 3])
def test_with_equal_rules_it_is_the_kalman_filter(n, blending):
    model = random_affine(n, p=1, seed=n)
    inputs, z = simulated(model, 40, level=1.0)
    z[0, 5], z[0, 11, 0] = np.nan, np.nan
    exact = run(KalmanFilter(model=model), KEYS, inputs, z)
    found = run(FuzzyKalmanFilter(model=model, low=[-3.0] * n, high=[2.0] * n, blending=blending), KEYS, inputs, z)
    each_close(found, exact, rtol=1e-11, atol=1e-12)


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
        found = memberships(x, low, high, range(n))
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
    weights = memberships((5.0, -1.0), (1.0, -1.0), (5.0, 2.0), (0, 1))
    assert tuple(weights) == (0.0, 1.0, 0.0, 0.0)  # high in state 0, low in state 1


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
    within, between = np.tensordot(weights, covs, 1), np.einsum("r,ri,rj->ij", weights, apart, apart)
    np.testing.assert_allclose(within, belief.cov, rtol=1e-11, atol=1e-15)
    assert np.trace(between) > 0.01 * np.trace(within)  # what P leaves out


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


@pytest.mark.parametrize("offsets", [True, False])
@pytest.mark.parametrize("blending", BLENDINGS)
def test_it_is_the_naive_recursion(blending, offsets):
    filter_ = pendulum_rules(blending=blending, offsets=offsets)
    model, rules = filter_.model, [rule.matrices() for rule in pendulum_rules().rules]
    inputs, z = simulated(model, 40, level=2.0)
    z[0, 7] = np.nan
    found = run(filter_, KEYS, inputs, z)
    mean, cov = model.prior_mean, model.prior_cov
    own = [(mean, cov)] * 4
    weights = memberships(mean, filter_.low, filter_.high, (0, 1))
    for k in range(41):
        if k > 0:
            weights = memberships(mean, filter_.low, filter_.high, (0, 1))
            moved = []
            for (a, b, offset, _, _), (x, p) in zip(rules, own, strict=True):
                x, p = (x, p) if blending == "output" else (mean, cov)
                x = a @ x + b @ inputs[0, k - 1] + (offset if offsets else 0.0)
                moved.append((x, a @ p @ a.T + model.process_noise_cov))
            own = moved
        if k != 7:
            seen = [z[0, k] - c @ x - shift for (_, _, _, c, shift), (x, _) in zip(rules, own, strict=True)]
            parts = [
                kalman_update(x, p, i, rule[3], model.measurement_noise_cov)
                for (x, p), i, rule in zip(own, seen, rules, strict=True)
            ]
            own = [(x, p) for x, p, _ in parts]
            innovation, s = mixed(seen, [s for _, _, s in parts], weights, blending)
            np.testing.assert_allclose(found.innovations[0, k], innovation, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(found.innovation_covs[0, k], s, rtol=1e-12, atol=1e-12)
            likelihood = multivariate_normal.logpdf(innovation, np.zeros(2), s)
            assert found.log_likelihoods[0, k] == pytest.approx(likelihood, rel=1e-10, abs=1e-11)
        mean, cov = mixed([x for x, _ in own], [p for _, p in own], weights, blending)
        each_close((found.means[0, k], found.covs[0, k]), (mean, cov), rtol=1e-12, atol=1e-12)


def mixed(means, covs, weights, blending):
    """Mean and covariance of a mixture; by weights, the covariance is that within its parts alone."""
    mean, cov = sum(w * x for w, x in zip(weights, means, strict=True)), 0.0
    for w, x, p in zip(weights, means, covs, strict=True):
        cov = cov + w * p
        if blending != "weights":
            cov = cov + w * np.outer(x - mean, x - mean)
    return mean, cov


def test_the_blendings_differ_and_the_first_is_the_default():
    inputs, z = simulated(pendulum(), 20)
    found = {one: run(pendulum_rules(blending=one), KEYS, inputs, z) for one in BLENDINGS}
    for one, other in itertools.combinations(found.values(), 2):
        assert np.abs(one.means - other.means).max() > 1e-3
    assert BLENDINGS[0] == FuzzyKalmanFilter.blending == "weights"
    # After the first step, from the same beliefs, P differs by the spread between the rules' means alone.
    assert np.linalg.eigvalsh(found["moments"].covs[0, 1] - found["weights"].covs[0, 1]).max() > 0


def test_the_thruster_s_range_is_that_of_its_voltages():
    model = thruster_model(ambient_velocity=-0.4)
    still = thruster_model()
    each_close((still.state_low, model.state_high), (-still.state_high, still.state_high))
    np.testing.assert_allclose(model.state_low, still.state_low - [0.0, 0.4])
    filter_ = FuzzyKalmanFilter(model=model)
    np.testing.assert_array_equal([filter_.low, filter_.high], [model.state_low, model.state_high])


def test_a_nonlinear_model_without_a_range_is_refused():
    model = six_states().replace(state_low=None)
    refused("must know the range of the states, but got neither", FuzzyKalmanFilter, model=model)
    assert len(FuzzyKalmanFilter(model=model, low=[-5.0] * 6).rules) == 64


def test_more_rules_than_sense_are_refused():
    model = random_affine(9, p=1)
    with pytest.raises(ValueError, match="premises must name 1 to 8 different states, .* but got"):
        FuzzyKalmanFilter(model=model, premises=range(9))
    assert len(FuzzyKalmanFilter(model=model, premises=(2, -1)).rules) == 4
    assert FuzzyKalmanFilter(model=model).premises == (0,)  # the rules of an affine model are all alike
