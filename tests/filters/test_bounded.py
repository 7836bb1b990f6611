"""Estimates within bounds: truncated normals of SciPy, least squares within a box, coverage, all ways to run."""

import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.stats import truncnorm

from filters import ExtendedKalmanFilter, augmented_model, linearize, make_filter, run, smooth
from filters.augmented import Unknown
from filters.consistency.nees import mean_interval
from filters.smoothers import WithSmoother
from tests.filters.checks import refused
from tests.models import KEY, scalar_model, simulated, wide_model
from tests.oracles import each_close
from thruster_env.core.streams import truncated_normal

pytestmark = pytest.mark.usefixtures("as_python")

INF = np.inf
PAGES = "kf kf-steady ekf iekf ukf ckf fading h-infinity schmidt ekf-robust sage-husa vb".split()
BY_NAME = {"x_1": (0.0, None), "x_3": (-0.2, 0.4)}


@pytest.mark.parametrize("low", [-INF, -40.0, -3.0, -0.1, 0.0, 1.3, 4.9, 5.1, 20.0, 99.0, 101.0])
@pytest.mark.parametrize("width", [0.01, 0.7, 3.0, 60.0, INF])
def test_truncated_moments_are_those_by_quadrature(low, width):
    low, high = (-INF, 1.0 - width if width < INF else 2.0) if low == -INF else (low, low + width)
    sign, a, b = (1.0, low, high) if low + high > 0.0 else (-1.0, -high, -low)
    start = max(a, -12.0)
    grid = np.linspace(start, min(b, start + 24.0 if start < 1.0 else start + 40.0 / start), 200_001)
    weights = np.exp(-0.5 * (grid - grid[0]) * (grid + grid[0]))
    total = np.trapezoid(weights, grid)
    mean = np.trapezoid(weights * (grid - start), grid) / total
    variance = np.trapezoid(weights * (grid - start - mean) ** 2, grid) / total
    found = truncated_normal(low, high)
    np.testing.assert_allclose(found, (sign * (start + mean), variance), rtol=1e-6, atol=1e-12)
    if -12.0 < low < 12.0 and width > 0.1:  # elsewhere SciPy's are differences of equal numbers
        np.testing.assert_allclose(found, truncnorm.stats(low, high), rtol=1e-8)


def naive_truncation(x, p, bounds):
    """State after state: its moments by SciPy, all others by regression on it."""
    for i, (low, high) in bounds.items():
        s = np.sqrt(p[i, i])
        moments = truncnorm.stats((low - x[i]) / s, (high - x[i]) / s, loc=x[i], scale=s)
        slope = p[:, i] / p[i, i]
        rest = p - np.outer(slope, slope) * p[i, i]  # of the others, given this one
        x, p = x + slope * (moments[0] - x[i]), rest + np.outer(slope, slope) * moments[1]
    return x, p


def by_rejection(x, p, bounds, count=400_000):
    """Moments of samples that lie within."""
    drawn = np.random.default_rng(1).multivariate_normal(x, p, size=count)
    for i, (low, high) in bounds.items():
        drawn = drawn[(drawn[:, i] > low) & (drawn[:, i] < high)]
    return drawn.mean(axis=0), np.cov(drawn.T)


def naive_projection(x, p, bounds):
    """Least squares within a box, of the whitened distance."""
    low, high = np.full(len(x), -INF), np.full(len(x), INF)
    for i, pair in bounds.items():
        low[i], high[i] = pair
    white = np.linalg.inv(np.linalg.cholesky(p))
    return lsq_linear(white, white @ x, (low, high), method="bvls", tol=1e-14).x, p


def test_of_several_states_the_moments_are_those_of_samples_within():
    bounds = {0: (0.0, INF), 1: (-INF, -0.5), 2: (0.0, 1.0)}
    model = wide_model(prior_cov=[[1.0, 0.5, 0.2], [0.5, 0.5, 0.1], [0.2, 0.1, 0.8]])
    told = ExtendedKalmanFilter(model=model.replace(bounds=bounds)).init()
    mean, cov = by_rejection(model.prior_mean, model.prior_cov, bounds)
    np.testing.assert_allclose(told.mean, mean, atol=0.01)  # the error of 100 000 samples is some 0.002
    np.testing.assert_allclose(told.cov, cov, atol=0.02)  # what lies within is no Gaussian
    assert abs(told.cov - model.prior_cov).max() > 0.5


@pytest.mark.parametrize(
    "by, naive, bounds",
    [
        ("truncation", naive_truncation, {0: (0.0, INF)}),
        ("truncation", naive_truncation, {2: (-0.5, -0.3)}),
        ("projection", naive_projection, {0: (0.0, INF)}),
        ("projection", naive_projection, {0: (0.0, 0.2), 1: (-INF, 0.1), 2: (-0.4, INF)}),
    ],
)
def test_the_filter_goes_on_as_it_was_and_tells_what_is_within(by, naive, bounds):
    model = wide_model()
    inputs, measurements = simulated(model, 25, level=1.0, missing=0.2)
    free = run(ExtendedKalmanFilter(model=model), None, inputs, measurements)
    bounded = model.replace(bounds=bounds, bounded_by=by)
    found = run(ExtendedKalmanFilter(model=bounded), None, inputs, measurements)
    for name in ("innovations", "innovation_covs", "log_likelihoods"):
        np.testing.assert_array_equal(getattr(found, name), getattr(free, name))
    changed = 0
    for k in range(26):
        x, p = naive(free.means[0, k], free.covs[0, k], bounds)
        np.testing.assert_allclose(found.means[0, k], x, rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(found.covs[0, k], p, rtol=1e-6, atol=1e-8)
        changed += not np.allclose(x, free.means[0, k], atol=1e-3)
    assert changed > 5
    for i, (low, high) in bounds.items():
        assert (found.means[0, :, i] >= low).all() and (found.means[0, :, i] <= high).all()
    assert np.linalg.eigvalsh(found.covs[0]).min() > 0.0


@pytest.mark.parametrize("by, naive", [("truncation", naive_truncation), ("projection", naive_projection)])
@pytest.mark.parametrize("name, lag", [("ekf", None), ("ukf", 3)])
def test_the_smoother_goes_back_as_without_bounds_and_tells_what_is_within(name, lag, by, naive):
    model, bounds = wide_model(), {0: (0.0, INF)}
    inputs, measurements = simulated(model, 25, level=1.0, missing=0.2)
    free = smooth(make_filter(name, model), None, inputs, measurements, lag)
    bounded = make_filter(name, model.replace(bounds=bounds, bounded_by=by))
    found = smooth(bounded, None, inputs, measurements, lag)
    expected = [naive(x, p, bounds) for x, p in zip(free.means[0], free.covs[0], strict=True)]
    np.testing.assert_allclose(found.means[0], [x for x, _ in expected], rtol=1e-7, atol=1e-8)
    np.testing.assert_allclose(found.covs[0], [p for _, p in expected], rtol=1e-6, atol=1e-8)
    assert (free.means[0, :, 0] < 0.0).sum() > 3 and (found.means[..., 0] >= 0.0).all()


@pytest.mark.parametrize("name", PAGES)
def test_each_filter_with_a_page_keeps_the_bounds_on_all_paths(name):
    model = wide_model().replace(bounds=BY_NAME)
    filter_ = make_filter(name, model)
    inputs, z = simulated(model, 12, level=2.0, missing=0.0 if name == "kf-steady" else 0.2)
    found = run(filter_, np.array([KEY]), inputs, z)
    free = run(make_filter(name, model.replace(bounds=())), np.array([KEY]), inputs, z)
    assert (free.means[0, :, 0] < 0.0).any() and (found.means[0, :, 0] >= 0.0).all()
    assert (found.means[0, :, 2] >= -0.2).all() and (found.means[0, :, 2] <= 0.4).all()
    np.testing.assert_allclose(found.innovations, free.innovations, rtol=1e-12, atol=1e-12)
    session, belief = filter_.session(), filter_.init(KEY)
    session.start(KEY, z[0, 0])
    for k in range(13):
        if k:
            session.step(inputs[0, k - 1], z[0, k])
            belief = filter_.predict(belief, inputs[0, k - 1])
            assert belief.mean[0] >= 0.0  # predictions are within, too
        belief, _ = filter_.update(belief, z[0, k])
        each_close((session.mean, belief.mean), (found.means[0, k], found.means[0, k]), rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(belief.cov, found.covs[0, k], rtol=1e-10, atol=1e-12)


def test_of_a_constant_that_is_not_negative_the_belief_is_exact():
    """A constant from the positive half of a Gaussian, measured with noise: its posterior is a truncated Gaussian.

    So the estimate is the posterior's mean: unbiased on the prior, its squared error is the variance on average.
    """
    count, steps = 1500, 6
    model = scalar_model(
        **{"a": [[1.0]], "b": np.zeros((1, 0)), "c": [[1.0]], "state_offset": [0.0], "measurement_offset": [0.0]},
        **{"process_noise_cov": [0.0], "measurement_noise_cov": [4.0]},
        **{"prior_mean": [0.3], "prior_cov": [1.0]},
    )
    rng = np.random.default_rng(7)
    truth = truncnorm.rvs(-0.3, INF, loc=0.3, size=count, random_state=rng)
    z = truth[:, None, None] + 2.0 * rng.normal(size=(count, steps + 1, 1))
    errors = {}
    for by in ("truncation", "projection", None):
        assumed = model.replace(bounds={} if by is None else {0: (0.0, None)}, bounded_by=by or "truncation")
        found = run(ExtendedKalmanFilter(model=assumed), None, np.zeros((count, steps, 0)), z)
        errors[by] = found.means[:, :, 0] - truth[:, None]
        if by == "truncation":
            assert (found.means > 0.0).all()
            nees = mean_interval((errors[by] ** 2 / found.covs[:, :, 0, 0])[:, -1])
            assert nees.low < 1.0 < nees.high  # 95 %
            bias = mean_interval(errors[by][:, -1])
            assert bias.low < 0.0 < bias.high
        if by == "projection":
            assert (found.means >= 0.0).all() and (found.means == 0.0).any()
    rmse = {by: np.sqrt(np.mean(one[:, -1] ** 2)) for by, one in errors.items()}
    assert rmse["truncation"] < rmse["projection"] < rmse[None]
    assert np.mean(errors[None][:, -1]) < -0.1  # without bounds it is pulled below the truth


def test_other_models_made_of_one_keep_its_bounds():
    model = wide_model().replace(bounds=BY_NAME, bounded_by="projection")
    joint = augmented_model(model, {0: Unknown(0.1)})
    assert joint.bounds == model.bounds == ((0, 0.0, INF), (2, -0.2, 0.4)) and joint.bounded_by == "projection"
    assert linearize(model, np.zeros(3), np.zeros(2)).bounds == model.bounds
    assert model.digest == wide_model().digest  # bounds are no part of the plant


def test_wrong_bounds_and_what_cannot_keep_them_are_refused():
    model = wide_model()
    with pytest.raises(ValueError, match="bounds must be of states x_1, x_2, x_3, and not of angles, but got 'c'"):
        model.replace(bounds={"c": (0.0, None)})
    for pair in ((1.0, 0.0), (0.0, 0.0), 3.0, (INF, None)):
        rule = "bounds of x_2 must be two increasing numbers, of which one may be None"
        refused(rule, model.replace, bounds={1: pair})
    refused("bounded_by must be one of truncation, projection", model.replace, bounded_by="clipping")
    bounded = ExtendedKalmanFilter(model=model.replace(bounds=BY_NAME))
    with pytest.raises(ValueError, match="a smoothing_lag needs a model without bounds, but got"):
        WithSmoother(bounded.session(), bounded, 1)
