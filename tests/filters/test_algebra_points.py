"""The root of a covariance and its derivative, and what pages say of points, against textbooks and SciPy."""

import numpy as np
import pytest
from scipy.linalg import solve_triangular

from filters.algebra.calls import calls_of
from filters.algebra.matrices import input_matrix
from filters.algebra.points import on_circle, root, root_slope
from thruster_env.core.angles import on_one_branch
from thruster_env.graphs.programs import Place

RNG = np.random.default_rng(0)


def symmetric(size):
    a = RNG.normal(size=(size, size))
    return a + a.T


def called(lower, slope):
    """The slope of a root by functions that are made for its size."""
    size = len(lower)
    of = input_matrix(Place("numbers", 0), lower.shape)
    moves = input_matrix(Place("move", 0), lower.shape, symmetric=True, like=of)
    rows, numbers, move = np.zeros(size**2), lower.ravel(), slope.ravel()
    known = {of: of.operation, moves: moves.operation}
    calls_of([(Place("rows", 0), root_slope(of, moves))], known, {})(rows, np.zeros(1), numbers, move)
    return rows.reshape(size, size)


@pytest.mark.parametrize("size", [1, 3, 8])
def test_the_slope_of_a_root_is_that_of_murray_and_of_central_differences(size):
    p, dp = symmetric(size), symmetric(size)
    p = p @ p + np.eye(size)
    lower = root(p)
    np.testing.assert_allclose(lower, np.linalg.cholesky(p), rtol=1e-13, atol=1e-13)
    inner = solve_triangular(lower, solve_triangular(lower, dp, lower=True).T, lower=True)
    expected = lower @ (np.tril(inner) - 0.5 * np.diag(np.diag(inner)))
    for found in (root_slope(lower, dp), called(lower, dp)):
        np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12)
    difference = (np.linalg.cholesky(p + 1e-6 * dp) - np.linalg.cholesky(p - 1e-6 * dp)) / 2e-6
    np.testing.assert_allclose(expected, difference, rtol=1e-6, atol=1e-8)


@pytest.mark.parametrize("slope_of", [root_slope, called])
def test_the_root_of_a_singular_matrix_has_a_slope_within_its_range_only(slope_of):
    b = RNG.normal(size=(4, 4))
    b[2], b[3] = b[0] - 0.3 * b[1], 0.0
    p = b @ b.T
    lower = root(p)
    np.testing.assert_allclose(lower @ lower.T, p, atol=1e-13)
    assert not lower[:, 2:].any()
    np.testing.assert_allclose(slope_of(lower, 3.0 * p), 1.5 * lower, atol=1e-12)
    leaving = slope_of(lower, np.diag([0.0, 0.0, 0.0, 1.0]))
    assert np.isnan(leaving[3, 3]) and np.isfinite(np.delete(leaving, 3, axis=0)).all()


def test_a_matrix_that_is_no_covariance_has_no_root():
    assert np.isnan(root(np.array([[np.nan, 0.0], [0.0, 1.0]]))[0, 0])
    assert root(np.array([[1.0, 2.0], [2.0, 1.0]]))[1, 1] == 0.0  # a pivot below zero counts as rounding


def test_angles_come_to_the_side_of_their_circular_mean():
    y = np.array([[3.0, -3.1, 3.1, 2.9, -2.5], [9.0, 1.0, 2.0, 3.0, 4.0]])
    found = on_circle(y, (True, False))
    np.testing.assert_allclose(found[1], y[1])
    assert np.ptp(found[0]) < 1.0
    np.testing.assert_allclose(np.exp(1j * found[0]), np.exp(1j * y[0]), rtol=1e-13)
    np.testing.assert_allclose(
        found[0] - found[0].mean(), (r := on_one_branch(y.T, (True, False))[:, 0]) - r.mean()
    )
    assert on_circle(y, (False, False)) is y
