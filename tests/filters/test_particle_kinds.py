"""The optimal proposal, Gaussian particles and smoothed constants against naive ones and closed forms."""

import math

import numpy as np
import pytest
from scipy.stats import norm

from filters import ParticleFilter, StateSpaceModel, Unknown, augmented_model, make_filter, run
from tests.filters.test_filter_paths import assert_paths_agree
from tests.filters.test_particle import (
    CYCLES,
    assert_belief,
    assert_innovation,
    densities,
    resampled,
    root,
    weighted_covariance,
)
from tests.models import KEY, line_model, plane_model, scalar_model, simulated, state_space, varying_noise
from tests.oracles import assert_normal, each_close, each_equal, normals
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import FILTER_KERNEL, FILTER_PRIOR, FILTER_PROCESS, FILTER_PROPOSAL, filter_keys


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


@pytest.mark.slow
def test_compiled_code_gives_what_python_does_and_an_accurate_sensor_asks_for_the_optimal_proposal():
    model = scalar_model(measurement_noise_cov=[1e-4])
    inputs, z = simulated(model, 60, missing=0.1)
    exact = run(make_filter("kf", model), [KEY], inputs, z)
    numbers = {"ensemble_size": 20, "resampling": "gaussian", "resampling_threshold": 0.9}
    filter_ = make_filter("pf", model, proposal="optimal", **numbers)
    found = run(filter_, [KEY], inputs, z)
    with interpreted():
        same, plain = run(filter_, [KEY], inputs, z), run(make_filter("pf", model, **numbers), [KEY], inputs, z)
    each_close(found, same, rtol=1e-9, atol=1e-12)
    there = ~np.isnan(z)
    optimal, prior = (np.abs((one.means - exact.means)[there]).mean() for one in (found, plain))
    assert optimal < 0.2 * prior


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize(
    "numbers", [{"proposal": "optimal"}, {"resampling": "gaussian", "resampling_threshold": 1.0}]
)
def test_they_are_the_same_on_every_path(numbers):
    inputs, z = simulated(plane_model(), 20, missing=0.2)
    filter_ = make_filter("pf", plane_model(), ensemble_size=10, **numbers)
    assert_paths_agree(filter_, KEY, inputs, z)
    noise = varying_noise(plane_model(), 20)
    (q, *_), (_, r, *_) = noise["process_noise_covs"], noise["measurement_noise_covs"]
    found = run(filter_, [KEY], inputs, z, **noise)
    belief, _ = filter_.update(
        filter_.init(KEY), z[0, 0], measurement_noise_cov=noise["measurement_noise_covs"][0]
    )
    belief = filter_.predict(belief, inputs[0, 0], process_noise_cov=q)
    belief, _ = filter_.update(belief, z[0, 1], measurement_noise_cov=r)
    np.testing.assert_allclose(belief.mean, found.means[0, 1], rtol=1e-12)


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
