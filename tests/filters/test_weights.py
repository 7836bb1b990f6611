"""Weights, weighted sums and resampling against NumPy and the textbook's formulas."""

import math

import numpy as np
import pytest

from filters.algebra.matrices import input_matrix
from filters.algebra.points import (
    effective_size,
    normalised,
    weighted_covariance,
    weighted_mean,
    weighted_square,
    weights,
)
from filters.pages.kernels import Stage, as_calls, of_members
from filters.particles.kernels import systematic_resampler
from thruster_env.core.streams import exponential
from thruster_env.graphs.programs import OF_MEMBERS, Place

SIZE = 11


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


def on_arrays(page, x, log_w):
    """A page's results on NumPy's arrays."""
    return [np.squeeze(one) for one in page(x, log_w)]


def in_memory(page, x, log_w, make):
    """The same in memory whose columns are whole vectors; behind the last particle lies what must not count."""
    n, size = x.shape
    table = np.full((n + 2, 16), 9.0)
    table[n], table[:n, :size], table[n, :size] = log_w[0], x, log_w
    states = input_matrix(Place("table", 0), (n,), member=True)
    results = page(states, input_matrix(Place("table", n), (), member=True, like=states))
    places = [Place("table", n + 1) if one.member else Place("rows", 20 * k) for k, one in enumerate(results)]
    rows, nothing = np.zeros(20 * len(results)), np.zeros(1)
    make(Stage(dict(zip(places, results, strict=True)), {}))(rows, nothing, nothing, table, nothing, size)
    return [
        table[n + 1, :size] if one.member else rows[at : at + math.prod(one.shape)].reshape(one.shape)
        for (_, at), one in zip(places, results, strict=True)
    ]


def as_program(page, x, log_w):
    """The same as a program of all particles."""
    return in_memory(page, x, log_w, lambda stage: of_members(stage, len(x) + 2).work)


def as_functions(page, x, log_w):
    """The same as calls of functions."""
    return in_memory(page, x, log_w, lambda stage: as_calls(stage, 0, {}, {}, OF_MEMBERS).values)


each_way = pytest.mark.parametrize("work", [on_arrays, as_program, as_functions])


@pytest.mark.usefixtures("as_python")
@each_way
def test_weights_are_normalised_and_tell_their_effective_size(work):
    def page(x, log_w):
        w, level = normalised(log_w)
        return w, level, effective_size(w)

    for logarithms in ([-1000.0, -1001.0, -1002.5, -1900.0], [-3.0, -math.inf, math.nan, -2.0]):
        found, total, size = work(page, np.zeros((1, 4)), np.array(logarithms))
        w = np.exp(np.nan_to_num(np.array(logarithms), nan=-math.inf) - max(logarithms[0], logarithms[-1]))
        assert total == pytest.approx(max(logarithms[0], logarithms[-1]) + math.log(w.sum()), rel=1e-14)
        np.testing.assert_allclose(found, w / w.sum(), rtol=1e-12, atol=2e-20)
        assert size == pytest.approx(w.sum() ** 2 / (w**2).sum())
    _, total, _ = work(page, np.zeros((1, 4)), np.full(4, -math.inf))
    assert math.isnan(total)


@pytest.mark.usefixtures("as_python")
@each_way
def test_weighted_moments_are_those_of_their_sums(work):
    def page(x, log_w):
        w = weights(log_w)
        return weighted_mean(x, w), weighted_covariance(x, w), weighted_square(x, w)

    rng = np.random.default_rng(2)
    x, w = rng.normal(size=(2, SIZE)), rng.dirichlet(np.ones(SIZE))
    mean, cov, square = work(page, x, np.log(w))
    d = x - x @ w[:, None]
    np.testing.assert_allclose(mean, x @ w, rtol=1e-12)
    np.testing.assert_allclose(cov, d @ np.diag(w) @ d.T / (1.0 - (w**2).sum()), rtol=1e-12)
    np.testing.assert_allclose(square, x @ np.diag(w) @ x.T, rtol=1e-12)


@pytest.mark.usefixtures("as_python")
@each_way
def test_the_covariance_of_equal_weights_is_the_sample_covariance(work):
    x = np.random.default_rng(2).normal(size=(2, SIZE))
    (found,) = work(lambda x, log_w: (weighted_covariance(x, weights(log_w)),), x, np.full(SIZE, -math.log(SIZE)))
    np.testing.assert_allclose(found, np.cov(x), rtol=1e-12)


@pytest.mark.usefixtures("as_python")
@each_way
def test_the_covariance_of_one_weight_that_is_nearly_all_is_what_the_others_say(work):
    x, small = np.random.default_rng(3).normal(size=(2, SIZE)), 1e-17
    log_w = np.full(SIZE, math.log(small))
    log_w[4] = 0.0
    (found,) = work(lambda x, log_w: (weighted_covariance(x, weights(log_w)),), x, log_w)
    d = np.delete(x - x[:, 4:5], 4, axis=1)
    np.testing.assert_allclose(found, d @ d.T / (2 * (SIZE - 1)), rtol=1e-12)
