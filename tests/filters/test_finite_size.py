"""The finite-size ensemble filter: its inflation minimises the dual cost, and the rest is the transform filter."""

import numpy as np
import pytest
from scipy.linalg import cholesky, solve
from scipy.optimize import minimize_scalar

from filters import EnsembleTransformFilter, FiniteSizeEnsembleFilter, make_filter, run
from tests.filters.test_square_root_ensembles import SCALES, linear_model, naive_transform, predicted, updated
from tuning.evaluation.runs import state_errors
from tuning.experiments import lorenz63
from tuning.experiments.benchmark import mean_of_roots


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


@pytest.mark.parametrize("certainty", [0.5, 1.0, 3.0])
@pytest.mark.parametrize("far", [0.0, 1.0, 2.0])
@pytest.mark.parametrize("m", SCALES)
def test_an_update_is_that_of_the_transform_filter_after_the_inflation_of_least_cost(m, far, certainty):
    model = linear_model(m)
    forecast, _, innovation = updated(FiniteSizeEnsembleFilter, model, np.zeros(m))
    y = predicted(model, forecast.members)
    z = y.mean(axis=1) + far * np.sqrt(np.diag(innovation.cov)) * np.sign(np.arange(m) - 0.5)
    _, analysis, innovation = updated(FiniteSizeEnsembleFilter, model, z, certainty=certainty)
    r = model.measurement_noise_cov
    spread = np.sqrt(naive_factor(y, z - y.mean(axis=1), r, certainty))
    mean = forecast.members.mean(axis=1, keepdims=True)
    inflated = mean + spread * (forecast.members - mean)
    expected = naive_transform(inflated, predicted(model, inflated), z, r)
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
    here = [0, 2]
    forecast, analysis, _ = updated(FiniteSizeEnsembleFilter, model, z)
    y, r = predicted(model, forecast.members)[here], model.measurement_noise_cov[np.ix_(here, here)]
    spread = np.sqrt(naive_factor(y, z[here] - y.mean(axis=1), r, 1.0))
    mean = forecast.members.mean(axis=1, keepdims=True)
    inflated = mean + spread * (forecast.members - mean)
    expected = naive_transform(inflated, predicted(model, inflated)[here], z[here], r)
    np.testing.assert_allclose(analysis.members, expected, rtol=1e-6, atol=1e-6)


@pytest.mark.slow
def test_it_needs_no_inflation_where_the_transform_filter_loses_the_truth():
    data = lorenz63.problem.data(range(8))

    def score(name):
        filter_ = make_filter(name, lorenz63.model(), ensemble_size=6)
        estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
        return np.median(mean_of_roots(state_errors(filter_, estimates, data)[:, data.late]))

    assert 1.2 * score("enkf-n") < score("etkf")


@pytest.mark.parametrize("certainty", [0.0, -1.0, float("nan"), None])
def test_a_certainty_that_is_not_positive_is_refused(certainty):
    with pytest.raises(ValueError, match="certainty must be .* but got"):
        FiniteSizeEnsembleFilter(model=linear_model(1), certainty=certainty)
