"""The ensemble Kalman filter against naive analyses and its limit, the noise it adds, and random rotations."""

import math
from functools import cache

import numpy as np
import pytest

from filters import EnsembleKalmanFilter, KalmanFilter, make_filter, run, smooth, thruster_model
from filters.engine.belief import memory_offsets
from filters.ensembles.stochastic import rotator
from tests.models import KEY, line_model, plane_model, simulated
from tests.oracles import assert_normal, convergence, each_close, normals, relative_errors
from tests.slow import slow_but
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, filter_keys
from thruster_env.graphs.loops import Loops


@pytest.mark.parametrize("centred", [0, 1])
def test_one_cycle_is_the_naive_one_with_the_same_normals(centred):
    size, model, close = 11, plane_model(), {"rtol": 1e-12, "atol": 1e-12}
    a, b, offset, c, shift = model.matrices()
    filter_ = EnsembleKalmanFilter(model=model, ensemble_size=size, centred_perturbations=centred)
    root_p, root_q, root_r = (
        np.linalg.cholesky(cov) for cov in (model.prior_cov, model.process_noise_cov, model.measurement_noise_cov)
    )
    with interpreted():
        belief = filter_.init(KEY)
        x = model.prior_mean[:, None] + root_p @ normals(FILTER_PRIOR, 0, 2, size)
        np.testing.assert_allclose(belief.members, x, rtol=1e-12, atol=1e-12)
        for step, (u, z) in enumerate([(0.5, [2.0, -1.0]), (-1.0, [0.3, 0.9])], start=1):
            belief = filter_.predict(belief, [u])
            x = a @ x + b * u + offset[:, None] + root_q @ normals(FILTER_PROCESS, step, 2, size)
            each_close((belief.members, belief.mean, belief.cov), (x, x.mean(axis=1), np.cov(x)), **close)

            belief, innovation = filter_.update(belief, z)
            y = c @ x + shift[:, None]
            joint = np.cov(x, y)  # divisor size - 1
            s = joint[2:, 2:] + model.measurement_noise_cov
            gain = joint[:2, 2:] @ np.linalg.inv(s)
            v = root_r @ normals(FILTER_MEASUREMENT, step, 2, size)
            if centred:  # the sample of v has mean zero, and covariance R on average over draws
                v = (v - v.mean(axis=1, keepdims=True)) * math.sqrt(size / (size - 1))
            x = x + gain @ (np.array(z)[:, None] - v - y)
            each_close((belief.members, belief.mean, belief.cov), (x, x.mean(axis=1), np.cov(x)), **close)
            each_close(innovation[:2], (z - y.mean(axis=1), s), **close)


def test_centred_perturbations_move_the_mean_as_the_gain_says():
    model, z = plane_model(), [2.0, -1.0]
    filter_ = EnsembleKalmanFilter(model=model, ensemble_size=5, centred_perturbations=1)
    with interpreted():
        prior = filter_.init(KEY)
        belief, innovation = filter_.update(prior, z)
    _, _, _, c, _ = model.matrices()
    gain = prior.cov @ c.T @ np.linalg.inv(innovation.cov)
    np.testing.assert_allclose(belief.mean, prior.mean + gain @ innovation.value, rtol=1e-12)


def test_members_are_stirred_by_the_prior_the_process_noise_and_the_measurement_noise():
    model, size = plane_model(), 2000
    a, b, offset, c, shift = model.matrices()
    filter_ = EnsembleKalmanFilter(model=model, ensemble_size=size)
    z = np.array([1.0, 2.0])
    with interpreted():
        first = filter_.init(KEY)
        second = filter_.predict(first, [0.5])
        third = filter_.predict(second, [0.5])
        updated, innovation = filter_.update(third, z)
    drift = (offset + b[:, 0] * 0.5)[:, None]
    w_1 = second.members - a @ first.members - drift
    w_2 = third.members - a @ second.members - drift
    # The analysis solved for the noise that each member took the measurement with.
    gain = np.cov(third.members) @ c.T @ np.linalg.inv(innovation.cov)
    expected = c @ third.members + shift[:, None]
    v = z[:, None] - expected - np.linalg.inv(gain) @ (updated.members - third.members)
    assert_normal(first.members, model.prior_cov, model.prior_mean)
    assert_normal(w_1, model.process_noise_cov)
    assert_normal(w_2, model.process_noise_cov)
    assert_normal(v, model.measurement_noise_cov)
    # Nothing that stirs the members is correlated with anything else.
    together = np.corrcoef(np.vstack([first.members, w_1, w_2, v]))
    for i in range(0, 8, 2):
        together[i : i + 2, i : i + 2] = 0.0
    assert np.abs(together).max() < 4 / math.sqrt(size)


def half_gain_recursion(model, inputs, measurements):
    """Means and covariances that the DEnKF has in the limit of many members, (B, K + 1, ...)."""
    a, b, offset, h, shift = model.matrices()
    q, r = model.process_noise_cov, model.measurement_noise_cov
    x, p, found = np.tile(model.prior_mean, (len(inputs), 1)), model.prior_cov, []
    for k in range(measurements.shape[1]):
        if k > 0:
            x, p = x @ a.T + inputs[:, k - 1] @ b.T + offset, a @ p @ a.T + q
        gain = p @ h.T @ np.linalg.inv(h @ p @ h.T + r)
        x = x + (measurements[:, k] - x @ h.T - shift) @ gain.T
        p = p - gain @ h @ p + gain @ h @ p @ h.T @ gain.T / 4
        found.append((x, np.tile(p, (len(inputs), 1, 1))))
    return [np.stack(part, axis=1) for part in zip(*found, strict=True)]


@pytest.mark.parametrize("name", slow_but(["enkf", "etkf", "denkf", "pf", "apf"], ["enkf"]))
def test_members_and_particles_converge_to_their_limit_like_one_over_root_n(name):
    model, of_particles = line_model(), name in ("pf", "apf")
    inputs, measurements = simulated(model, 30, count=60, seed=0, level=1.0, compiled=True)
    data = filter_keys(range(60)), inputs, measurements
    exact = run(KalmanFilter(model=model), *data)
    limit = half_gain_recursion(model, inputs, measurements) if name == "denkf" else exact[:2]
    sizes = [100, 400, 1600, 6400] if of_particles else [20, 80, 320, 1280]
    errors, found = convergence(lambda size: make_filter(name, model, ensemble_size=size), sizes, data, *limit)
    for slope in np.polyfit(np.log(sizes), np.log(errors.T), 1)[0]:
        assert -0.6 < slope < -0.4  # 60 independent runs give each error to about 6 %, the slope to 0.03
    # Averaged over the runs nothing remains but the bias of order 1/N: four standard errors of 1/sqrt(60 N).
    bias = relative_errors(found, *limit)[0][:, -1].mean(axis=0)
    assert (np.abs(bias) < 4 * errors[0, -1] / math.sqrt(60)).all()
    if of_particles:
        likelihoods = (found.log_likelihoods - exact.log_likelihoods).sum(axis=1)
        bound = 4 * likelihoods.std(ddof=1) / math.sqrt(60)
        assert abs(likelihoods.mean() + likelihoods.var() / 2) < bound


N = 9


@cache
def compiled_rotator(n):
    return Loops(rotator(n, 1))


def rotated(members, key, step=3):
    n, size = members.shape
    row = np.zeros(memory_offsets(n, 1).extras)
    places = memory_offsets(n, 1)
    row[places.key_0], row[places.key_1], row[places.step] = *key, step
    table = np.hstack([members, np.full((n, 3), 7.0)])
    compiled_rotator(n)((row, table, np.zeros(32)), size)
    assert (table[:, size:] == 7.0).all()
    return table[:, :size]


def test_a_rotation_keeps_mean_and_covariance():
    members = np.random.default_rng(1).normal(size=(2, N)) + [[3.0], [-1.0]]
    found = rotated(members, (5, 6))
    np.testing.assert_allclose(found.mean(axis=1), members.mean(axis=1), rtol=1e-13)
    np.testing.assert_allclose(np.cov(found), np.cov(members), rtol=1e-12)
    assert np.abs(found - members).min() > 1e-4
    np.testing.assert_array_equal(found, rotated(members, (5, 6)))
    assert not np.allclose(found, rotated(members, (5, 7))) and not np.allclose(found, rotated(members, (5, 6), 4))


def test_the_rotations_are_uniform():
    """The entries have the moments of a matrix that is uniform on the N - 1 axes beside (1, ..., 1)."""
    matrices = np.array([rotated(np.eye(N), (7, count)) for count in range(4000)])
    np.testing.assert_allclose(
        matrices @ np.swapaxes(matrices, 1, 2), np.tile(np.eye(N), (4000, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(matrices.sum(axis=2), 1.0, rtol=1e-12)
    # W = 1 1'/N + B U B': E[W] = 1 1'/N, and E[(W_ij - 1/N)^2] = (B B')_ii (B B')_jj/(N - 1), B B' = I - 1 1'/N.
    error = matrices.std(axis=0).max() / 4000**0.5
    np.testing.assert_allclose(matrices.mean(axis=0), 1 / N, atol=4 * error)
    variances = ((matrices - 1 / N) ** 2).mean(axis=0)
    np.testing.assert_allclose(variances, (1 - 1 / N) ** 2 / (N - 1), rtol=0.1)


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("name", ["etkf", "ensrf", "denkf"])
def test_a_filter_with_rotations_has_the_moments_of_one_without_after_an_update(name):
    plain, turned = (make_filter(name, thruster_model(), ensemble_size=6, rotations=r) for r in (0, 1))
    one, other = (f.update(f.init((1, 2)), [3.0])[0] for f in (plain, turned))
    np.testing.assert_allclose(other.mean, one.mean, rtol=1e-12)
    np.testing.assert_allclose(np.cov(other.members), one.cov, rtol=1e-10)
    np.testing.assert_array_equal(other.cov, one.cov)
    assert not np.allclose(other.members, one.members)


def test_a_smoother_refuses_rotations():
    filter_ = make_filter("etkf", thruster_model(), ensemble_size=5, rotations=1)
    with pytest.raises(ValueError, match="a smoothed filter must have rotations 0, but got 1"):
        smooth(filter_, np.zeros((1, 2)), np.zeros((1, 3, 1)), np.zeros((1, 4, 1)), lag=2)
