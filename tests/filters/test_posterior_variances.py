"""The posterior bound's variances: the same in parts, and of how many sequences of a large model."""

from collections import namedtuple

import numpy as np
import pytest

from filters import bounds
from filters.bounds import posterior_bound, posterior_variances, riccati_covariances
from tests.models import affine
from thruster_env.thruster.model import thruster_model

INPUTS = np.repeat(np.random.default_rng(3).uniform(-12, 12, size=(5, 4, 1)), 3, axis=1)


@pytest.mark.parametrize(("bytes_", "work"), [(1, 2e9), (2**28, 8 * 5 * 13 * 3), (1, 1)])
def test_in_parts_they_are_those_of_the_whole_bound_to_the_bit(monkeypatch, bytes_, work):
    model = thruster_model()
    whole = np.einsum("bkii->bki", posterior_bound(model, INPUTS, truths=7, seed=2))
    monkeypatch.setattr(bounds, "MOST_BYTES", bytes_)
    monkeypatch.setattr(bounds, "WORK_AT_ONCE", work)
    monkeypatch.setattr(bounds, "cores", lambda: 2)
    np.testing.assert_array_equal(posterior_variances(model, INPUTS, truths=7, seed=2), whole)


def test_of_a_large_model_the_work_limits_the_sequences_and_equal_ones_are_one(monkeypatch):
    inputs = np.arange(40.0)[:, None, None] * np.ones((40, 150, 2))
    sized = namedtuple("Sized", "n substeps", defaults=(1,))
    assert len(bounds.sequences_taken(inputs, 100, sized(12))) == 40
    assert bounds.sequences_taken(inputs, 100, sized(40)).tolist() == [2 * i for i in range(20)]
    assert bounds.sequences_taken(inputs, 100, sized(500)).tolist() == [0]
    assert bounds.sequences_taken(inputs, 100, sized(2, 100)).tolist() == [2 * i for i in range(20)]
    for same in (inputs[:, :, :0], 0 * inputs):
        assert bounds.sequences_taken(same, 100, sized(13)).tolist() == [0]
    model, some = thruster_model(), [0, 2]
    monkeypatch.setattr(bounds, "ALL_UP_TO", 1)
    monkeypatch.setattr(bounds, "MOST_WORK", 2 * 7 * 12 * 8)
    whole = np.einsum("bkii->bki", posterior_bound(model, INPUTS, truths=7))
    np.testing.assert_array_equal(posterior_variances(model, INPUTS, truths=7), whole[some])


def test_a_nearly_singular_q_loses_no_digits_and_a_singular_one_has_no_bound():
    def tracker(jitter):
        g = np.array([0.5, 1.0])
        noise = {"q": 0.04 * np.outer(g, g) + jitter * np.eye(2), "r": [2.0]}
        prior = {"mean": [0.0, 0.0], "cov": [100.0, 4.0]}
        return affine([[1.0, 1.0], [0.0, 1.0]], [[0.0], [0.0]], [[1.0, 0.0]], **noise, **prior)

    inputs = np.zeros((1, 100, 1))
    for jitter in (1e-2, 1e-7, 1e-11):
        model = tracker(jitter)
        steady = riccati_covariances(model)[1]
        np.testing.assert_allclose(posterior_bound(model, inputs, truths=3)[0, -1], steady, rtol=1e-6)
    assert bounds.has_bound(np.diag([1e-9, 1e9])) and not bounds.has_bound(np.diag([0.0, 1.0]))
    with pytest.raises(ValueError, match="positive definite Q"):
        posterior_bound(tracker(1e-17), inputs)
