"""Particle filters against naive ones with the same draws, the Kalman filter and its exact likelihood."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import (
    AuxiliaryParticleFilter,
    ExtendedKalmanFilter,
    KalmanFilter,
    ParticleFilter,
    StateSpaceModel,
    affine_model,
    run,
    thruster_model,
    truth,
)
from filters.particles.weights import (
    exponential,
    normalise,
    systematic_resampler,
    weighted_covariances,
    weighted_means,
)
from filters.session import Session
from thruster_env.compiled import interpreted
from thruster_env.streams import (
    FILTER_MEASUREMENT,
    FILTER_PRIOR,
    FILTER_PROCESS,
    episode_keys,
    filter_keys,
    normal_block,
    uniform_block,
)

KEY = (123456789, 4294967295)
both_kinds = pytest.mark.parametrize("kind", [ParticleFilter, AuxiliaryParticleFilter])


def plane_model(**changes):
    """n = m = 2, p = 1, with offsets and correlated noise."""
    arguments = {
        "a": [[0.9, 0.3], [-0.2, 0.8]],
        "b": [[1.0], [0.5]],
        "c": [[1.0, 0.4], [-0.3, 1.5]],
        "state_offset": [0.3, -0.2],
        "measurement_offset": [0.7, -0.1],
        "process_noise_cov": [[0.3, 0.12], [0.12, 0.2]],
        "measurement_noise_cov": [[0.5, -0.25], [-0.25, 0.4]],
        "prior_mean": [1.0, -1.0],
        "prior_cov": [[1.0, 0.4], [0.4, 0.5]],
    }
    return affine_model(**{**arguments, **changes})


def line_model():
    """n = 2, p = m = 1."""
    return plane_model(c=[[1.0, 0.4]], measurement_offset=[0.7], measurement_noise_cov=[0.5])


def root(cov):
    return np.linalg.cholesky(cov)


def normals(stream, step, rows, size):
    """The normals (rows, size) of a stream: channel i of member j is number i * width + j of one long draw."""
    width = -(-size // 8) * 8  # ensembles are padded to a multiple of eight
    index = np.arange(rows * width)
    block = np.array(normal_block(index // 4, step, stream, *KEY))
    return block[index % 4, index].reshape(rows, width)[:, :size]


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


@pytest.mark.parametrize("threshold", [0.0, 0.5, 1.0])
def test_bootstrap_cycles_are_the_naive_ones_with_the_same_draws(threshold):
    model, size = plane_model(), 13
    a, b, offset, c, shift = model.matrices()
    filter_ = ParticleFilter(model=model, ensemble_size=size, resampling_threshold=threshold)
    with interpreted():
        belief = filter_.init(KEY)
        x = model.prior_mean[:, None] + root(model.prior_cov) @ normals(FILTER_PRIOR, 0, 2, size)
        w = np.full(size, 1.0 / size)
        assert_belief(filter_, belief, x, w)
        for step, (u, z) in enumerate(CYCLES):
            if 1.0 / (w**2).sum() < threshold * size:
                x, w = x[:, resampled(w, step)], np.full(size, 1.0 / size)
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


def test_auxiliary_cycles_are_the_naive_ones_with_the_same_draws():
    model, size = plane_model(), 13
    a, b, offset, c, shift = model.matrices()
    r = model.measurement_noise_cov
    filter_ = AuxiliaryParticleFilter(model=model, ensemble_size=size)
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
            x = foreseen[:, parents] + noise
            w = densities(z, c @ x + shift[:, None], r) / fit[parents]
            log_likelihood = math.log(first.sum()) + math.log(w.mean())
            assert innovation.log_likelihood == pytest.approx(log_likelihood, rel=1e-10)
            w = w / w.sum()
            assert_belief(filter_, belief, x, w)
            np.testing.assert_array_equal(belief.members[3:], 0.0)


def test_resampling_draws_each_particle_as_often_as_its_weight_says():
    size, rng = 9, np.random.default_rng(4)
    weights = rng.exponential(size=size) ** 3
    weights[[0, 4, 8]] = 0.0
    resample, counts, repeats = systematic_resampler(1, 1, 2), np.zeros(size), 2000
    for u in (np.arange(repeats) + 0.5) / repeats:
        table = np.zeros((5, 16))
        table[0, :size], table[1, :size] = np.arange(size), weights
        resample(table, size, u)
        drawn = table[0, :size].astype(int)
        expected = np.searchsorted(np.cumsum(weights) / weights.sum(), (u + np.arange(size)) / size)
        np.testing.assert_array_equal(drawn, expected)
        assert (table[0, size:] == drawn[0]).all()  # padding follows a real particle
        count = np.bincount(drawn, minlength=size)
        assert (np.abs(count - size * weights / weights.sum()) < 1.0).all()
        counts += count
    # Over all u a particle is drawn N w times; a grid of 2000 of them leaves an error of 1/2000 for each edge.
    np.testing.assert_allclose(counts / repeats, size * weights / weights.sum(), atol=2.0 / repeats)


def test_resampling_of_no_weight_at_all_changes_nothing():
    table = np.zeros((5, 8))
    table[0] = np.arange(8.0)
    for weight in (0.0, np.nan):
        table[1] = weight
        systematic_resampler(1, 1, 2)(table, 6, 0.5)
        np.testing.assert_array_equal(table[0], np.arange(8.0))


def test_the_exponential_is_one():
    x = np.random.default_rng(0).uniform(-45.0, 5.0, size=2000)
    np.testing.assert_allclose([exponential(v) for v in x], np.exp(x), rtol=1e-13)
    assert exponential(0.0) == 1.0
    assert exponential(-math.inf) == exponential(math.nan) == pytest.approx(math.exp(-46.0))


def test_weights_are_normalised_and_tell_their_effective_size():
    logarithms = np.array([-1000.0, -1001.0, -1002.5, -1900.0])
    table = np.zeros((2, 8))
    table[0, :4] = logarithms
    total, size = normalise(table, 0, 1, 4)
    w = np.exp(logarithms + 1000.0)
    assert total == pytest.approx(-1000.0 + math.log(w.sum()), rel=1e-14)
    np.testing.assert_allclose(table[1, :4], w / w.sum(), rtol=1e-12, atol=1e-19)
    np.testing.assert_allclose(table[0, :4], logarithms - total, rtol=1e-12)
    assert size == pytest.approx(w.sum() ** 2 / (w**2).sum())
    table[0, :4] = -math.inf
    assert all(math.isnan(value) for value in (normalise(table, 0, 1, 4)[0], *table[1, :4]))


def test_the_covariance_of_equal_weights_is_the_sample_covariance():
    table = np.zeros((3, 16))
    table[:2, :11] = np.random.default_rng(2).normal(size=(2, 11))
    table[2, :11] = 1.0 / 11
    means = weighted_means(0, 2, 2)(table, 11)
    found = weighted_covariances(0, 2, 2)(table, 11, means)
    np.testing.assert_allclose(means, table[:2, :11].mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(found, np.cov(table[:2, :11]), rtol=1e-12)


@both_kinds
def test_it_converges_to_the_kalman_filter_like_one_over_root_n(kind):
    model = line_model()
    inputs = np.random.default_rng(0).normal(size=(60, 30, 1))
    drawn = truth.simulate(model, episode_keys(range(60)), inputs)
    keys = filter_keys(range(60))
    exact = run(KalmanFilter(model=model), keys, inputs, drawn.measurements)
    spread = np.sqrt(np.einsum("bkii->bki", exact.covs))
    scale = spread[..., :, None] * spread[..., None, :]
    sizes, in_mean, in_cov = np.array([100, 400, 1600, 6400]), [], []
    for size in sizes:
        found = run(kind(model=model, ensemble_size=size), keys, inputs, drawn.measurements)
        in_mean.append(np.sqrt(np.mean(((found.means - exact.means) / spread) ** 2)))
        in_cov.append(np.sqrt(np.mean(((found.covs - exact.covs) / scale) ** 2)))
    for errors in (in_mean, in_cov):
        slope = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
        assert -0.6 < slope < -0.4  # 60 independent runs give each error to about 6 %, the slope to 0.03
    # Averaged over the runs nothing remains but the bias of order 1/N: four standard errors.
    bias = ((found.means - exact.means) / spread)[:, -1].mean(axis=0)
    assert (np.abs(bias) < 4 * in_mean[-1] / math.sqrt(60)).all()
    likelihoods = (found.log_likelihoods - exact.log_likelihoods).sum(axis=1)
    assert abs(likelihoods.mean() + likelihoods.var() / 2) < 4 * likelihoods.std(ddof=1) / math.sqrt(60)


@both_kinds
def test_the_likelihood_is_right_on_average_however_few_particles(kind):
    model, runs = line_model(), 4000
    inputs = np.random.default_rng(3).normal(size=(1, 6, 1))
    z = truth.simulate(model, episode_keys([5]), inputs).measurements
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


@both_kinds
def test_batch_and_session_agree_bit_for_bit_over_500_steps(kind):
    model = thruster_model()
    filter_ = kind(model=model, ensemble_size=1000)
    inputs = np.repeat(np.random.default_rng(2).uniform(-12.0, 12.0, size=(1, 20, 1)), 25, axis=1)
    z = truth.simulate(model, episode_keys([1]), inputs).measurements
    z[0, 100:120] = np.nan
    means = run(filter_, np.array([KEY]), inputs, z).means[0]
    session = Session(filter_)
    session.start(KEY, z[0, 0])
    for k in range(500):
        session.step(inputs[0, k], z[0, k + 1])
        np.testing.assert_array_equal(session.mean, means[k + 1])


@both_kinds
def test_on_the_thruster_with_the_published_noise_it_halves_the_extended_filter_s_error(kind):
    model = thruster_model(process_noise_cov=[0.5, 0.5], measurement_noise_cov=0.5)
    inputs = np.repeat(np.random.default_rng(20).uniform(-12.0, 12.0, size=(30, 10, 1)), 25, axis=1)
    drawn = truth.simulate(model, episode_keys(range(30)), inputs)
    squares = []
    for filter_ in (ExtendedKalmanFilter(model=model), kind(model=model, ensemble_size=1000)):
        estimates = run(filter_, filter_keys(range(30)), inputs, drawn.measurements)
        assert (estimates.divergences == 0).all()
        squares.append(((estimates.means - drawn.states)[:, 50:, 1] ** 2).mean(axis=1))
    gain = 0.25 * squares[0] - squares[1]  # positive on average if the RMSE is below half
    assert gain.mean() > 1.96 * gain.std(ddof=1) / math.sqrt(30)


def test_a_million_particles_are_enough_for_any_moment():
    model = line_model()
    inputs, keys = np.ones((1, 4, 1)), np.array([KEY], dtype=float)
    z = truth.simulate(model, episode_keys([1]), inputs).measurements
    exact = run(KalmanFilter(model=model), keys, inputs, z)
    found = run(ParticleFilter(model=model, ensemble_size=1_000_000), keys, inputs, z)
    spread = np.sqrt(np.einsum("bkii->bki", exact.covs))
    # The weights leave about a third of the particles; five standard errors of their mean.
    assert (np.abs(found.means - exact.means) < 5 * spread * math.sqrt(3.0 / 1e6)).all()


def needs_positive(x, u, c):
    return (math.log(x[0]) + 3.0,)


def see(x, c):
    return (x[0],)


@both_kinds
def test_only_real_particles_are_put_through_the_model(kind):
    """What pads the particles to full vector registers must not fail where no particle does."""
    model = StateSpaceModel(
        transition=needs_positive,
        observe=see,
        process_noise_cov=[0.01],
        measurement_noise_cov=[0.01],
        prior_mean=[5.0],
        prior_cov=[0.01],
    )
    filter_ = kind(model=model, ensemble_size=5)
    with interpreted():
        belief = filter_.init(KEY)
        for _ in range(20):
            belief, _ = filter_.update(filter_.predict(belief, [0.0]), [4.5])
    assert belief.mean[0] == pytest.approx(4.5, abs=0.3)


@pytest.mark.parametrize("size", [1, 0, -3, 2.5, math.nan, "many", None, 1_000_001])
@both_kinds
def test_a_number_of_particles_that_cannot_be_is_refused(kind, size):
    with pytest.raises(ValueError, match="ensemble_size must be .* but got"):
        kind(model=line_model(), ensemble_size=size)


@pytest.mark.parametrize("threshold", [-0.1, 1.1, math.nan, "often"])
def test_a_threshold_that_is_no_fraction_is_refused(threshold):
    with pytest.raises(ValueError, match="resampling_threshold must be .* but got"):
        ParticleFilter(model=line_model(), resampling_threshold=threshold)
