"""The rank histogram filter: quantiles of a naive posterior, the Kalman filter's limit, and two clouds."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq
from scipy.stats import norm

from filters import KalmanFilter, make_filter, run, smooth
from filters.c.project import c_filter
from filters.tensors import torch
from tests.models import KEY, plane_model, simulated, state_space, wide_model
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted


def stay(x, u, c):
    return x


def product(x, c):
    return (x[0] * x[1],)


def curved_model(noise=0.3):
    """Two states, of which the product is measured."""
    return state_space(stay, product, q=[0.0, 0.0], r=[noise], mean=[0.0, 0.0], cov=[1.0, 1.0], inputs=0)


def prior_members(model, size):
    with interpreted():
        return make_filter("rhf", model, ensemble_size=size).init(KEY).members


def updated(model, members, z, name="rhf", **numbers):
    filter_ = make_filter(name, model, ensemble_size=len(members[0]), **numbers)
    with interpreted():
        belief, _ = filter_.update(filter_.init(KEY)._replace(members=np.array(members)), z)
    return belief.members


def naive_quantiles(y, z, noise):
    """Quantiles k/(N + 1) of the posterior of one channel, by quadrature and a search for each."""
    size, edges, spread = len(y), np.sort(y), np.std(y, ddof=1)
    tail = norm.ppf(1.0 / (size + 1)) * spread
    likelihood = lambda at: norm.pdf(z, at, noise**0.5)  # noqa: E731
    density = [
        lambda at: norm.pdf(at, edges[0] - tail, spread) * likelihood(at),
        *(
            lambda at, a=a, b=b: (likelihood(a) + likelihood(b)) / 2.0 / (size + 1) / (b - a)
            for a, b in zip(edges, edges[1:], strict=False)
        ),
        lambda at: norm.pdf(at, edges[-1] + tail, spread) * likelihood(at),
    ]
    low, high = edges[0] - 40.0, edges[-1] + 40.0
    ends = [low, *edges, high]

    def mass(until):
        return sum(
            quad(one, a, min(b, until), epsabs=0.0, limit=200, points=[z] if a < z < min(b, until) else None)[0]
            for one, a, b in zip(density, ends, ends[1:], strict=False)
            if until > a
        )

    total = mass(high)
    return [
        brentq(lambda at, k=k: mass(at) / total - k / (size + 1), low, high, xtol=1e-12)
        for k in range(1, size + 1)
    ]


@pytest.mark.parametrize("z", slow_but([-0.4, 1.5, 6.0], [1.5]))
def test_an_update_moves_each_rank_to_its_quantile_and_states_by_regression(z):
    x = np.random.default_rng(2).normal(size=(2, 6)) + [[0.5], [1.0]]
    found, y = updated(curved_model(), x, [z]), x[0] * x[1]
    moves = np.empty(6)
    moves[np.argsort(y)] = naive_quantiles(y, z, 0.3) - np.sort(y)
    slope = np.cov(np.vstack([x, y]))[:2, 2] / np.var(y, ddof=1)
    np.testing.assert_allclose(found, x + np.outer(slope, moves), rtol=1e-8, atol=1e-8)


def test_many_members_of_a_linear_model_have_the_kalman_filter_s_moments():
    model = plane_model(b=np.zeros((2, 0)))
    z, members = np.array([2.0, -1.0]), prior_members(model, 1500)
    with interpreted():
        kalman = KalmanFilter(model=model)
        prior = kalman.init()._replace(mean=members.mean(axis=1), cov=np.cov(members))
        expected, _ = kalman.update(prior, z)
    found = updated(model, members, z)
    spread = np.sqrt(np.diag(expected.cov))
    assert (abs(found.mean(axis=1) - expected.mean) < 0.06 * spread).all()
    np.testing.assert_allclose(
        np.cov(found) / np.outer(spread, spread), expected.cov / np.outer(spread, spread), atol=0.03
    )


def test_two_clouds_stay_two_where_a_gain_moves_all_alike():
    """Half of the members near -3, half near 3: a poor measurement of 1 makes one more probable, not both meet."""
    normal = np.random.default_rng(1).normal(size=(2, 60))
    x = np.where(np.arange(60) < 30, -3.0, 3.0) + 0.3 * normal
    x[1] = 1.0
    found = updated(curved_model(noise=9.0), x, [1.0])[0]
    shares = norm.pdf(1.0, [-3.0, 3.0], 3.0)
    upper = shares[1] / shares.sum()
    assert abs((found > 1.5).mean() - upper) < 0.03 and (abs(found) < 2.0).mean() < 0.05
    by_gain = updated(curved_model(noise=9.0), x, [1.0], "etkf")[0]
    assert (abs(by_gain) < 2.4).mean() > 0.3


@pytest.mark.parametrize("z", [1e4, -1e4])
def test_a_measurement_far_beyond_all_members_leaves_finite_ones_in_their_order(z):
    x = np.vstack([np.linspace(0.5, 1.5, 7), np.ones(7)])
    found = updated(curved_model(0.01), x, [z])
    assert np.isfinite(found).all() and (np.diff(found[0]) > 0.0).all() and np.sign(z) * found[0].mean() > 100.0


def test_channels_with_correlated_noise_are_made_independent():
    model, z = wide_model(b=np.zeros((3, 0))), np.array([1.0, -0.5])
    x = prior_members(model, 9)
    root = np.linalg.cholesky(model.measurement_noise_cov)
    _, _, _, c, shift = model.matrices()
    apart = wide_model(
        b=np.zeros((3, 0)),
        c=np.linalg.solve(root, c),
        measurement_offset=np.linalg.solve(root, shift),
        measurement_noise_cov=np.eye(2),
    )
    np.testing.assert_allclose(updated(model, x, z), updated(apart, x, np.linalg.solve(root, z)), rtol=1e-10)
    alone = updated(model, x, [np.nan, -0.5])
    second = wide_model(
        b=np.zeros((3, 0)), c=c[1:], measurement_offset=shift[1:], measurement_noise_cov=[root[1] @ root[1]]
    )
    np.testing.assert_allclose(alone, updated(second, x, [-0.5]), rtol=1e-10)


@pytest.mark.slow
def test_compiled_code_and_python_are_one_and_pages_alone_are_refused():
    filter_ = make_filter("rhf", plane_model(), ensemble_size=9, relaxation=0.3, inflation=1.02)
    inputs, z = simulated(plane_model(), 20, count=2, missing=0.2)
    with interpreted():
        expected = run(filter_, None, inputs, z)
    for one, other in zip(run(filter_, None, inputs, z), expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)
    for use, where in ((torch, "on tensors"), (c_filter, "in C")):
        with pytest.raises(ValueError, match=f"{where} must have a page for its whole update.* but got 'rhf'"):
            use(filter_)
    with pytest.raises(ValueError, match="must have one gain for all states, but got 'rhf'"):
        smooth(filter_, None, inputs, z)
