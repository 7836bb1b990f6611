"""Filters for several models: FilterPy's, a textbook's written naively, closed forms, a thruster that switches."""

import numpy as np
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal

from filters import StateSpaceModel, make_filter, run
from filters.gaussian.blending import Parts, blender
from tests.filters.checks import refused
from tests.models import pendulum
from tests.thruster_env.core.test_angles import turning
from thruster_env.model.affine import affine_model, linearize
from thruster_env.thruster.model import thruster_model


def moving(q, r=1.0, **changes):
    """A point whose position is measured; its acceleration has variance q."""
    f, g = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[0.5], [1.0]])
    noise = {"process_noise_cov": q * g @ g.T + 1e-9 * np.eye(2), "measurement_noise_cov": [[r]]}
    prior = {"prior_mean": [0.0, 0.0], "prior_cov": np.diag([4.0, 1.0])}
    return affine_model(a=f, b=np.zeros((2, 1)), c=np.array([[1.0, 0.0]]), **(noise | prior | changes))


def measured(count, seed=0):
    """Positions of a point that begins to manoeuvre half-way."""
    rng, x, found = np.random.default_rng(seed), np.zeros(2), []
    for k in range(count):
        push = rng.normal(0.0, 0.1 if 2 * k < count else 2.0)
        x = np.array([x[0] + x[1] + 0.5 * push, x[1] + push])
        found.append([x[0] + rng.normal()])
    return np.array(found)


def test_equals_the_filter_of_filterpy():
    filterpy = pytest.importorskip("filterpy.kalman")
    models = [moving(0.01), moving(0.3), moving(4.0)]
    transition = np.array([[0.9, 0.08, 0.02], [0.1, 0.8, 0.1], [0.05, 0.05, 0.9]])
    p = [0.6, 0.3, 0.1]
    ours = make_filter("imm", models[0], modes=models, mode_filter="kf", transition=transition, probabilities=p)

    def theirs(model):
        one = filterpy.KalmanFilter(2, 1)
        one.x, one.P = np.zeros((2, 1)), np.diag([4.0, 1.0])
        one.F, one.H = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]])
        one.Q, one.R = np.array(model.process_noise_cov), np.array([[1.0]])
        return one

    other, belief = filterpy.IMMEstimator([theirs(one) for one in models], p, transition), ours.init()
    for z in measured(80):
        belief, _ = ours.update(ours.predict(belief, [0.0]), z)
        other.predict()
        other.update(z[:, None])
        np.testing.assert_allclose(belief.mean, other.x[:, 0], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(belief.cov, other.P, rtol=1e-10)
        np.testing.assert_allclose(ours.mode_probabilities(belief), other.mu, rtol=1e-9, atol=1e-14)
        means, covs, _ = ours.mode_estimates(belief)
        np.testing.assert_allclose(means, [one.x[:, 0] for one in other.filters], rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(covs, [one.P for one in other.filters], rtol=1e-10)


def merged(weights, means, covs):
    mean = weights @ means
    return mean, np.einsum("i,iab->ab", weights, covs + np.einsum("ia,ib->iab", means - mean, means - mean))


def naive(filter_, inputs, measurements):
    """The recursion of the docstring with the modes' own filters, by logarithms of all probabilities.

    Means, covariances, log-likelihoods, innovations and their covariances, log probabilities.
    """
    filters, found = filter_.mode_filters, []
    with np.errstate(divide="ignore"):
        pi, mu = np.log(filter_.transition_matrix), np.log(filter_.p)
    beliefs = [one.init() for one in filters]
    for k, z in enumerate(measurements):
        if k:
            if filter_.mixing is not None:
                means, covs = np.array([b.mean for b in beliefs]), np.array([b.cov for b in beliefs])
                both = pi + mu[:, None]
                mu = logsumexp(both, axis=0)
                mixed = [
                    merged(np.exp(both[:, j] - mu[j]), means, covs) if np.isfinite(mu[j]) else (means[j], covs[j])
                    for j in range(len(mu))
                ]
                beliefs = [b._replace(mean=x, cov=p) for b, (x, p) in zip(beliefs, mixed, strict=True)]
            beliefs = [one.predict(b, inputs[k - 1]) for one, b in zip(filters, beliefs, strict=True)]
        both = [one.update(b, z) for one, b in zip(filters, beliefs, strict=True)]
        beliefs, levels = [b for b, _ in both], np.array([v.log_likelihood for _, v in both])
        expected = merged(np.exp(mu), np.array([v.value for _, v in both]), np.array([v.cov for _, v in both]))
        total = logsumexp(mu + levels)
        mu = mu + levels - total
        mean, cov = merged(np.exp(mu), np.array([b.mean for b in beliefs]), np.array([b.cov for b in beliefs]))
        found.append((mean, cov, total, *expected, mu))
    return [np.array(one) for one in zip(*found, strict=True)]


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize(("name", "kinds"), [("ekf", "functions"), ("ekf-robust", "numbers"), ("ukf", "numbers")])
def test_equals_the_recursion_of_the_textbook(name, kinds):
    whole = thruster_model()
    lost = whole.replace(constants=whole.constants._replace(thrust_30=5e-6), process_noise_cov=[4.0, 1e-3])
    modes = [whole, lost]
    if kinds == "functions":  # the filter of the third mode is another program
        modes.append(linearize(whole, [100.0, 1.0], [10.0]))
    filter_ = make_filter("imm", whole, modes=modes, mode_filter=name, stay=0.8)
    rng = np.random.default_rng(1)
    inputs, measurements = rng.uniform(-20, 20, (1, 30, 1)), rng.normal(5.0, 20.0, (1, 31, 1))
    measurements[0, 7] = np.nan
    found = run(filter_, np.array([[0, 0]]), inputs, measurements)
    means, covs, levels, innovations, innovation_covs, _ = naive(filter_, inputs[0], measurements[0])
    np.testing.assert_allclose(found.means[0], means, rtol=1e-9)
    np.testing.assert_allclose(found.covs[0], covs, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(found.log_likelihoods[0], levels, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(found.innovations[0], innovations, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(found.innovation_covs[0], innovation_covs, rtol=1e-8)


def test_equal_modes_are_one_filter():
    model = thruster_model()
    rng = np.random.default_rng(2)
    data = np.zeros((3, 2), dtype=int), rng.uniform(-20, 20, (3, 40, 1)), rng.normal(0.0, 10.0, (3, 41, 1))
    one, several = run(make_filter("ekf", model), *data), run(make_filter("imm", model, modes=[model] * 3), *data)
    for name in ("means", "covs", "innovations", "innovation_covs", "log_likelihoods"):
        np.testing.assert_allclose(getattr(several, name), getattr(one, name), rtol=1e-10, atol=1e-10)


def test_the_static_estimator_has_the_posterior_of_the_models():
    models, p, z = [moving(0.01), moving(0.3), moving(4.0)], np.array([0.5, 0.3, 0.2]), measured(25)
    filter_ = make_filter("mmae", models[0], modes=models, mode_filter="kf", probabilities=p)
    belief, total = filter_.init(), 0.0
    for k, one in enumerate(z):
        belief, innovation = filter_.update(belief if k == 0 else filter_.predict(belief, [0.0]), one)
        total += innovation.log_likelihood
    levels = []
    for model in models:  # the density of all measurements together
        a, h = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([1.0, 0.0])
        means, covs, powers = [], np.zeros((25, 25)), [np.linalg.matrix_power(a, k) for k in range(25)]
        cov = np.diag([4.0, 1.0])
        for k in range(25):
            for later in range(k, 25):
                covs[k, later] = covs[later, k] = h @ powers[later - k] @ cov @ h
            cov = a @ cov @ a.T + model.process_noise_cov
            means.append(0.0)
        levels.append(multivariate_normal.logpdf(z[:, 0], means, covs + np.eye(25)))
    weights = p * np.exp(np.array(levels) - max(levels))
    np.testing.assert_allclose(filter_.mode_probabilities(belief), weights / weights.sum(), rtol=1e-8)
    assert total == pytest.approx(np.log(weights.sum()) + max(levels), rel=1e-10)


def improbable():
    """Filters, one of whose modes has no probability or none that a float64 has, and then fits best; positions."""
    quiet, wild = moving(0.01), moving(4.0)
    still = moving(0.01, r=0.04)
    absorbing, one_way = np.array([[0.9, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.2, 0.8]]), np.eye(3)
    models = {"modes": [quiet, wild, still], "mode_filter": "kf"}
    outlier = measured(40)
    outlier[20] += 3000.0
    jump = measured(40)
    jump[15:] += 400.0
    for z in (outlier, jump, 1e3 * measured(40)):
        yield make_filter("mmae", quiet, **models), z
        for p in ([0.5, 0.5, 0.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]):
            yield make_filter("mmae", quiet, **models, probabilities=p), z
            yield make_filter("imm", quiet, **models, transition=absorbing, probabilities=p), z
            yield make_filter("imm", quiet, **models, transition=one_way, probabilities=p), z
        yield make_filter("imm", quiet, **models, stay=1.0), z
    yield make_filter("mmae", pendulum()), np.array([[0.5, 0.1], [1e3, 1e3], [0.5, 0.1]])
    noise = {"process_noise_cov": [1e-4], "measurement_noise_cov": [0.1], "prior_mean": [0.0], "prior_cov": [1e-4]}
    plain, shifted = (
        affine_model(a=[[1.0]], b=[[0.0]], c=[[1.0]], measurement_offset=[shift], **noise) for shift in (0.0, 10.0)
    )
    models, z = {"modes": [plain, shifted]}, np.repeat([10.0, 0.0, 10.0, 0.0], [5, 10, 12, 20])[:, None]
    for transition in (np.eye(2), [[0.9, 0.1], [0.0, 1.0]], [[1.0, 0.0], [1e-3, 1.0 - 1e-3]]):
        yield make_filter("imm", plain, **models, transition=transition), z
    yield make_filter("mmae", plain, **models), z


@pytest.mark.usefixtures("as_python")
def test_a_mode_of_no_probability_fits_best_and_one_that_was_out_comes_back():
    returned = 0
    for filter_, z in improbable():
        inputs = np.zeros((1, len(z) - 1, 1))
        found = run(filter_, np.array([[0, 0]]), inputs, z[None])
        means, covs, levels, *_, logs = naive(filter_, inputs[0], z)
        assert not found.divergences.any()
        np.testing.assert_allclose(found.means[0], means, rtol=1e-8, atol=1e-8)
        np.testing.assert_allclose(found.covs[0], covs, rtol=1e-7, atol=1e-8)
        np.testing.assert_allclose(found.log_likelihoods[0], levels, rtol=1e-9)
        belief = filter_.init()
        for k, one in enumerate(z):
            belief, _ = filter_.update(belief if k == 0 else filter_.predict(belief, [0.0]), one)
            np.testing.assert_allclose(belief.mean, found.means[0, k], rtol=1e-10, atol=1e-10)
            np.testing.assert_allclose(filter_.mode_probabilities(belief), np.exp(logs[k]), rtol=1e-6, atol=1e-9)
        was_out = np.minimum.accumulate(np.where(np.isfinite(logs), logs, 0.0)) < -745.0  # exp of it is 0
        returned += int((was_out & (logs > -3.0)).any())
    assert returned >= 2


def pulled(x, u, c):
    """A state that decays to 1, and overflows under an input of 1."""
    return (0.5 * x[0] + 0.5 + (1e200 * u[0]) * (1e200 * u[0]),)


@pytest.mark.usefixtures("as_python")
def test_a_mode_whose_filter_begins_anew_is_out_but_not_for_good():
    noise = {"process_noise_cov": [0.01], "measurement_noise_cov": [0.01], "prior_mean": [1.0], "prior_cov": [1.0]}
    model = affine_model(a=[[0.5]], b=[[0.0]], c=[[1.0]], **noise)
    other = StateSpaceModel(transition=pulled, observe=lambda x, c: (x[0],), inputs=1, **noise)
    filter_ = make_filter("mmae", model, modes=[model, other])
    inputs = np.zeros((400, 1))
    inputs[5] = 1.0
    belief, found = filter_.init(), []
    for u in inputs:
        belief, _ = filter_.update(filter_.predict(belief, u), [1.0])
        found.append(filter_.mode_probabilities(belief)[1])
    assert belief.divergences == 1 and found[4] > 0.99 and found[5] < 1e-200 and found[-1] > 0.99


def test_parts_far_away_that_have_no_weight_do_not_count():
    parts = Parts(8, 6, 2)
    row = np.zeros(20)
    row[6:8] = 1.0, 0.0
    row[8:14], row[14:20] = [1.0, 2.0, 3.0, 0.5, 0.5, 4.0], [1e200, -1e200, 1e308, 0.0, 0.0, 1e308]
    with np.errstate(all="ignore"):
        blender(parts, 2, 0, 2, (False, False))(row, 6, 0)
    np.testing.assert_array_equal(row[:6], [1.0, 2.0, 3.0, 0.5, 0.5, 4.0])


def test_an_angle_is_mixed_the_short_way_round():
    """Estimates near the cut are those far from it, turned: modes, mixtures and innovations alike."""
    rng = np.random.default_rng(4)
    inputs, noise = rng.normal(size=(1, 60, 1)), rng.normal(0.0, 0.3, (1, 61, 2))
    found = []
    for heading in (0.0, np.pi):
        model = turning(heading)
        filter_ = make_filter("imm", model, modes=[{}, {"process_noise_cov": 30.0 * model.process_noise_cov}])
        seen = noise + [heading, 0.0]
        seen[..., 0] = np.angle(np.exp(1j * seen[..., 0]))
        found.append(run(filter_, np.array([[0, 0]]), inputs, seen))
    here, there = found
    turned = np.exp(1j * (there.means[..., 1] - here.means[..., 1]))
    np.testing.assert_allclose(turned, -1.0, atol=1e-9)
    np.testing.assert_allclose(there.means[..., 0], here.means[..., 0], rtol=1e-8, atol=1e-10)
    np.testing.assert_allclose(there.covs, here.covs, rtol=1e-8, atol=1e-12)
    np.testing.assert_allclose(there.log_likelihoods, here.log_likelihoods, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize(
    ("changes", "rule"),
    [
        ({"modes": [thruster_model()]}, "modes must be a list of 2 to 32 models, but got"),
        ({"modes": [thruster_model(), pendulum()]}, "measurements, inputs and angles of a mode must be those"),
        ({"modes": [thruster_model(), 3]}, "a mode must be a model, or changes of one, but got 3"),
        ({"modes": [{}, {"gain": 3.0}]}, "a change of a mode must be one of .*, but got 'gain'"),
        ({"stay": 1.5}, "stay must be"),
        (
            {"mode_filter": "enkf"},
            "mode_filter must be a filter of one mean and covariance, such as 'ekf', but got",
        ),
        ({"mode_filter": ["ekf"]}, "mode_filter must be one name, or one for each of 2 modes, but got"),
        ({"probabilities": [0.5, 0.6]}, "probabilities must be 2 numbers of at least 0 that sum to 1, but got"),
        (
            {"transition": [[1.0, 0.0], [0.5, 0.4]]},
            "transition must be 2 x 2 numbers of at least 0 that sum to 1 in",
        ),
    ],
)
def test_what_is_refused(changes, rule):
    refused(rule, make_filter, "imm", thruster_model(), **changes)
