"""Smoothers against one Gaussian of the whole trajectory, textbooks, naive ensembles and their filters."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from filters import (
    CubatureKalmanFilter,
    EnsembleKalmanFilter,
    EnsembleTransformFilter,
    ExtendedKalmanFilter,
    IteratedEnsembleKalmanFilter,
    IteratedExtendedKalmanFilter,
    KalmanFilter,
    SerialSquareRootFilter,
    UnscentedKalmanFilter,
    run,
)
from filters.consistency.nees import mean_interval, normalized_squares, rmse_ratios
from filters.runs import smooth
from tests.filters.test_differentiated import swing_if
from tests.models import KEY, held_voltages, pendulum, plane_model, scalar_model, simulated, swing, wide_model
from tests.oracles import each_close, each_equal, normals
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, episode_keys
from thruster_env.model import simulate
from tuning.plants.thruster import find_scenario
from tuning.problems.data import held_out_seeds

KEYS = np.array([KEY])
with_gaps = partial(simulated, level=1.0, missing=0.25)


def as_one_gaussian(model, inputs, measurements, lag):
    """Mean and covariance of each state of one trajectory, from the joint Gaussian of states and measurements."""
    a, b, offset, c, shift = model.matrices()
    n, times = model.n, len(measurements)
    mean, cov = np.zeros((times, n)), np.zeros((times, n, times, n))
    mean[0], cov[0, :, 0] = model.prior_mean, model.prior_cov
    for k in range(1, times):
        mean[k] = a @ mean[k - 1] + b @ inputs[k - 1] + offset
        for j in range(k):
            cov[k, :, j] = a @ cov[k - 1, :, j]
            cov[j, :, k] = cov[k, :, j].T
        cov[k, :, k] = a @ cov[k - 1, :, k - 1] @ a.T + model.process_noise_cov
    mean, cov = mean.ravel(), cov.reshape(times * n, times * n)
    h = np.kron(np.eye(times), c)
    r = np.kron(np.eye(times), model.measurement_noise_cov)
    means, covs = np.zeros((times, n)), np.zeros((times, n, n))
    for k in range(times):
        seen = ~np.isnan(measurements)
        seen[min(k + lag, times - 1) + 1 :] = False
        seen = seen.ravel()
        innovation = (measurements - shift).ravel()[seen] - h[seen] @ mean
        s = h[seen] @ cov @ h[seen].T + r[np.ix_(seen, seen)]
        gain = np.linalg.solve(s, h[seen] @ cov).T
        own = slice(k * n, (k + 1) * n)
        means[k] = (mean + gain @ innovation)[own]
        covs[k] = (cov - gain @ s @ gain.T)[own, own]
    return means, covs


LINEAR = {
    "full rank": {},
    "a start that is known": {"prior_cov": np.zeros((3, 3))},
    "a start that is known in part": {"prior_cov": [0.0, 1.0, 0.0]},
    "noise in one state": {"process_noise_cov": [0.0, 0.2, 0.0]},
    "neither": {"process_noise_cov": [0.0, 0.2, 0.0], "prior_cov": [0.0, 1.0, 0.0]},
}


@pytest.mark.parametrize("changes", LINEAR.values(), ids=LINEAR)
@pytest.mark.parametrize("lag", [None, 3])
@pytest.mark.parametrize(
    "kind",
    [
        KalmanFilter,
        partial(KalmanFilter, form="square-root"),
        ExtendedKalmanFilter,
        IteratedExtendedKalmanFilter,
        UnscentedKalmanFilter,
        CubatureKalmanFilter,
    ],
)
def test_on_an_affine_model_it_is_the_whole_trajectory_as_one_gaussian(kind, lag, changes):
    model = wide_model(**changes)
    inputs, measurements = with_gaps(model, 25)
    with interpreted():
        found = smooth(kind(model=model), KEYS, inputs, measurements, lag)
    means, covs = as_one_gaussian(model, inputs[0], measurements[0], 25 if lag is None else lag)
    each_close((found.means[0], found.covs[0]), (means, covs), rtol=1e-9, atol=1e-9)
    assert (found.covs == np.swapaxes(found.covs, -1, -2)).all()


@pytest.mark.parametrize("kind", [ExtendedKalmanFilter, EnsembleKalmanFilter])
@pytest.mark.usefixtures("as_python")
def test_no_lag_is_the_filter_and_the_longest_the_full_smoother(kind):
    model = pendulum()
    filter_ = kind(model=model, **({} if kind is ExtendedKalmanFilter else {"ensemble_size": 8}))
    inputs, measurements = with_gaps(model, 30, count=3)
    keys = episode_keys(range(3))
    filtered = run(filter_, keys, inputs, measurements)
    without = smooth(filter_, keys, inputs, measurements, lag=0)
    each_equal((without.means, without.covs), (filtered.means, filtered.covs))
    full = smooth(filter_, keys, inputs, measurements)
    for lag in (30, 1000):
        longest = smooth(filter_, keys, inputs, measurements, lag)
        each_equal((longest.means, longest.covs), (full.means, full.covs))
    np.testing.assert_array_equal(full.means[:, -1], filtered.means[:, -1])
    some = smooth(filter_, keys, inputs, measurements, lag=4)
    np.testing.assert_allclose(some.means[:, -5:], full.means[:, -5:], rtol=1e-12)  # these see all that there is
    assert not np.allclose(some.means[:, :10], full.means[:, :10])


@pytest.mark.parametrize("kind", [ExtendedKalmanFilter, EnsembleKalmanFilter])
def test_compiled_and_as_python_it_is_the_same(kind):
    model = find_scenario("nominal").model()
    filter_ = kind(model=model, **({} if kind is ExtendedKalmanFilter else {"ensemble_size": 11}))
    inputs, measurements = with_gaps(model, 12, count=2, level=6.0)
    keys = episode_keys(range(2))
    compiled = smooth(filter_, keys, inputs, measurements, lag=5)
    with interpreted():
        plain = smooth(filter_, keys, inputs, measurements, lag=5)
    each_close(compiled, plain, rtol=1e-9, atol=1e-12)


def test_on_the_pendulum_it_is_the_textbook_recursion():
    model = pendulum()
    inputs, measurements = with_gaps(model, 40, level=3.0)
    with interpreted():
        filter_ = ExtendedKalmanFilter(model=model)
        filtered = run(filter_, KEYS, inputs, measurements)
        found = smooth(filter_, KEYS, inputs, measurements)
    x, p = filtered.means[0, -1], filtered.covs[0, -1]
    g, d = model.constants
    for k in reversed(range(40)):
        angle, rate = mean = filtered.means[0, k]
        by_angle, by_rate = -0.05 * g * np.cos(angle), 1 - 0.1 * d * abs(rate)
        f = np.array([[1 + 0.05 * by_angle, 0.05 * by_rate], [by_angle, by_rate]])
        predicted = f @ filtered.covs[0, k] @ f.T + model.process_noise_cov
        gain = filtered.covs[0, k] @ f.T @ np.linalg.inv(predicted)
        x = mean + gain @ (x - np.array(swing(mean, inputs[0, k], (g, d))))
        p = filtered.covs[0, k] + gain @ (p - predicted) @ gain.T
        np.testing.assert_allclose(found.means[0, k], x, rtol=1e-7, atol=1e-8)  # of central differences
        np.testing.assert_allclose(found.covs[0, k], p, rtol=1e-7, atol=1e-8)


@pytest.mark.parametrize("kind", ["default", "far", "near", "cubature"])
def test_by_sigma_points_it_is_sarkka_s_algorithm(kind):
    model = pendulum(substeps=2)
    if kind == "cubature":
        filter_, reach, centre, spread_of_centre, others = CubatureKalmanFilter(model=model), 2.0, 0.0, 0.0, 0.25
    else:
        alpha, beta, kappa = {"default": (1.0, 2.0, 0.0), "far": (1.0, 0.5, 1.0), "near": (0.3, 2.0, 0.0)}[kind]
        filter_ = UnscentedKalmanFilter(model=model, alpha=alpha, beta=beta, kappa=kappa)
        reach = alpha**2 * (2 + kappa)  # n + lambda, as the textbooks have it
        centre, others = 1 - 2 / reach, 0.5 / reach
        spread_of_centre = centre + 1 - alpha**2 + beta
    weights, spreads = (np.array([w, *[others] * 4]) for w in (centre, spread_of_centre))
    inputs, measurements = with_gaps(model, 15, level=3.0)
    with interpreted():
        filtered = run(filter_, KEYS, inputs, measurements)
        found = smooth(filter_, KEYS, inputs, measurements)
    x, p = filtered.means[0, -1], filtered.covs[0, -1]
    for k in reversed(range(15)):
        mean, cov, u, c = filtered.means[0, k], filtered.covs[0, k], inputs[0, k], model.constants
        root = np.sqrt(reach) * np.linalg.cholesky(cov)
        at = np.column_stack([mean, mean[:, None] + root, mean[:, None] - root])
        to = np.array([swing(swing(point, u, c), u, c) for point in at.T]).T
        predicted_mean = to @ weights
        d, e = at - mean[:, None], to - predicted_mean[:, None]
        predicted = (spreads * e) @ e.T + model.process_noise_cov
        gain = (spreads * d) @ e.T @ np.linalg.inv(predicted)
        x = mean + gain @ (x - predicted_mean)
        p = cov + gain @ (p - predicted) @ gain.T
        np.testing.assert_allclose(found.means[0, k], x, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(found.covs[0, k], p, rtol=1e-7, atol=1e-9)


def test_a_scheduled_filter_is_smoothed_with_the_model_of_each_input():
    model = find_scenario("nominal").model()
    filter_ = KalmanFilter(model=model, schedule=5)
    inputs = held_voltages(1, 5, hold=4, seed=2)
    with interpreted():
        measurements = simulate.simulate(model, episode_keys([2]), inputs).measurements
        filtered = run(filter_, KEYS, inputs, measurements)
        found = smooth(filter_, KEYS, inputs, measurements)
        x, p = filtered.means[0, -1], filtered.covs[0, -1]
        for k in reversed(range(20)):
            kept = filter_.init()._replace(mean=filtered.means[0, k], cov=filtered.covs[0, k])
            predicted = filter_.predict(kept, inputs[0, k])
            moved = [filter_.predict(kept._replace(mean=kept.mean + d), inputs[0, k]).mean for d in np.eye(2)]
            a = (np.array(moved) - predicted.mean).T
            gain = kept.cov @ a.T @ np.linalg.inv(predicted.cov)
            x, p = kept.mean + gain @ (x - predicted.mean), kept.cov + gain @ (p - predicted.cov) @ gain.T
            each_close((found.means[0, k], found.covs[0, k]), (x, p), rtol=1e-8, atol=1e-9)


@pytest.fixture(scope="module")
def nominal():
    scenario = find_scenario("nominal")
    return scenario.model(), scenario.data(held_out_seeds(3, 100))


def ratios_and_nees(filter_, data, lag):
    """RMSE of smoother over filter by state, paired by run, and the smoother's mean NEES, from step 50 on."""
    given = data.filter_keys, data.inputs, data.measurements
    filtered, found = smooth(filter_, *given, lag=0), smooth(filter_, *given, lag)
    errors = [(estimates.means - data.states)[:, 50:] for estimates in (found, filtered)]
    squares = [(error**2).mean(axis=1) for error in errors]
    return rmse_ratios(*squares), mean_interval(normalized_squares(errors[0], found.covs[:, 50:]))


@pytest.mark.parametrize("kind", [ExtendedKalmanFilter, UnscentedKalmanFilter])
def test_on_the_thruster_the_smoother_beats_the_filter_and_stays_consistent(nominal, kind):
    model, data = nominal
    ratios, nees = ratios_and_nees(kind(model=model), data, lag=None)
    assert ratios[0].high < 1.0 and ratios[1].high < 0.9  # 95 % intervals, paired by run
    assert 0.97 * 2 < nees.low < nees.high < 1.05 * 2


def test_on_the_thruster_the_ensemble_smoother_beats_the_filter_where_thrust_tells(nominal):
    model, data = nominal
    ratios, _ = ratios_and_nees(EnsembleKalmanFilter(model=model, ensemble_size=50), data, lag=10)
    assert ratios[1].high < 0.95


@pytest.mark.parametrize("kind", [KalmanFilter, EnsembleKalmanFilter])
@pytest.mark.usefixtures("as_python")
def test_nothing_is_carried_back_over_a_restart(kind):
    # An input of 1e150 makes the state infinite, and the filter restarts.
    filter_ = kind(model=scalar_model(b=[[1e200]]))
    inputs = np.zeros((1, 9, 1))
    inputs[0, 4] = 1e150
    measurements = np.random.default_rng(3).normal(6.0, 1.0, size=(1, 10, 1))
    assert run(filter_, KEYS, inputs, measurements).divergences == 1
    found = smooth(filter_, KEYS, inputs, measurements)
    before = smooth(filter_, KEYS, inputs[:, :4], measurements[:, :5])
    each_equal((found.means[:, :5], found.covs[:, :5]), (before.means, before.covs))
    assert np.isfinite(found.means).all()
    if kind is KalmanFilter:  # an ensemble's draws depend on the step, so only here the rest can be had alone
        measurements[0, 5] = np.nan  # what met the lost estimate
        after = smooth(filter_, KEYS, inputs[:, 5:], measurements[:, 5:])
        each_close((found.means[:, 5:], found.covs[:, 5:]), (after.means, after.covs), rtol=1e-12)


def test_what_cannot_be_smoothed_is_refused():
    class Other(ExtendedKalmanFilter):
        name = "other"

    model = pendulum()
    inputs, measurements = with_gaps(model, 3)
    with pytest.raises(ValueError, match="a smoother needs a filter of .*, but got 'other'"):
        smooth(Other(model=model), KEYS, inputs, measurements)
    with pytest.raises(ValueError, match="lag must be a whole number of at least 0, but got -1"):
        smooth(ExtendedKalmanFilter(model=model), KEYS, inputs, measurements, lag=-1)
    with pytest.raises(ValueError, match="inputs and measurements must have shapes"):
        smooth(ExtendedKalmanFilter(model=model), KEYS, inputs[:, :2], measurements)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("kind", [ExtendedKalmanFilter, UnscentedKalmanFilter, CubatureKalmanFilter])
def test_a_model_that_decides_is_smoothed_as_one_that_does_not(kind):
    found = []
    for function in (swing, swing_if):
        model = pendulum(transition=function)
        inputs, z = simulated(pendulum(), 10, count=2, missing=0.2)
        found.append(smooth(kind(model=model), None, inputs, z))
    for one, other in zip(*found, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("lag", [2, 8])
def test_the_ensemble_smoother_is_the_naive_one_with_the_same_normals(lag):
    size, steps, model = 11, 8, wide_model()
    a, b, offset, c, shift = model.matrices()
    root_p, root_q, root_r = (
        np.linalg.cholesky(p) for p in (model.prior_cov, model.process_noise_cov, model.measurement_noise_cov)
    )
    inputs, measurements = simulated(model, steps, level=1.0)
    measurements[0, 3, 1] = measurements[0, 5] = np.nan
    with interpreted():
        filter_ = EnsembleKalmanFilter(model=model, ensemble_size=size)
        found = smooth(filter_, KEYS, inputs, measurements, lag)
    states = [model.prior_mean[:, None] + root_p @ normals(FILTER_PRIOR, 0, 3, size)]  # of all steps so far
    for k, z in enumerate(measurements[0]):
        if k > 0:
            stirred = root_q @ normals(FILTER_PROCESS, k, 3, size)
            states.append(a @ states[-1] + (b @ inputs[0, k - 1] + offset)[:, None] + stirred)
        there = ~np.isnan(z)
        y = (c @ states[-1] + shift[:, None])[there]
        v = (root_r @ normals(FILTER_MEASUREMENT, k, 2, size))[there]
        s = np.cov(y).reshape(len(y), len(y)) + model.measurement_noise_cov[np.ix_(there, there)]
        moves = np.linalg.solve(s, z[there][:, None] - y - v)
        for j in range(max(0, k - lag), k + 1):
            states[j] = states[j] + np.cov(states[j], y)[:3, 3:] @ moves
    np.testing.assert_allclose(found.means[0], [x.mean(axis=1) for x in states], rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.covs[0], [np.cov(x) for x in states], rtol=1e-9, atol=1e-9)


@pytest.mark.usefixtures("as_python")
def test_large_ensembles_approach_the_kalman_smoother():
    model, runs = scalar_model(), 30
    inputs, measurements = with_gaps(model, 5)
    many = np.repeat(inputs, runs, axis=0), np.repeat(measurements, runs, axis=0)
    distances = []
    for size in (50, 200):
        filter_ = EnsembleKalmanFilter(model=model, ensemble_size=size)
        found = smooth(filter_, episode_keys(range(runs)), *many, lag=3)
        exact = smooth(KalmanFilter(model=model), KEYS, inputs, measurements, lag=3)
        distances.append(np.sqrt(((found.means - exact.means) ** 2).mean()))
    assert distances[1] < 0.15 * np.sqrt(exact.covs[0, :, 0, 0].mean())
    assert 0.35 < distances[1] / distances[0] < 0.7  # 1/sqrt(4) but for chance


@pytest.mark.parametrize("kind", [EnsembleTransformFilter, SerialSquareRootFilter, IteratedEnsembleKalmanFilter])
def test_without_process_noise_square_root_smoothers_are_exact_for_their_own_prior(kind):
    model = wide_model(process_noise_cov=np.zeros((3, 3)))
    filter_ = kind(model=model, ensemble_size=9)
    inputs, measurements = with_gaps(model, 12)
    with interpreted():
        prior = filter_.init(KEY)
        found = smooth(filter_, KEYS, inputs, measurements, lag=4)
        same_prior = model.replace(prior_mean=prior.mean, prior_cov=prior.cov)
        exact = smooth(KalmanFilter(model=same_prior), KEYS, inputs, measurements, lag=4)
    each_close((found.means, found.covs), (exact.means, exact.covs), rtol=1e-8, atol=1e-8)


@pytest.mark.usefixtures("as_python")
def test_the_same_members_are_smoothed_as_in_dapper():
    case = json.loads((Path(__file__).parents[1] / "data" / "dapper_smoother.json").read_text())
    model = plane_model(b=np.zeros((2, 0)), process_noise_cov=np.zeros((2, 2)))
    filter_ = EnsembleTransformFilter(model=model, ensemble_size=5)
    np.testing.assert_allclose(filter_.init(KEY).members, case["prior"], rtol=1e-12)
    measurements = np.array([[[np.nan, np.nan], *case["z"]]])
    found = smooth(filter_, KEYS, np.zeros((1, len(case["z"]), 0)), measurements, case["lag"])
    np.testing.assert_allclose(found.means[0, 1:], np.mean(case["members"], axis=2), rtol=1e-10, atol=1e-10)
    for cov, members in zip(found.covs[0, 1:], case["members"], strict=True):
        np.testing.assert_allclose(cov, np.cov(members), rtol=1e-10, atol=1e-10)
