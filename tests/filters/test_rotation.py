"""Random rotations of an ensemble about its mean."""

from functools import cache

import numpy as np
import pytest

from filters import make_filter, smooth, thruster_model
from filters.engine.belief import memory_offsets
from filters.ensembles.stochastic import rotator
from thruster_env.graphs.loops import Loops

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


def test_rotations_are_none_or_one():
    with pytest.raises(ValueError, match="rotations must be 0 or 1, but got 2"):
        make_filter("etkf", thruster_model(), rotations=2)
