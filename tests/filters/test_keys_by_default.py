"""Filters over batches do not ask for random keys where a user has none to give."""

import numpy as np
import pytest

from filters import EnsembleKalmanFilter, KalmanFilter, run, smooth
from tests.models import wide_model
from thruster_env.core.streams import filter_keys
from thruster_env.model.affine import affine_model


def data(model, count=3, steps=7):
    rng = np.random.default_rng(0)
    return rng.normal(size=(count, steps, model.inputs)), rng.normal(size=(count, steps + 1, model.m))


@pytest.mark.parametrize("kind, numbers", [(KalmanFilter, {}), (EnsembleKalmanFilter, {"ensemble_size": 5})])
def test_keys_are_those_of_the_first_seeds_unless_they_are_given(kind, numbers, as_python):
    model = wide_model()
    filter_, (u, z) = kind(model=model, **numbers), data(model)
    given = run(filter_, filter_keys(range(3)), u, z)
    for part, other in zip(given, run(filter_, inputs=u, measurements=z), strict=True):
        np.testing.assert_array_equal(part, other)
    smoothed = smooth(filter_, filter_keys(range(3)), u, z, 2), smooth(filter_, inputs=u, measurements=z, lag=2)
    np.testing.assert_array_equal(smoothed[0].means, smoothed[1].means)


def test_no_keys_are_made_for_a_filter_that_draws_nothing(as_python, monkeypatch):
    def refuse(seeds):
        raise AssertionError(seeds)

    monkeypatch.setattr("filters.engine.batch.filter_keys", refuse)
    model = wide_model()
    u, z = data(model)
    assert np.isfinite(run(KalmanFilter(model=model), inputs=u, measurements=z).means).all()
    with pytest.raises(AssertionError, match=r"range\(0, 3\)"):
        run(EnsembleKalmanFilter(model=model, ensemble_size=5), inputs=u, measurements=z)


def test_a_model_without_inputs_needs_none(as_python):
    noise = {"process_noise_cov": [0.1], "measurement_noise_cov": [1.0], "prior_mean": [0.0], "prior_cov": [1.0]}
    filter_ = KalmanFilter(model=affine_model(a=[[0.9]], b=np.zeros((1, 0)), c=[[1.0]], **noise))
    z = data(filter_.model)[1]
    whole = run(filter_, filter_keys(range(3)), np.zeros((3, 7, 0)), z)
    np.testing.assert_array_equal(whole.means, run(filter_, measurements=z).means)


def test_measurements_have_to_be_given(as_python):
    filter_ = KalmanFilter(model=wide_model())
    with pytest.raises(ValueError, match=r"measurements must be an array \(B, K \+ 1, m\), but got None"):
        run(filter_)
    with pytest.raises(ValueError, match="inputs and measurements must have shapes"):
        run(filter_, measurements=data(filter_.model)[1])
