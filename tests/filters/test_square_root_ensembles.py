"""Ensembles without perturbed measurements: Kalman filter, N x N textbooks, costs, quantiles by quadrature."""

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.linalg import cholesky, solve, sqrtm
from scipy.optimize import brentq, minimize_scalar
from scipy.stats import norm

from filters import (
    DeterministicEnsembleKalmanFilter,
    EnsembleTransformFilter,
    FiniteSizeEnsembleFilter,
    KalmanFilter,
    SerialSquareRootFilter,
    make_filter,
    run,
    smooth,
)
from filters.algebra.operations import geometric_mean_of
from filters.c.project import c_filter
from filters.tensors import torch
from tests.filters.checks import refused
from tests.models import KEY, plane_model, state_space, wide_model
from tests.oracles import each_close
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted
from thruster_env.core.sources import is_array
from tuning.evaluation.evaluate import evaluate
from tuning.evaluation.runs import state_errors
from tuning.experiments import lorenz63
from tuning.experiments.benchmark import mean_of_roots
from tuning.plants.thruster import find_scenario
from tuning.problems.data import held_out_seeds

SIZE = 9
SQUARE_ROOTS = EnsembleTransformFilter, SerialSquareRootFilter
SCALES = {1: [1.0], 2: [1.0, 30.0], 3: [1.0, 30.0, 0.02], 4: [1.0, 30.0, 0.02, 5.0]}  # of channels


def linear_model(m, seed=3):
    """n = 3 with m channels of different scales and correlated noise."""
    generator = np.random.default_rng(seed)
    units = np.diag(SCALES[m])
    noise = generator.normal(size=(m, m)) + np.eye(m)
    return wide_model(
        b=[[1.0], [0.5], [0.0]],
        c=units @ generator.normal(size=(m, 3)),
        measurement_offset=generator.normal(size=m),
        measurement_noise_cov=units @ noise @ noise.T @ units,
    )


def updated(kind, model, z, **numbers):
    filter_ = kind(model=model, ensemble_size=SIZE, **numbers)
    with interpreted():
        forecast = filter_.predict(filter_.init(KEY), [0.5])
        return (forecast, *filter_.update(forecast, z))


def centred(a):
    return a - a.mean(axis=1, keepdims=True)


def predicted(model, members):
    _, _, _, c, shift = model.matrices()
    return c @ members + shift[:, None]


def naive_transform(x, y, z, r):
    """The ETKF by N x N matrices: members x (n, N), their predicted measurements y (m, N)."""
    far, of_y = centred(x), centred(y)
    n_1, inverse = x.shape[1] - 1, np.linalg.inv(r)
    squared = np.linalg.inv(np.eye(n_1 + 1) + of_y.T @ inverse @ of_y / n_1)
    weights = squared @ of_y.T @ inverse @ (z - y.mean(axis=1)) / n_1
    return (x.mean(axis=1) + far @ weights)[:, None] + far @ sqrtm(squared).real


def naive_serial(x, y, z, r):
    root = np.linalg.cholesky(r)
    joint, z = np.vstack([x, np.linalg.solve(root, y)]), np.linalg.solve(root, z)
    for i in range(len(z)):
        channel = len(x) + i
        mean, far = joint.mean(axis=1), centred(joint)
        s = far[channel] @ far[channel] / (x.shape[1] - 1) + 1.0
        k = far @ far[channel] / (x.shape[1] - 1) / s
        far = far - np.outer(k, far[channel]) / (1.0 + np.sqrt(1.0 / s))
        joint = (mean + k * (z[i] - mean[channel]))[:, None] + far
    return joint[: len(x)]


def naive_half(x, y, z, r):
    of_y = centred(y)
    k = centred(x) @ of_y.T @ np.linalg.inv(of_y @ of_y.T + (x.shape[1] - 1) * r)
    return (x.mean(axis=1) + k @ (z - y.mean(axis=1)))[:, None] + centred(x) - 0.5 * k @ of_y


NAIVE = {
    EnsembleTransformFilter: naive_transform,
    SerialSquareRootFilter: naive_serial,
    DeterministicEnsembleKalmanFilter: naive_half,
}


@pytest.mark.parametrize("kind", NAIVE)
@pytest.mark.parametrize("m", SCALES)
def test_an_update_is_the_textbook_s(kind, m):
    model, z = linear_model(m), np.arange(1.0, 1.0 + m) * SCALES[m]
    forecast, analysis, _ = updated(kind, model, z)
    expected = NAIVE[kind](forecast.members, predicted(model, forecast.members), z, model.measurement_noise_cov)
    np.testing.assert_allclose(analysis.members, expected, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(analysis.mean, expected.mean(axis=1), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(analysis.cov, np.cov(expected), rtol=1e-10, atol=1e-10)


def by_kalman(model, forecast, z):
    """The Kalman filter's update of an ensemble's moments."""
    return KalmanFilter(model=model).update(forecast._replace(members=np.empty((3, 0))), z)


MISSING = [(1, []), (2, []), (3, []), (1, [0]), (2, [0]), (2, [1]), (3, [0, 2]), (3, [1])]


@pytest.mark.parametrize("kind", SQUARE_ROOTS)
@pytest.mark.parametrize(("m", "missing"), MISSING)
def test_its_moments_are_the_kalman_filter_s(kind, m, missing):
    model, z = linear_model(m), np.arange(1.0, 1.0 + m) * SCALES[m]
    z[missing] = np.nan
    forecast, analysis, innovation = updated(kind, model, z)
    with interpreted():
        expected, of_kalman = by_kalman(model, forecast, z)
    each_close((analysis.mean, analysis.cov), (expected.mean, expected.cov), rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(innovation.value, of_kalman.value, rtol=1e-10, atol=1e-10)
    assert innovation.log_likelihood == pytest.approx(of_kalman.log_likelihood, rel=1e-10)


@pytest.mark.parametrize(("m", "missing"), MISSING)
def test_half_the_gain_leaves_more_spread_by_its_own_formula(m, missing):
    model, z = linear_model(m), np.arange(1.0, 1.0 + m) * SCALES[m]
    z[missing] = np.nan
    forecast, analysis, _ = updated(DeterministicEnsembleKalmanFilter, model, z)
    with interpreted():
        expected, _ = by_kalman(model, forecast, z)
    here = [i for i in range(m) if i not in missing]
    h, r, p = model.matrices()[3][here], model.measurement_noise_cov[np.ix_(here, here)], forecast.cov
    k = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
    np.testing.assert_allclose(analysis.mean, expected.mean, rtol=1e-10, atol=1e-10)
    spread = p - k @ h @ p + k @ h @ p @ h.T @ k.T / 4
    np.testing.assert_allclose(analysis.cov, spread, rtol=1e-10, atol=1e-10)


def test_with_one_channel_transform_and_serial_filter_are_one():
    forecast, by_transform, _ = updated(EnsembleTransformFilter, linear_model(1), [2.0])
    _, by_serial, _ = updated(SerialSquareRootFilter, linear_model(1), [2.0])
    np.testing.assert_allclose(by_transform.members, by_serial.members, rtol=1e-13)
    assert not np.allclose(by_transform.members, forecast.members)


@pytest.mark.parametrize("size", [1, 2, 3, 6])
@pytest.mark.parametrize("decades", [0, 6])
def test_the_geometric_mean_is_the_middle_of_two_covariances(size, decades):
    generator = np.random.default_rng(size)
    turn, _ = np.linalg.qr(generator.normal(size=(size, size)))
    units = np.diag(10.0 ** generator.uniform(-2, 2, size=size))  # the second differs by far in some directions
    a = np.eye(size) + 0.5 * np.ones((size, size))
    b = turn @ np.diag(10.0 ** generator.uniform(0, decades, size=size)) @ turn.T
    middle = units @ a @ sqrtm(np.linalg.solve(a, b)).real @ units
    scaled = (units @ c @ units for c in (a, b))
    form = np.array if is_array(size, size) else lambda c: tuple(map(tuple, c))
    mean = np.array(geometric_mean_of(size)(*map(form, scaled)))
    spread = np.sqrt(np.diag(middle))
    np.testing.assert_allclose(mean / np.outer(spread, spread), middle / np.outer(spread, spread), atol=1e-9)
    np.testing.assert_array_equal(mean, mean.T)


@pytest.mark.parametrize("name", ["enkf", "etkf", "ensrf", "denkf", "ienkf", "enkf-n"])
@pytest.mark.parametrize("noise", [1e-9, 1e9])
def test_two_members_and_any_ratio_of_noise_to_spread_are_enough_to_run(name, noise):
    model = linear_model(3)
    model = model.replace(measurement_noise_cov=noise * model.measurement_noise_cov)
    with interpreted():
        data = np.array([KEY]), np.zeros((1, 20, 1)), np.ones((1, 21, 3))
        estimates = run(make_filter(name, model, ensemble_size=2), *data)
    assert np.isfinite(estimates.means).all() and np.isfinite(estimates.covs).all()
    assert estimates.divergences.tolist() == [0]


@pytest.mark.parametrize("name", ["enkf", "etkf", "ensrf"])
def test_with_small_noise_a_hundred_members_sit_on_the_bound(name):
    nominal = find_scenario("nominal")
    data = nominal.data(held_out_seeds(0, 200))
    found = evaluate(make_filter(name, nominal.model(**nominal.true), ensemble_size=100), data, nominal.scale)
    assert [i.value for i in found.rmse] == pytest.approx(nominal.scale, rel=0.05)
    assert found.divergences == 0


@pytest.mark.slow
def test_with_the_published_noise_ensembles_beat_the_extended_filter_and_iterations_beat_both():
    scenario = find_scenario("published_noise")
    data, model = scenario.data(held_out_seeds(0, 64)), scenario.model(**scenario.true)
    flow_errors = {
        name: evaluate(make_filter(name, model), data, scenario.scale).rmse[1].value
        for name in ("ekf", "enkf", "etkf", "ienkf")
    }
    # On 200 seeds 0.63, 0.63 and 0.44 of the extended filter's, each to 0.02.
    for name, most in (("enkf", 0.7), ("etkf", 0.7), ("ienkf", 0.5)):
        assert flow_errors[name] < most * flow_errors["ekf"]


def naive_factor(y, v, r, certainty):
    """The inflation squared, by a search over the cost in the singular values of Bocquet, Raanes and Hannart."""
    size = y.shape[1]
    root = cholesky(r, lower=True)
    u, s, _ = np.linalg.svd(solve(root, y - y.mean(axis=1, keepdims=True)))
    s, du = np.append(s, np.zeros(max(0, len(v) - len(s)))), u.T @ solve(root, v)
    weights = np.append(s, np.zeros(max(0, size - len(s))))[:size] ** 2 + size - 1
    share = (size - 1) * np.mean(1 / weights)
    a, b = (size + 1) / size, size / (size - 1)
    shift = (a / b) ** (share / 2)
    a, b = certainty * a / shift, certainty * b * shift

    def cost(log_inflation):
        t = np.exp(2 * log_inflation)
        return np.sum(du**2 / (t * s**2 + size - 1)) + a / t + b * np.log(t)

    found = minimize_scalar(cost, bounds=(-3.0, 3.0), method="bounded", options={"xatol": 1e-10})
    return np.exp(2 * found.x)


def naive_finite_size(model, members, z, here, certainty=1.0):
    """The inflation, and the members after the transform filter's update of the channels `here`."""
    y, r, here = predicted(model, members)[list(here)], model.measurement_noise_cov[np.ix_(here, here)], list(here)
    spread = np.sqrt(naive_factor(y, z[here] - y.mean(axis=1), r, certainty))
    mean = members.mean(axis=1, keepdims=True)
    inflated = mean + spread * (members - mean)
    return spread, naive_transform(inflated, predicted(model, inflated)[here], z[here], r)


@pytest.mark.parametrize("certainty", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("far", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("m", SCALES)
def test_an_update_is_that_of_the_transform_filter_after_the_inflation_of_least_cost(m, far, certainty):
    model = linear_model(m)
    forecast, _, innovation = updated(FiniteSizeEnsembleFilter, model, np.zeros(m))
    y = predicted(model, forecast.members)
    z = y.mean(axis=1) + far * np.sqrt(np.diag(innovation.cov)) * np.sign(np.arange(m) - 0.5)
    _, analysis, innovation = updated(FiniteSizeEnsembleFilter, model, z, certainty=certainty)
    spread, expected = naive_finite_size(model, forecast.members, z, range(m), certainty)
    # A search over values finds the place of a minimum to the root of rounding.
    np.testing.assert_allclose(analysis.members, expected, rtol=1e-6, atol=1e-6 * abs(expected).max())
    assert spread < 1.01 or far > 0.0
    _, _, plain = updated(EnsembleTransformFilter, model, z)
    np.testing.assert_allclose(innovation.value, plain.value, atol=1e-12)
    np.testing.assert_allclose(innovation.cov, plain.cov, rtol=1e-12)
    assert innovation.log_likelihood == pytest.approx(plain.log_likelihood, rel=1e-12)


@pytest.mark.parametrize(("noise", "certainty", "same"), [(1e9, 1.0, True), (1.0, 1e9, False), (1.0, 1.0, False)])
def test_where_measurements_say_nothing_it_is_the_transform_filter(noise, certainty, same):
    model = linear_model(2)
    model = model.replace(measurement_noise_cov=noise * model.measurement_noise_cov)
    z = np.array([9.0, -200.0])
    _, found, _ = updated(FiniteSizeEnsembleFilter, model, z, certainty=certainty)
    _, expected, _ = updated(EnsembleTransformFilter, model, z)
    assert np.allclose(found.members, expected.members, rtol=1e-6, atol=1e-6) == same


def test_a_missing_channel_takes_no_part():
    model, z = linear_model(3), np.array([2.0, np.nan, 0.05])
    forecast, analysis, _ = updated(FiniteSizeEnsembleFilter, model, z)
    _, expected = naive_finite_size(model, forecast.members, z, [0, 2])
    np.testing.assert_allclose(analysis.members, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_it_needs_no_inflation_where_the_transform_filter_loses_the_truth():
    data = lorenz63.problem.data(range(8))

    def score(name):
        filter_ = make_filter(name, lorenz63.model(), ensemble_size=6)
        estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
        return np.median(mean_of_roots(state_errors(filter_, estimates, data)[:, data.late]))

    assert 1.2 * score("enkf-n") < score("etkf")


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


def moved_members(model, members, z, name="rhf", **numbers):
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

    def part(i, until):
        inside = [z] if ends[i] < z < until else None
        return quad(density[i], ends[i], until, epsabs=0.0, limit=200, points=inside)[0]

    below = np.cumsum([0.0, *(part(i, end) for i, end in enumerate(ends[1:]))])

    def share(until):
        i = min(np.searchsorted(ends, until, "right") - 1, size)
        return (below[i] + part(i, until)) / below[-1]

    return [brentq(lambda at, k=k: share(at) - k / (size + 1), low, high, xtol=1e-12) for k in range(1, size + 1)]


@pytest.mark.parametrize("z", slow_but([-0.4, 1.5, 6.0], [1.5]))
def test_an_update_moves_each_rank_to_its_quantile_and_states_by_regression(z):
    x = np.random.default_rng(2).normal(size=(2, 6)) + [[0.5], [1.0]]
    found, y = moved_members(curved_model(), x, [z]), x[0] * x[1]
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
    found = moved_members(model, members, z)
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
    found = moved_members(curved_model(noise=9.0), x, [1.0])[0]
    shares = norm.pdf(1.0, [-3.0, 3.0], 3.0)
    upper = shares[1] / shares.sum()
    assert abs((found > 1.5).mean() - upper) < 0.03 and (abs(found) < 2.0).mean() < 0.05
    by_gain = moved_members(curved_model(noise=9.0), x, [1.0], "etkf")[0]
    assert (abs(by_gain) < 2.4).mean() > 0.3


@pytest.mark.parametrize("z", [1e4, -1e4])
def test_a_measurement_far_beyond_all_members_leaves_finite_ones_in_their_order(z):
    x = np.vstack([np.linspace(0.5, 1.5, 7), np.ones(7)])
    found = moved_members(curved_model(0.01), x, [z])
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
    np.testing.assert_allclose(
        moved_members(model, x, z), moved_members(apart, x, np.linalg.solve(root, z)), rtol=1e-10
    )
    alone = moved_members(model, x, [np.nan, -0.5])
    second = wide_model(
        b=np.zeros((3, 0)), c=c[1:], measurement_offset=shift[1:], measurement_noise_cov=[root[1] @ root[1]]
    )
    np.testing.assert_allclose(alone, moved_members(second, x, [-0.5]), rtol=1e-10)


def test_what_needs_a_page_for_the_whole_update_or_one_gain_is_refused():
    filter_ = make_filter("rhf", plane_model(), ensemble_size=9)
    for use, where in ((torch, "on tensors"), (c_filter, "in C")):
        refused(f"{where} must have a page for its whole update.* but got 'rhf'", use, filter_)
    nothing = np.zeros((1, 1, 1)), np.zeros((1, 2, 2))
    refused("must have one gain for all states, but got 'rhf'", smooth, filter_, None, *nothing)
