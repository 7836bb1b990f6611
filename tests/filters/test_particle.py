"""Particle filters against naive ones with the same draws, the Kalman filter and its exact likelihood."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import AuxiliaryParticleFilter, KalmanFilter, ParticleFilter, run, thruster_model
from filters.engine.session import Session
from tests.models import KEY, held_voltages, line_model, plane_model, simulated
from tests.oracles import convergence, normals, relative_errors
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import (
    FILTER_KERNEL,
    FILTER_MEASUREMENT,
    FILTER_PRIOR,
    FILTER_PROCESS,
    episode_keys,
    filter_keys,
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
    np.testing.assert_allclose(belief.members[:2], x, **close)
    np.testing.assert_allclose(np.exp(belief.members[2]), w, **close)
    np.testing.assert_allclose(belief.mean, mean, **close)
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
            np.testing.assert_allclose(belief.members[:2], x, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(belief.mean, x @ w, rtol=1e-12, atol=1e-12)

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
            np.testing.assert_allclose(belief.members[:2], foreseen + noise, rtol=1e-12, atol=1e-12)
            np.testing.assert_allclose(belief.members[3:], noise, rtol=1e-12, atol=1e-12)

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


@pytest.mark.slow
@pytest.mark.parametrize("kind", [ParticleFilter, AuxiliaryParticleFilter])
def test_it_converges_to_the_kalman_filter_like_one_over_root_n(kind):
    model = line_model()
    inputs, measurements = simulated(model, 30, count=60, seed=0, level=1.0, compiled=True)
    data = filter_keys(range(60)), inputs, measurements
    exact, sizes = run(KalmanFilter(model=model), *data), [100, 400, 1600, 6400]
    errors, found = convergence(
        lambda size: kind(model=model, ensemble_size=size), sizes, data, exact.means, exact.covs
    )
    for slope in np.polyfit(np.log(sizes), np.log(errors.T), 1)[0]:
        assert -0.6 < slope < -0.4  # 60 independent runs give each error to about 6 %, the slope to 0.03
    # Averaged over the runs nothing remains but the bias of order 1/N: four standard errors.
    bias = relative_errors(found, exact.means, exact.covs)[0][:, -1].mean(axis=0)
    assert (np.abs(bias) < 4 * errors[0, -1] / math.sqrt(60)).all()
    likelihoods = (found.log_likelihoods - exact.log_likelihoods).sum(axis=1)
    assert abs(likelihoods.mean() + likelihoods.var() / 2) < 4 * likelihoods.std(ddof=1) / math.sqrt(60)


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
def test_the_likelihood_of_a_channel_is_its_own_where_the_other_is_missing(kind):
    both = plane_model()
    _, _, _, c, shift = both.matrices()
    one = plane_model(
        c=c[[1]], measurement_offset=shift[[1]], measurement_noise_cov=both.measurement_noise_cov[1:, 1:]
    )
    with interpreted():
        found = []
        for model, z in ((both, [np.nan, 2.0]), (one, [2.0])):
            filter_ = kind(model=model, ensemble_size=50)
            belief, innovation = filter_.update(filter_.predict(filter_.init(KEY), [1.0]), z)
            found.append((innovation.log_likelihood, *belief.mean, *belief.extras))
    np.testing.assert_allclose(*found, rtol=1e-12)


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


@quick_kind
def test_batch_and_session_agree_bit_for_bit_over_500_steps(kind):
    model = thruster_model()
    filter_ = kind(model=model, ensemble_size=1000)
    inputs = held_voltages(1, 20, seed=2)
    z = simulate.simulate(model, episode_keys([1]), inputs).measurements
    z[0, 100:120] = np.nan
    means = run(filter_, np.array([KEY]), inputs, z).means[0]
    session = Session(filter_)
    session.start(KEY, z[0, 0])
    for k in range(500):
        session.step(inputs[0, k], z[0, k + 1])
        np.testing.assert_array_equal(session.mean, means[k + 1])


def test_a_million_particles_are_enough_for_any_moment():
    model = line_model()
    inputs, keys = np.ones((1, 4, 1)), np.array([KEY], dtype=float)
    z = simulate.simulate(model, episode_keys([1]), inputs).measurements
    exact = run(KalmanFilter(model=model), keys, inputs, z)
    found = run(ParticleFilter(model=model, ensemble_size=1_000_000), keys, inputs, z)
    spread = np.sqrt(np.einsum("bkii->bki", exact.covs))
    # The weights leave about a third of the particles; five standard errors of their mean.
    assert (np.abs(found.means - exact.means) < 5 * spread * math.sqrt(3.0 / 1e6)).all()


@pytest.mark.parametrize("size", [1, 0, -3, 2.5, math.nan, "many", None, 1_000_001])
@both_kinds
def test_a_number_of_particles_that_cannot_be_is_refused(kind, size):
    with pytest.raises(ValueError, match="ensemble_size must be .* but got"):
        kind(model=line_model(), ensemble_size=size)


@pytest.mark.parametrize("threshold", [-0.1, 1.1, math.nan, "often"])
def test_a_threshold_that_is_no_fraction_is_refused(threshold):
    with pytest.raises(ValueError, match="resampling_threshold must be .* but got"):
        ParticleFilter(model=line_model(), resampling_threshold=threshold)
