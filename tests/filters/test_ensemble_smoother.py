"""The ensemble smoother against a naive one with the same draws, and against the smoother of a Kalman filter."""

import json
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from filters import (
    EnsembleKalmanFilter,
    EnsembleTransformFilter,
    IteratedEnsembleKalmanFilter,
    KalmanFilter,
    SerialSquareRootFilter,
)
from filters.runs import smooth
from tests.models import KEY, plane_model, scalar_model, simulated, wide_model
from tests.oracles import normals
from thruster_env.core.compiled import interpreted
from thruster_env.core.streams import FILTER_MEASUREMENT, FILTER_PRIOR, FILTER_PROCESS, episode_keys

KEYS = np.array([KEY])
with_gaps = partial(simulated, level=1.0, missing=0.25)


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
    np.testing.assert_allclose(found.means, exact.means, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(found.covs, exact.covs, rtol=1e-8, atol=1e-8)


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
