"""Particle filters against naive ones with the same draws, closed forms, the Kalman filter and its likelihood."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal, norm

from filters import (
    AuxiliaryParticleFilter,
    KalmanFilter,
    ParticleFilter,
    StateSpaceModel,
    Unknown,
    augmented_model,
    make_filter,
    run,
)
from tests.models import KEY, line_model, plane_model, scalar_model, simulated, state_space
from tests.oracles import assert_normal, each_close, each_equal, normals
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import (
    FILTER_KERNEL,
    FILTER_MEASUREMENT,
    FILTER_PRIOR,
    FILTER_PROCESS,
    FILTER_PROPOSAL,
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


@pytest.mark.usefixtures("as_python")
def test_with_linear_h_the_optimal_weight_is_how_well_the_parent_predicted():
    """Doucet, Godsill, Andrieu (2000), equation (17): p(z | x_before), where the bootstrap filter has p(z | x)."""
    model, size = plane_model(), 13
    a, b, offset, c, shift = model.matrices()
    q, r = model.process_noise_cov, model.measurement_noise_cov
    filter_ = ParticleFilter(model=model, ensemble_size=size, proposal="optimal")
    belief = filter_.init(KEY)
    x = model.prior_mean[:, None] + root(model.prior_cov) @ normals(FILTER_PRIOR, 0, 2, size)
    w, times = np.full(size, 1.0 / size), 0
    for step, (u, z) in enumerate([*CYCLES, (0.5, [1.0, np.nan]), (1.0, [6.0, -4.0])]):
        if 1.0 / (w**2).sum() < 0.5 * size:
            x, w, times = x[:, resampled(w, step)], np.full(size, 1.0 / size), times + 1
        mu = a @ x + b * u + offset[:, None]
        noise = root(q) @ normals(FILTER_PROCESS, step + 1, 2, size)
        belief = filter_.predict(belief, [u])
        np.testing.assert_allclose(belief.members[:2], mu + noise, rtol=1e-12, atol=1e-12)

        there = ~np.isnan(z)
        h, z_there = c[there], np.array(z)[there]
        s = h @ q @ h.T + r[np.ix_(there, there)]
        k = q @ h.T @ np.linalg.inv(s)
        y = (c @ (mu + noise) + shift[:, None])[there]
        perturbed = y + (root(r) @ normals(FILTER_PROPOSAL, step + 1, 2, size))[there]
        x = mu + noise + k @ (z_there[:, None] - perturbed)
        belief, innovation = filter_.update(belief, z)
        if there.all():
            assert_innovation(innovation, model, z, y, w)
        w = w * densities(z_there, (c @ mu + shift[:, None])[there], s)
        assert innovation.log_likelihood == pytest.approx(math.log(w.sum()), rel=1e-9)
        w = w / w.sum()
        assert_belief(filter_, belief, x, w)
        np.testing.assert_array_equal(belief.members[3:], 0.0)
    assert times > 0


@pytest.mark.usefixtures("as_python")
def test_with_linear_h_the_optimal_proposal_is_the_kalman_update_of_each_parent():
    model, size, z = plane_model(prior_cov=np.zeros((2, 2))), 4000, [2.0, -1.0]
    a, b, offset, c, shift = model.matrices()
    q, r = model.process_noise_cov, model.measurement_noise_cov
    filter_ = ParticleFilter(model=model, ensemble_size=size, proposal="optimal")
    belief, innovation = filter_.update(filter_.predict(filter_.init(KEY), [0.5]), z)
    mu, s = a @ model.prior_mean + b[:, 0] * 0.5 + offset, c @ q @ c.T + r
    gain = q @ c.T @ np.linalg.inv(s)
    assert_normal(belief.members[:2], q - gain @ c @ q, mu + gain @ (z - c @ mu - shift))
    np.testing.assert_allclose(np.exp(belief.members[2]), 1.0 / size, rtol=1e-9)  # one parent, one weight
    assert innovation.log_likelihood == pytest.approx(
        math.log(densities(np.array(z), (c @ mu + shift)[:, None], s)[0])
    )


def bent(x, c):
    return (x[0] + 0.3 * x[0] * abs(x[0]),)


def bent_by_branches(x, c):
    return (x[0] + 0.3 * x[0] * (x[0] if int(x[0] > 0.0) else -x[0]),)


def bent_model(observe):
    return state_space(lambda x, u, c: (0.9 * x[0],), observe, q=[0.5], r=[0.04], mean=[0.4], cov=[0.0], inputs=0)


@pytest.mark.usefixtures("as_python")
def test_with_nonlinear_h_the_weights_correct_the_proposal():
    """Mean, variance, likelihood are those of p(x | z), by quadrature; a function that is called does the same."""
    grid = np.linspace(-6.0, 6.0, 200_001)
    density = norm.pdf(grid, 0.36, math.sqrt(0.5)) * norm.pdf(1.9, bent([grid], None)[0], 0.2)
    total = np.trapezoid(density, grid)
    mean = np.trapezoid(grid * density, grid) / total
    variance = np.trapezoid((grid - mean) ** 2 * density, grid) / total
    found = []
    for observe, size in ((bent, 20_000), (bent, 50), (bent_by_branches, 50)):
        filter_ = make_filter("pf", bent_model(observe), ensemble_size=size, proposal="optimal")
        belief, innovation = filter_.update(filter_.predict(filter_.init(KEY), []), [1.9])
        found.append((belief.mean[0], belief.cov[0, 0], innovation.log_likelihood))
    assert found[0][0] == pytest.approx(mean, abs=4 * math.sqrt(variance / 15_000))
    assert found[0][1] == pytest.approx(variance, rel=0.06)
    assert found[0][2] == pytest.approx(math.log(total), abs=0.03)
    np.testing.assert_allclose(found[2], found[1], rtol=1e-7)


@pytest.mark.usefixtures("as_python")
def test_gaussian_particles_are_drawn_from_the_belief():
    model, size = plane_model(), 13
    a, b, offset, _, _ = model.matrices()
    filter_ = ParticleFilter(model=model, ensemble_size=size, resampling="gaussian", resampling_threshold=1.0)
    belief, _ = filter_.update(filter_.init(KEY), [2.0, -1.0])
    x = belief.mean[:, None] + root(belief.cov) @ normals(FILTER_KERNEL, 0, 2, size)
    x = a @ x + b * 0.5 + offset[:, None] + root(model.process_noise_cov) @ normals(FILTER_PROCESS, 1, 2, size)
    assert_belief(filter_, filter_.predict(belief, [0.5]), x, np.full(size, 1.0 / size))


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("smoothed", [(1,), (0, 1)])
def test_smoothed_constants_are_shrunk_and_spread_as_liu_and_west_have_it(smoothed):
    model, size = line_model(), 13
    a, b, offset, _, _ = model.matrices()
    numbers = {"regularisation": 0.9, "resampling_threshold": 1.0}
    filter_ = ParticleFilter(model=model, ensemble_size=size, smoothed=smoothed, **numbers)
    belief, _ = filter_.update(filter_.init(KEY), [2.0])
    x, w, at = belief.members[:2], np.exp(belief.members[2]), list(smoothed)
    count = len(at)
    width = 0.9 * (4.0 / (count + 2)) ** (1 / (count + 4)) * size ** (-1 / (count + 4))
    chosen, cov = x[:, resampled(w, 0)], weighted_covariance(x, w)[np.ix_(at, at)]
    middle = chosen[at].mean(axis=1, keepdims=True)
    kernel = width * root(cov) @ normals(FILTER_KERNEL, 0, 2, size)[at]
    chosen[at] = middle + math.sqrt(1.0 - width**2) * (chosen[at] - middle) + kernel
    moved = a @ chosen + b * 0.5 + offset[:, None]
    moved += root(model.process_noise_cov) @ normals(FILTER_PROCESS, 1, 2, size)
    found = filter_.predict(belief, [0.5])
    np.testing.assert_allclose(found.members[:2], moved, rtol=1e-9, atol=1e-12)


@pytest.mark.usefixtures("as_python")
def test_a_smoothed_constant_goes_on_being_learnt():
    """Few values of a constant that is measured are soon one; smoothed, they stay about the exact mean."""
    model = augmented_model(slope_model(), {0: Unknown(std=10.0)})
    data = filter_keys(range(8)), np.zeros((8, 100, 0)), np.repeat(slope_measurements(steps=100), 8, axis=0)
    exact = run(make_filter("ekf", model), *data)  # all is affine
    squares, copies = [], []
    for numbers in ({}, {"smoothed": [-1], "regularisation": 1.0}):
        found = run(make_filter("pf", model, ensemble_size=60, **numbers), *data)
        squares.append(((found.means - exact.means)[:, -1, 1] ** 2 / exact.covs[:, -1, 1, 1]).mean())
        copies.append((found.covs / exact.covs)[:, -1, 1, 1].min())
    assert squares[0] > 3.0 and copies[0] < 1e-3
    assert squares[1] < 1.0 and copies[1] > 0.1


def slope_model():
    """z = x + theta + v of a slow x: affine also where theta is a state."""
    noise = {"q": [0.1], "r": [0.5]}
    prior = {"mean": [0.0], "cov": [0.1]}
    return state_space(
        lambda x, u, c: (0.5 * x[0],), lambda x, c: (x[0] + c[0],), **noise, **prior, inputs=0, constants=(0.0,)
    )


def slope_measurements(steps):
    rng, x, found = np.random.default_rng(4), 0.0, []
    for _ in range(steps + 1):
        found.append(x + 0.8 + math.sqrt(0.5) * rng.normal())
        x = 0.5 * x + math.sqrt(0.1) * rng.normal()
    return np.array(found)[None, :, None]


def root_of_the_first(x, c):
    """NaN, for particles that are below zero."""
    return (np.sqrt(x[0]), x[1])


@pytest.mark.usefixtures("as_python")
@pytest.mark.filterwarnings("ignore:invalid value encountered in sqrt")
@pytest.mark.parametrize(
    ("name", "numbers"),
    [
        ("pf", {}),
        ("pf", {"proposal": "optimal"}),
        ("pf", {"proposal": "optimal", "resampling": "gaussian"}),
        ("apf", {}),
        ("apf", {"regularisation": 0.8}),
        ("rbpf", {}),
    ],
)
def test_particles_that_expect_no_number_have_hardly_any_weight(name, numbers):
    model = StateSpaceModel(
        transition=lambda x, u, c: (0.95 * x[0] + u[0], 0.9 * x[1] + 0.1 * x[0]),
        observe=root_of_the_first,
        process_noise_cov=[0.05, 0.02],
        measurement_noise_cov=[0.3, 0.4],
        prior_mean=[1.0, 0.5],
        prior_cov=[0.8, 0.3],
        inputs=1,
    )
    filter_, rng = make_filter(name, model, ensemble_size=9, **numbers), np.random.default_rng(3)
    for key in range(12):
        belief = filter_.init((key, 7))
        for step in range(8):
            belief = filter_.predict(belief, [0.3 * rng.normal()])
            z = np.array([1.0, 0.5]) + 0.5 * rng.normal(size=2)
            z[step % 2] = np.nan if step % 3 == 0 else z[step % 2]
            belief, _ = filter_.update(belief, z)
            assert np.isfinite(belief.members).all() and np.isfinite(belief.cov).all()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "numbers"), [("rbpf", {}), ("pf", {"proposal": "optimal", "smoothed": (0,), "regularisation": 1.0})]
)
def test_single_steps_and_batches_agree_to_the_last_bit(name, numbers):
    filter_ = make_filter(name, scalar_model(), ensemble_size=9, **numbers)
    inputs, z = simulated(scalar_model(), 40, missing=0.2)
    session, found = filter_.session(), run(filter_, None, inputs, z)
    session.start(filter_keys([0])[0], z[0, 0])
    for k in range(40):
        session.step(inputs[0, k], z[0, k + 1])
        each_equal((session.mean, session.cov), (found.means[0, k + 1], found.covs[0, k + 1]))


@pytest.mark.usefixtures("as_python")
def test_an_accurate_sensor_asks_for_the_optimal_proposal():
    model = scalar_model(measurement_noise_cov=[1e-4])
    inputs, z = simulated(model, 60, missing=0.1)
    numbers = {"ensemble_size": 20, "resampling": "gaussian", "resampling_threshold": 0.9}
    particles = (make_filter("pf", model, proposal=one, **numbers) for one in ("optimal", "prior"))
    exact, optimal, prior = (
        run(filter_, [KEY], inputs, z).means[~np.isnan(z)] for filter_ in (make_filter("kf", model), *particles)
    )
    assert np.abs(optimal - exact).mean() < 0.2 * np.abs(prior - exact).mean()
