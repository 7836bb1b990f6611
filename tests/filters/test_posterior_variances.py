"""The posterior bound's variances: the same in parts, and of how many sequences of a large model."""

import numpy as np
import pytest

from filters import bounds
from filters.bounds import posterior_bound, posterior_variances
from thruster_env.model import thruster_model

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
    assert len(bounds._taken(inputs, 100, 12)) == 40
    assert bounds._taken(inputs, 100, 40).tolist() == [2 * i for i in range(20)]
    assert bounds._taken(inputs, 100, 500).tolist() == [0]
    assert bounds._taken(inputs[:, :, :0], 100, 13).tolist() == bounds._taken(0 * inputs, 100, 13).tolist() == [0]
    model, some = thruster_model(), [0, 2]
    monkeypatch.setattr(bounds, "ALL_UP_TO", 1)
    monkeypatch.setattr(bounds, "MOST_WORK", 2 * 7 * 12 * 8)
    whole = np.einsum("bkii->bki", posterior_bound(model, INPUTS, truths=7))
    np.testing.assert_array_equal(posterior_variances(model, INPUTS, truths=7), whole[some])
