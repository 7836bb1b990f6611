"""Particle filters against naive ones with the same draws, the Kalman filter and its exact likelihood."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import AuxiliaryParticleFilter, KalmanFilter, ParticleFilter, run
from tests.models import KEY, line_model, plane_model
from tests.oracles import each_close, normals
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import (
    FILTER_KERNEL,
    FILTER_MEASUREMENT,
    FILTER_PRIOR,
    FILTER_PROCESS,
    episode_keys,
    uniform_block,
)
from thruster_env.model import simulate

both_kinds = pytest.mark.parametrize("kind", [ParticleFilter, AuxiliaryParticleFilter])
quick_kind = pytest.mark.parametrize("kind", slow_but([ParticleFilter, AuxiliaryParticleFilter], [ParticleFilter]))


def root(cov):
    return np.linalg.cholesky(cov)


def resampled(weights, step):
    """Indices of Kitagawa's systematic resampling, as the textbook has it."""
    u, *_ = uniform_block(0, step, FILTER_MEASUREMENT, *KEY)
    positions = (u + np.arange(len(weights))) / len(weights)
    return np.searchsorted(np.cumsum(weights) / weights.sum(), positions)


def densities(z, y, cov):
    return np.array([multivariate_normal.pdf(z, mean, cov) for mean in y.T])


def weighted_covariance(x, w):
    """The sample covariance for weights, by pairs: sums in which nothing cancels."""
    w = np.maximum(w, math.exp(-46.0) * w.max())  # no weight counts for less
    apart = x[:, :, None] - x[:, None, :]
    pairs = np.where(np.eye(len(w), dtype=bool), 0.0, np.outer(w, w))
    return 0.5 * np.einsum("jk,ajk,bjk->ab", pairs, apart, apart) / pairs.sum()


def assert_belief(filter_, belief, x, w):
    close = {"rtol": 1e-9, "atol": 1e-12}
    mean = x @ w
    each_close((belief.members[:2], np.exp(belief.members[2]), belief.mean), (x, w, mean), **close)
    np.testing.assert_allclose(belief.cov, weighted_covariance(x, w), **close)
    assert filter_.effective_sample_size(belief) == pytest.approx(1.0 / (w**2).sum(), rel=1e-9)


def assert_innovation(innovation, model, z, y, w):
    np.testing.assert_allclose(innovation.value, z - y @ w, rtol=1e-9)
    np.testing.assert_allclose(innovation.cov, weighted_covariance(y, w) + model.measurement_noise_cov, rtol=1e-9)


CYCLES = [(0.5, [2.0, -1.0]), (-1.0, [0.3, 0.9]), (0.0, [4.0, 1.0])]


def kernel(cov, width, step, size):
    """What regularisation adds to the particles."""
    best = (4.0 / (2 + 2)) ** (1 / 6) * size ** (-1 / 6)  # Silverman's, for two states
    return width * best * root(cov) @ normals(FILTER_KERNEL, step, 2, size)


@pytest.mark.parametrize(("threshold", "width"), [(0.0, 0.0), (0.5, 0.0), (1.0, 0.0), (1.0, 0.7)])
def test_bootstrap_cycles_are_the_naive_ones_with_the_same_draws(threshold, width):
    model, size = plane_model(), 13
    a, b, offset, c, shift = model.matrices()
    numbers = {"resampling_threshold": threshold, "regularisation": width}
    filter_ = ParticleFilter(model=model, ensemble_size=size, **numbers)
    with interpreted():
        belief = filter_.init(KEY)
        x = model.prior_mean[:, None] + root(model.prior_cov) @ normals(FILTER_PRIOR, 0, 2, size)
        w = np.full(size, 1.0 / size)
        assert_belief(filter_, belief, x, w)
        for step, (u, z) in enumerate(CYCLES):
            if 1.0 / (w**2).sum() < threshold * size * (1.0 - 1e-12):
                spread = kernel(weighted_covariance(x, w), width, step, size)
                x, w = x[:, resampled(w, step)] + spread, np.full(size, 1.0 / size)
            x = a @ x + b * u + offset[:, None]
            x = x + root(model.process_noise_cov) @ normals(FILTER_PROCESS, step + 1, 2, size)
            belief = filter_.predict(belief, [u])
            each_close((belief.members[:2], belief.mean), (x, x @ w), rtol=1e-12, atol=1e-12)

            belief, innovation = filter_.update(belief, z)
            y = c @ x + shift[:, None]
            assert_innovation(innovation, model, z, y, w)
            w = w * densities(z, y, model.measurement_noise_cov)
            assert innovation.log_likelihood == pytest.approx(math.log(w.sum()), rel=1e-10)
            w = w / w.sum()
            assert_belief(filter_, belief, x, w)


@pytest.mark.parametrize("width", [0.0, 0.7])
def test_auxiliary_cycles_are_the_naive_ones_with_the_same_draws(width):
    model, size = plane_model(), 13
    a, b, offset, c, shift = model.matrices()
    r = model.measurement_noise_cov
    filter_ = AuxiliaryParticleFilter(model=model, ensemble_size=size, regularisation=width)
    with interpreted():
        belief = filter_.init(KEY)
        x = model.prior_mean[:, None] + root(model.prior_cov) @ normals(FILTER_PRIOR, 0, 2, size)
        w = np.full(size, 1.0 / size)
        for step, (u, z) in enumerate(CYCLES, start=1):
            foreseen = a @ x + b * u + offset[:, None]
            noise = root(model.process_noise_cov) @ normals(FILTER_PROCESS, step, 2, size)
            belief = filter_.predict(belief, [u])
            each_close((belief.members[:2], belief.members[3:]), (foreseen + noise, noise), rtol=1e-12, atol=1e-12)

            belief, innovation = filter_.update(belief, z)
            y = c @ (foreseen + noise) + shift[:, None]
            assert_innovation(innovation, model, z, y, w)
            effect = c @ noise
            fit = densities(z, c @ foreseen + shift[:, None], r + (w * effect) @ effect.T)
            first = w * fit
            parents = resampled(first, step)
            spread = kernel(weighted_covariance(foreseen, first / first.sum()), width, step, size)
            x = foreseen[:, parents] + spread + noise
            w = densities(z, c @ x + shift[:, None], r) / fit[parents]
            log_likelihood = math.log(first.sum()) + math.log(w.mean())
            assert innovation.log_likelihood == pytest.approx(log_likelihood, rel=1e-10)
            w = w / w.sum()
            assert_belief(filter_, belief, x, w)
            np.testing.assert_array_equal(belief.members[3:], 0.0)


@quick_kind
def test_the_likelihood_is_right_on_average_however_few_particles(kind):
    model, runs = line_model(), 4000
    inputs = np.random.default_rng(3).normal(size=(1, 6, 1))
    z = simulate.simulate(model, episode_keys([5]), inputs).measurements
    keys = np.random.default_rng(8).integers(0, 2**32, size=(runs, 2)).astype(float)
    exact = run(KalmanFilter(model=model), keys[:1], inputs, z).log_likelihoods.sum()
    data = np.repeat(inputs, runs, axis=0), np.repeat(z, runs, axis=0)
    found = run(kind(model=model, ensemble_size=50), keys, *data).log_likelihoods.sum(axis=1)
    ratio = np.exp(found - exact)
    assert ratio.std() > 0.05  # there is something to average
    assert abs(ratio.mean() - 1.0) < 4 * ratio.std(ddof=1) / math.sqrt(runs)


@both_kinds
@pytest.mark.filterwarnings("ignore::RuntimeWarning")  # Python says so when a number overflows
def test_an_impossible_measurement_is_counted_and_leaves_the_prior(kind):
    model = line_model()
    filter_ = kind(model=model, ensemble_size=20)
    with interpreted():
        prior = filter_.init(KEY)
        belief = filter_.predict(prior, [1.0])
        lost, innovation = filter_.update(belief, [1e200])
        assert lost.divergences == 1
        assert (innovation.value == 0.0).all() and innovation.log_likelihood == 0.0
        assert np.isfinite(lost.members).all() and np.isfinite(lost.mean).all()
        assert filter_.effective_sample_size(lost) == 20.0
        assert (np.abs(lost.mean - model.prior_mean) < 4.0 * np.sqrt(np.diag(model.prior_cov) / 20)).all()
        held, innovation = filter_.update(belief, [1e9])  # improbable, but one particle is the least so
    assert held.divergences == 0
    assert np.isfinite(held.mean).all() and np.isfinite(innovation.log_likelihood)
    assert filter_.effective_sample_size(held) == pytest.approx(1.0)
    # One particle has all the weight; how wrong it may be is what the others say.
    assert (np.diag(held.cov) > 0.3 * np.diag(belief.cov)).all()


@both_kinds
def test_a_second_measurement_of_the_same_step_is_taken_as_well(kind):
    model = line_model()
    with interpreted():
        exact, found = KalmanFilter(model=model), kind(model=model, ensemble_size=4000)
        means = []
        for filter_ in (exact, found):
            belief = filter_.predict(filter_.init(KEY), [1.0])
            for z in ([2.0], [2.5]):
                belief, _ = filter_.update(belief, z)
            means.append(belief.mean)
    assert (np.abs(means[0] - means[1]) < 0.1 * np.sqrt(np.diag(belief.cov))).all()


def test_a_million_particles_are_enough_for_any_moment():
    model = line_model()
    inputs, keys = np.ones((1, 4, 1)), np.array([KEY], dtype=float)
    z = simulate.simulate(model, episode_keys([1]), inputs).measurements
    exact = run(KalmanFilter(model=model), keys, inputs, z)
    found = run(ParticleFilter(model=model, ensemble_size=1_000_000), keys, inputs, z)
    spread = np.sqrt(np.einsum("bkii->bki", exact.covs))
    # The weights leave about a third of the particles; five standard errors of their mean.
    assert (np.abs(found.means - exact.means) < 5 * spread * math.sqrt(3.0 / 1e6)).all()
