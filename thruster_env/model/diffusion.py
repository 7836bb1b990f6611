"""Process noise at another sample time."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.linalg import expm

from thruster_env.core.checks import ROUNDING, as_floats, correlations, covariance, positive, short_repr

SAME_DT = 1e-6  # relative: sample times of logs that are read off stamps


def same_dt(one: float, other: float) -> bool:
    """Whether two sample times [s] agree except for the rounding of stamps."""
    return abs(one - other) <= SAME_DT * max(abs(one), abs(other))


def noise_for_dt(
    process_noise_cov: ArrayLike, dt_from: float, dt_to: float, slope: ArrayLike | None = None
) -> np.ndarray:
    """Q of a step of another sample time: Q dt_to/dt_from, that of Gaussian diffusion.

    It is exact if the states change little within a step; otherwise a first guess. With the slope A it is exact
    for linear rates: white noise of the densities that give this Q at `dt_from`.

    Args:
        process_noise_cov: Q per step of `dt_from`, a matrix, variances or one.
        dt_from: its sample time [s].
        dt_to: the new sample time [s].
        slope: A, the derivative of the rates by the state, (n, n); zero if None.

    Raises:
        ValueError: with a slope, if no white noise gives such a Q.
    """
    if slope is None:
        return np.asarray(process_noise_cov, dtype=np.float64) * (dt_to / dt_from)
    return noise_of_densities(densities_of(process_noise_cov, slope, dt_from), slope, dt_to)


def noise_of_densities(densities: ArrayLike, slope: ArrayLike, dt: float) -> np.ndarray:
    """Q per step of white noise with spectral densities S (n, n) on linear rates with slope A.

        Q = int_0^dt e^{A t} S e^{A' t} dt,   exp([-A, S; 0, A'] dt) = [., G; 0, F'],   Q = F G

    Source: van Loan (1978), "Computing integrals involving the matrix exponential", IEEE Transactions on Automatic
    Control 23(3).
    """
    a, s = as_floats(slope), as_floats(densities)
    n = len(a)
    found = expm(np.block([[-a, s], [np.zeros((n, n)), a.T]]) * positive("dt", dt))
    q = found[n:, n:].T @ found[:n, n:]
    return 0.5 * (q + q.T)


def densities_of(process_noise_cov: ArrayLike, slope: ArrayLike, dt: float) -> np.ndarray:
    """S (n, n) that gives this Q per step dt: `noise_of_densities`, linear in S, solved for S.

    Raises:
        ValueError: if S is no covariance: no white noise on such rates gives this Q.
    """
    slope = as_floats(slope)
    n = len(slope)
    q, units = correlations(covariance("process_noise_cov", process_noise_cov, n))
    slope, (rows, columns) = slope / units[:, None] * units, np.triu_indices(n)
    of_units = np.empty((len(rows), len(rows)))
    for place, (i, j) in enumerate(zip(rows, columns, strict=True)):
        unit = np.zeros((n, n))
        unit[i, j] = unit[j, i] = 1.0
        of_units[:, place] = noise_of_densities(unit, slope, dt)[rows, columns]
    s = np.zeros((n, n))
    s[rows, columns] = s[columns, rows] = np.linalg.solve(of_units, q[rows, columns])
    given = short_repr(as_floats(process_noise_cov).tolist())
    try:
        s = covariance("densities", s, n, variances=np.diag(q) / dt)
        without = np.diag(s) <= ROUNDING * np.diag(q) / dt  # all their noise is that of others, but for rounding
        s[without], s[:, without] = 0.0, 0.0
        return s * units[:, None] * units
    except ValueError:
        raise ValueError(
            "process_noise_cov must be that of white noise in continuous time (a state driven by others has part "
            f"of their noise within a step), but got {given} for a step of {dt:g} s"
        ) from None
