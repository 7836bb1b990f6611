"""The kernels of weights and of resampling against NumPy and the textbook's formulas."""

import math

import numpy as np
import pytest

from filters.particles.weights import (
    exponential,
    normalise,
    systematic_resampler,
    weighted_covariances,
    weighted_means,
)


def test_resampling_draws_each_particle_as_often_as_its_weight_says():
    size, rng = 9, np.random.default_rng(4)
    weights = rng.exponential(size=size) ** 3
    weights[[0, 4, 8]] = 0.0
    resample, counts, repeats = systematic_resampler(1, 1, 2), np.zeros(size), 2000
    for u in (np.arange(repeats) + 0.5) / repeats:
        table = np.zeros((5, 16))
        table[0, :size], table[1, :size] = np.arange(size), weights
        resample(table, size, u)
        drawn = table[0, :size].astype(int)
        expected = np.searchsorted(np.cumsum(weights) / weights.sum(), (u + np.arange(size)) / size)
        np.testing.assert_array_equal(drawn, expected)
        assert (table[0, size:] == drawn[0]).all()  # padding follows a real particle
        count = np.bincount(drawn, minlength=size)
        assert (np.abs(count - size * weights / weights.sum()) < 1.0).all()
        counts += count
    # Over all u a particle is drawn N w times; a grid of 2000 of them leaves an error of 1/2000 for each edge.
    np.testing.assert_allclose(counts / repeats, size * weights / weights.sum(), atol=2.0 / repeats)


def test_resampling_of_no_weight_at_all_changes_nothing():
    table = np.zeros((5, 8))
    table[0] = np.arange(8.0)
    for weight in (0.0, np.nan):
        table[1] = weight
        systematic_resampler(1, 1, 2)(table, 6, 0.5)
        np.testing.assert_array_equal(table[0], np.arange(8.0))


def test_the_exponential_is_one():
    x = np.random.default_rng(0).uniform(-45.0, 5.0, size=2000)
    np.testing.assert_allclose([exponential(v) for v in x], np.exp(x), rtol=1e-13)
    assert exponential(0.0) == 1.0
    assert exponential(-math.inf) == exponential(math.nan) == pytest.approx(math.exp(-46.0))


def test_weights_are_normalised_and_tell_their_effective_size():
    logarithms = np.array([-1000.0, -1001.0, -1002.5, -1900.0])
    table = np.zeros((2, 8))
    table[0, :4] = logarithms
    total, size = normalise(table, 0, 1, 4)
    w = np.exp(logarithms + 1000.0)
    assert total == pytest.approx(-1000.0 + math.log(w.sum()), rel=1e-14)
    np.testing.assert_allclose(table[1, :4], w / w.sum(), rtol=1e-12, atol=1e-19)
    np.testing.assert_allclose(table[0, :4], logarithms - total, rtol=1e-12)
    assert size == pytest.approx(w.sum() ** 2 / (w**2).sum())
    table[0, :4] = -math.inf
    assert all(math.isnan(value) for value in (normalise(table, 0, 1, 4)[0], *table[1, :4]))


def test_the_covariance_of_equal_weights_is_the_sample_covariance():
    table = np.zeros((3, 16))
    table[:2, :11] = np.random.default_rng(2).normal(size=(2, 11))
    table[2, :11] = 1.0 / 11
    means = weighted_means(0, 2, 2)(table, 11)
    found = weighted_covariances(0, 2, 2)(table, 11, means)
    np.testing.assert_allclose(means, table[:2, :11].mean(axis=1), rtol=1e-12)
    np.testing.assert_allclose(found, np.cov(table[:2, :11]), rtol=1e-12)
