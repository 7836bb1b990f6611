"""Naive computations that tests of several filters compare with, and comparisons of several arrays."""

import math

import numpy as np

from filters import run
from tests.models import KEY
from thruster_env.core.streams import normal_block


def each_close(found, expected, **tolerances):
    """Assert that arrays are close to others, pair by pair."""
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, **tolerances)


def each_equal(found, expected):
    """Assert that arrays are equal to others, pair by pair."""
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)


def normals(stream, step, rows, size):
    """The normals (rows, size) of KEY's stream: channel i of member j is number i * width + j of one long draw."""
    width = -(-size // 8) * 8  # ensembles are padded to a multiple of eight
    index = np.arange(rows * width)
    block = np.array(normal_block(index // 4, step, stream, *KEY))  # (4, rows * width)
    return block[index % 4, index].reshape(rows, width)[:, :size]


def kalman_update(x, p, innovation, h, r):
    """Mean and covariance after a measurement, and S = H P H' + R, as in Kalman (1960)."""
    s = h @ p @ h.T + r
    gain = p @ h.T @ np.linalg.inv(s)
    return x + gain @ innovation, (np.eye(len(x)) - gain @ h) @ p, s


def equal(one, other):
    """Whether two named tuples (beliefs, innovations, estimates) hold the same numbers."""
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def relative_errors(found, means, covs):
    """Errors of the estimates' means (B, K, n) and covariances, in units of the spread that `covs` says."""
    spread = np.sqrt(np.einsum("bkii->bki", covs))
    return (found.means - means) / spread, (found.covs - covs) / (spread[..., :, None] * spread[..., None, :])


def convergence(make, sizes, data, means, covs):
    """Relative RMS errors (2, sizes) of means and covariances, and the estimates of the largest ensemble.

    Args:
        make: make(size) is a filter of so many members.
        sizes: the numbers of members.
        data: keys, inputs and measurements, for `filters.run`.
        means: (B, K + 1, n), what the filters' means have as their limit.
        covs: the same of the covariances.
    """
    errors = []
    for size in sizes:
        found = run(make(size), *data)
        errors.append([np.sqrt(np.mean(error**2)) for error in relative_errors(found, means, covs)])
    return np.transpose(errors), found


def assert_normal(sample, cov, mean=0.0):
    """A sample (d, N) has the mean and covariance given, to four standard errors."""
    size, spread = sample.shape[1], np.sqrt(np.diag(cov))
    assert (np.abs(sample.mean(axis=1) - mean) < 4 * spread / math.sqrt(size)).all()
    standard_error = np.sqrt((np.outer(spread**2, spread**2) + cov**2) / size)
    assert (np.abs(np.cov(sample) - cov) < 4 * standard_error).all()


def kalman_filter(model, inputs, measurements):
    """Means (K + 1, n), covariances and log-likelihoods (K + 1,) by Kalman (1960), of an affine model.

    Channels that are NaN are rows of C and R that are not there.
    """
    a, b, offset, c, shift = model.matrices()
    x, p, found = model.prior_mean, model.prior_cov, []
    for k, z in enumerate(measurements):
        if k:
            x, p = a @ x + b @ inputs[k - 1] + offset, a @ p @ a.T + model.process_noise_cov
        seen = ~np.isnan(z)
        v, h = (z - c @ x - shift)[seen], c[seen]
        x, p, s = kalman_update(x, p, v, h, model.measurement_noise_cov[np.ix_(seen, seen)])
        level = np.linalg.slogdet(2.0 * math.pi * s)[1]
        found.append((x, p, -0.5 * (v @ np.linalg.solve(s, v) + level) if len(v) else 0.0))
    return tuple(np.array(part) for part in zip(*found, strict=True))
