"""Scores of the estimate at the true states against SciPy's densities, and their gradients against differences."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import run
from filters.sensitivity import state_score
from tests.filters.test_differentiated import swing_if
from tests.filters.test_likelihood import directions, two_channels
from tests.models import pendulum
from thruster_env.core.angles import wrapped
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate

WEIGHTS = np.array([4.0, 0.25])


def data_of(model, count=5, steps=30):
    """Five runs, four of which lie side by side; missing measurements, and states that do not count."""
    keys, rng = episode_keys(range(count)), np.random.default_rng(0)
    inputs = rng.uniform(-2, 2, size=(count, steps, model.inputs))
    drawn = simulate.simulate(model, keys, inputs)
    z, x = drawn.measurements, drawn.states.copy()
    z[0, 5, 0] = np.nan
    z[1, 0] = np.nan
    x[:, :4] = np.nan
    x[2, 10, 0] = x[3, 11, 1] = np.nan
    return keys, inputs, z, x


def errors_of(model, estimates, x):
    off = x - estimates.means
    angles = model.shape.state_angles
    return np.stack([wrapped(off[..., i]) if angles[i] else off[..., i] for i in range(model.n)], axis=-1)


def textbook(model, filter_, data, score):
    """The sum over the states that count, written with SciPy."""
    keys, inputs, z, x = data
    estimates = run(filter_(model=model), keys, inputs, z)
    off = errors_of(model, estimates, x)
    if score == "squares":
        return -np.nansum(WEIGHTS * off**2, axis=(1, 2))
    sums = np.zeros(len(z))
    for b, k in np.argwhere(np.isfinite(off).any(axis=-1)):
        seen = np.isfinite(off[b, k])
        cov = estimates.covs[b, k][np.ix_(seen, seen)]
        sums[b] += multivariate_normal(np.zeros(seen.sum()), cov).logpdf(off[b, k][seen])
    return sums


@pytest.mark.parametrize("score", ["log-score", "squares"])
def test_called_and_interpreted_models_have_the_scores_of_traced_ones(score):
    model = pendulum()
    data, slopes = data_of(model)[1:], list(directions(model))
    traced = state_score(model, *data, *slopes, score)
    with interpreted():
        plain = state_score(model, *data, *slopes, score)
        called = state_score(model.replace(transition=swing_if), *data, *slopes, score)
    for a, b, c in zip(traced, plain, called, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-9 * abs(a).max())
        np.testing.assert_allclose(a, c, rtol=1e-5, atol=1e-5 * abs(a).max())


def test_what_does_not_fit_is_refused():
    model = two_channels()
    inputs, z, x = (one[:2] for one in data_of(model)[1:])
    q, r = np.zeros((1, 2, 2)), np.zeros((1, 2, 2))
    with pytest.raises(ValueError, match="score must be one of log-score, squares, but got 'mse'"):
        state_score(model, inputs, z, x, q, r, "mse")
    with pytest.raises(ValueError, match="must have the shapes"):
        state_score(model, inputs, z, x[:, 1:], q, r)
    with pytest.raises(ValueError, match=r"weights must have the shape \(2,\), but got \(3,\)"):
        state_score(model, inputs, z, x, q, r, "squares", np.ones(3))
