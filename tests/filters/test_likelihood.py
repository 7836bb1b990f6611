"""The gradient of the innovations' likelihood, and the Q and R that maximise it."""

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from filters import ExtendedKalmanFilter, affine_model, run
from filters.sensitivity import information, likelihood
from tests.filters.checks import refused
from tests.oracles import each_close
from thruster_env.core.angles import wrapped
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import episode_keys
from thruster_env.model import simulate
from tuning.likelihood.gradient import BAD_START, tune_by_gradient
from tuning.plants.thruster import find_scenario
from tuning.problems.data import training_seeds

RNG = np.random.default_rng(0)


def two_channels():
    return affine_model(
        a=[[0.9, 0.2], [-0.1, 0.8]],
        b=[[0.5], [1.0]],
        c=[[1.0, 0.3], [0.2, -1.0]],
        process_noise_cov=[[0.3, 0.1], [0.1, 0.2]],
        measurement_noise_cov=[[0.5, 0.2], [0.2, 0.4]],
        prior_mean=[1.0, -1.0],
        prior_cov=[1.0, 2.0],
        state_offset=[0.1, 0.0],
    )


def thruster():
    return find_scenario("nominal").model()


def data_of(model, count=3, steps=40):
    keys = episode_keys(range(count))
    inputs = RNG.uniform(-10, 10, size=(count, steps, 1))
    measurements = simulate.simulate(model, keys, inputs).measurements
    measurements[0, 5, 0] = np.nan
    measurements[1, 0] = np.nan
    return keys, inputs, measurements


WEIGHTS = np.array([4.0, 0.25])


def scored_data(model, count=5, steps=30):
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


def directions(model):
    """All symmetric unit changes of Q, then of R."""
    sizes = model.n, model.m
    out = [[], []]
    for which, size in enumerate(sizes):
        for i in range(size):
            for j in range(i + 1):
                unit = np.zeros((size, size))
                unit[i, j] = unit[j, i] = 1.0
                out[which].append(unit)
                out[1 - which].append(np.zeros((sizes[1 - which],) * 2))
    return map(np.array, out)


def test_the_compiled_likelihood_is_the_filters_and_its_gradient_that_of_central_differences():
    model, accuracy = thruster(), 1e-5
    keys, inputs, measurements = data_of(model)
    q_slopes, r_slopes = directions(model)

    def values(q, r):
        changed = model.replace(process_noise_cov=q, measurement_noise_cov=r)
        return run(ExtendedKalmanFilter(model=changed), keys, inputs, measurements).log_likelihoods.sum(axis=1)

    found = likelihood(model, inputs, measurements, q_slopes, r_slopes)
    q, r = model.process_noise_cov, model.measurement_noise_cov
    np.testing.assert_allclose(found.values, values(q, r), rtol=1e-10)
    for j, (dq, dr) in enumerate(zip(q_slopes, r_slopes, strict=True)):
        h = 1e-4 * min(np.diag(q).min() if dq.any() else 1.0, np.diag(r).min() if dr.any() else 1.0)
        slope = (values(q + h * dq, r + h * dr) - values(q - h * dq, r - h * dr)) / (2 * h)
        np.testing.assert_allclose(found.gradients[:, j], slope, rtol=accuracy, atol=accuracy * abs(slope).max())


@pytest.mark.usefixtures("as_python")
def test_the_information_is_that_of_the_innovations_slopes():
    model = thruster()
    keys, inputs, measurements = data_of(model, count=2, steps=7)
    q_slopes, r_slopes = directions(model)
    q, r = model.process_noise_cov, model.measurement_noise_cov

    def innovations(sign, dq, dr):
        h = sign * 1e-4 * (np.diag(q).min() if dq.any() else np.diag(r).min())
        changed = model.replace(process_noise_cov=q + h * dq, measurement_noise_cov=r + h * dr)
        found = run(ExtendedKalmanFilter(model=changed), keys, inputs, measurements)
        return found.innovations[..., 0] / abs(2 * h), found.innovation_covs[..., 0, 0] / abs(2 * h)

    pairs = [[innovations(sign, dq, dr) for sign in (1, -1)] for dq, dr in zip(q_slopes, r_slopes, strict=True)]
    dv, ds = (np.array([above[i] - below[i] for above, below in pairs]) for i in (0, 1))
    s = run(ExtendedKalmanFilter(model=model), keys, inputs, measurements).innovation_covs[..., 0, 0]
    there = ~np.isnan(measurements[..., 0])
    parts = [dv[:, None] * dv / s + ds[:, None] * ds / (2 * s**2), 0.0]
    expected = np.where(there, *parts).sum(axis=-1).transpose(2, 0, 1)
    found = information(model, inputs, measurements, q_slopes, r_slopes)
    scale = np.sqrt(np.einsum("bii,bjj->bij", expected, expected))
    np.testing.assert_allclose(found / scale, expected / scale, atol=1e-4)
    assert (abs(expected / scale) > 0.01).all()


def test_the_interpreted_likelihood_is_the_compiled_one():
    model = two_channels()
    _, inputs, measurements = data_of(model)
    slopes = tuple(directions(model))
    compiled = likelihood(model, inputs, measurements, *slopes)
    with interpreted():
        plain = likelihood(model, inputs, measurements, *slopes)
    each_close(compiled, plain, rtol=1e-11, atol=1e-11)


def test_shapes_that_do_not_fit_are_refused():
    model = two_channels()
    with pytest.raises(ValueError, match="must have the shapes"):
        likelihood(model, np.zeros((2, 5, 1)), np.zeros((2, 5, 2)), np.zeros((1, 2, 2)), np.zeros((1, 2, 2)))


def test_three_starts_lead_to_the_true_q_and_r_within_their_standard_errors():
    scenario = find_scenario("nominal")
    found = tune_by_gradient("ekf", scenario, scenario.data(training_seeds(3, 32)))
    assert found.agree and len(set(found.starts)) == 3 and BAD_START in found.starts
    assert all(optimum.converged for optimum in found.optima)
    true = np.array([*scenario.process_noise_cov, scenario.measurement_noise_cov])
    assert found.identified.all() and (found.standard_errors < 0.2).all()
    assert (abs(np.log(found.best.parameters / true)) < 3 * found.standard_errors).all()
    assert found.names == ("Q11", "Q22", "R")
    assert found.choice.model["process_noise_cov"] == tuple(found.best.parameters[:2])


def test_a_variance_that_the_data_do_not_determine_is_said_to_be_so():
    # One affine model for all voltages errs so much in the flow that Q22 has to cover what Q11 does as well.
    scenario = find_scenario("nominal")
    found = tune_by_gradient("kf", scenario, scenario.data(training_seeds(0, 16)), starts=[(1.0, 1.0, 1.0)])
    assert found.identified.tolist() == [False, True, True]


def test_only_filters_with_sensitivities_have_a_gradient():
    scenario = find_scenario("nominal")
    rule = "one of kf, ekf, iekf, ukf, ckf, fading, h-infinity, schmidt, ekf-robust"
    refused(rule, tune_by_gradient, "enkf", scenario, scenario.data(training_seeds(0, 2)))
