"""Written-out matrix functions against NumPy, for sizes 1 to 4."""

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from thruster_env.core import matrices

SIZES = [1, 2, 3, 4]


def rows_of(matrix):
    return tuple(tuple(row) for row in np.asarray(matrix).tolist())


def random(*shape):
    return np.random.default_rng(shape).normal(size=shape)


def random_covariance(size):
    root = random(size, size + 2)
    return root @ root.T


@pytest.mark.parametrize("rows", SIZES)
@pytest.mark.parametrize("inner", SIZES)
@pytest.mark.parametrize("columns", SIZES)
def test_products_are_those_of_numpy(rows, inner, columns):
    a, b = random(rows, inner), random(inner, columns) + 0.5
    product = matrices.multiplier(rows, inner, columns)(rows_of(a), rows_of(b))
    np.testing.assert_allclose(product, a @ b, rtol=1e-14, atol=1e-14)
    transposed = matrices.transposed_multiplier(rows, inner, columns)(rows_of(a), rows_of(b.T))
    np.testing.assert_allclose(transposed, a @ b, rtol=1e-14, atol=1e-14)
    vector = matrices.vector_multiplier(rows, inner)(rows_of(a), tuple(b[:, 0]))
    np.testing.assert_allclose(vector, a @ b[:, 0], rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("size", SIZES)
def test_a_symmetric_sum_is_exactly_symmetric(size):
    a, b = random(size, size), random(size, size) + 0.1
    total = np.array(matrices.symmetric_sum(size)(rows_of(a), rows_of(b)))
    assert (total == total.T).all()
    np.testing.assert_allclose(total, (a + b + (a + b).T) / 2, rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("size", SIZES)
def test_a_mask_cuts_correlations_to_missing_channels_only(size):
    r = random_covariance(size)
    for missing in range(size):
        z = np.zeros(size)
        z[missing] = math.nan
        expected = r.copy()
        expected[missing, :] = expected[:, missing] = 0.0
        expected[missing, missing] = r[missing, missing]
        np.testing.assert_array_equal(matrices.masked(size)(rows_of(r), tuple(z)), expected)
    np.testing.assert_array_equal(matrices.masked(size)(rows_of(r), (0.0,) * size), r)


@pytest.mark.parametrize("size", SIZES)
def test_the_cholesky_factor_is_that_of_numpy(size):
    a = random_covariance(size)
    factor = matrices.cholesky_factor(size)(rows_of(a))
    np.testing.assert_allclose(factor, np.linalg.cholesky(a), rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("eigenvalue", [0.0, -1.0, math.nan])
def test_a_matrix_that_is_not_positive_definite_has_a_factor_with_nan(size, eigenvalue):
    a = np.diag([1.0] * (size - 1) + [eigenvalue])
    assert np.isnan(matrices.cholesky_factor(size)(rows_of(a))).any()


@pytest.mark.parametrize("rows", SIZES)
@pytest.mark.parametrize("size", SIZES)
def test_the_row_solver_divides_by_the_factored_matrix_from_the_right(rows, size):
    a, b = random_covariance(size), random(rows, size)
    solved = matrices.row_solver(rows, size)(rows_of(b), rows_of(np.linalg.cholesky(a)))
    np.testing.assert_allclose(solved, b @ np.linalg.inv(a), rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("size", SIZES)
def test_the_likelihood_is_that_of_scipy_over_the_channels_that_are_there(size):
    cov, value = random_covariance(size), random(size)
    for missing in [*range(size), None]:
        z, v = np.zeros(size), value.copy()
        here = np.array([i != missing for i in range(size)])
        z[~here], v[~here] = math.nan, 0.0
        s = np.array(matrices.masked(size)(rows_of(cov), tuple(z)))
        found = matrices.innovation_likelihood(size)(tuple(v), rows_of(np.linalg.cholesky(s)), tuple(z))
        part = cov[np.ix_(here, here)]
        expected = multivariate_normal.logpdf(v[here], np.zeros(len(part)), part) if here.any() else 0.0
        assert found == pytest.approx(expected, rel=1e-11, abs=1e-12)


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("rank", SIZES)
def test_the_semidefinite_factor_has_the_covariance_as_its_square_whatever_the_rank(size, rank):
    root = random(size, min(rank, size))
    a = root @ root.T
    factor = np.array(matrices.semidefinite_factor(size)(rows_of(a)))
    assert (factor == np.tril(factor)).all()
    np.testing.assert_allclose(factor @ factor.T, a, rtol=1e-12, atol=1e-13)
    units = np.diag(10.0 ** np.arange(-3, size - 3))
    rescaled = np.array(matrices.semidefinite_factor(size)(rows_of(units @ a @ units)))
    if rank >= size:
        np.testing.assert_allclose(rescaled, units @ factor, rtol=1e-10)
        np.testing.assert_allclose(factor, np.linalg.cholesky(a), rtol=1e-10)


def test_the_semidefinite_factor_of_nothing_is_nothing_and_of_nan_nan():
    np.testing.assert_array_equal(matrices.semidefinite_factor(3)(rows_of(np.zeros((3, 3)))), np.zeros((3, 3)))
    assert np.isnan(matrices.semidefinite_factor(2)(rows_of(np.full((2, 2), math.nan)))).any()


@pytest.mark.parametrize("size", SIZES)
def test_squares_and_inverses_of_factors_are_exactly_symmetric(size):
    a = random_covariance(size)
    factor = np.linalg.cholesky(a)
    square = np.array(matrices.square(size, size)(rows_of(factor)))
    inverse = np.array(matrices.factored_inverse(size)(rows_of(factor)))
    assert (square == square.T).all() and (inverse == inverse.T).all()
    np.testing.assert_allclose(square, a, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(inverse @ a, np.eye(size), rtol=1e-9, atol=1e-9)
    v = random(size)
    solved = matrices.forward_solver(size)(rows_of(factor), tuple(v))
    np.testing.assert_allclose(factor @ solved, v, rtol=1e-12, atol=1e-13)


@pytest.mark.parametrize("rows", SIZES)
@pytest.mark.parametrize("columns", [4, 7])
def test_the_triangular_root_is_that_of_a_qr_decomposition(rows, columns):
    a = random(rows, columns)
    root = np.array(matrices.triangular_root(rows, columns)(rows_of(a)))
    expected = np.linalg.qr(a.T, mode="r").T
    np.testing.assert_allclose(root, expected * np.sign(np.diag(expected)), rtol=1e-12, atol=1e-13)


def test_the_triangular_root_of_a_matrix_with_zero_rows_is_finite():
    a = np.array([[1.0, 2.0, 2.0], [0.0, 0.0, 0.0], [2.0, 4.0, 4.0]])
    root = np.array(matrices.triangular_root(3, 3)(rows_of(a)))
    np.testing.assert_allclose(root @ root.T, a @ a.T, rtol=1e-14)
