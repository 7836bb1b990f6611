"""Bounds on the errors of angles: a wrapped error is at most half a turn, so a bound on plain errors is none."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

SMALL = 0.1  # variance [rad^2] up to which half a turn is so far away that nothing changes in float64
TERMS, POINTS = 24, 400  # of the Fourier series; of the curve
LEAST, MOST = 5e-3, 1e4  # multipliers mu [rad^4] of the curve's ends but for the last, mu = infinity


def wrapped_variances(variances: np.ndarray, angles: Sequence[bool]) -> np.ndarray:
    """Bounds (..., n) on mean squares of wrapped errors, from posterior Cramér-Rao bounds P on plain ones.

    A density f of an error e on the circle, whose information is at most J = 1/P, has at least the mean square

        v(J) = min E[e^2]  over periodic f on (-pi, pi] with E[(d log f/de)^2] <= J

    A posterior density has no more information after it is wrapped, or after other states are integrated out, and
    v is convex, so the mean of v over measurements is at least v of the mean information: v(1/P) is a bound. With
    f = psi^2 it is the ground state of -4 mu psi'' + e^2 psi = lambda psi, v = lambda - mu J. Far from the cut psi
    is a Gaussian and v = P; so it is up to P = 0.1 rad^2 (18 degrees). For large P it tends to pi^2/3, the mean
    square of a completely unknown angle.

    Args:
        variances: P of n states [rad^2 where they are angles].
        angles: (n,), which states are angles.

    Source: Van Trees (1968), Detection, Estimation, and Modulation Theory I, section 2.4, for P.
    """
    if not any(angles):
        return variances
    bounded = np.array(variances)
    for i in np.flatnonzero(angles):
        large = bounded[..., i] > SMALL
        bounded[large, i] = _curve()(bounded[large, i] ** -0.5)
    return bounded


@cache
def _curve() -> Callable:
    """V as a function of sqrt(J): cubic between points, where dv/dJ = -mu is known."""
    from scipy.interpolate import CubicHermiteSpline

    multipliers = np.geomspace(MOST, LEAST, POINTS)
    points = np.array([_ground_state(mu) for mu in multipliers])
    roots = np.sqrt(points[:, 0])
    # For little information v = pi^2/3 - 2 sqrt(2 J), by perturbation of the uniform density.
    ends = np.append(0.0, roots), np.append(np.pi**2 / 3.0, points[:, 1])
    return CubicHermiteSpline(*ends, np.append(-2.0 * np.sqrt(2.0), -2.0 * multipliers * roots))


def _ground_state(mu: float) -> tuple[float, float]:
    """J and v of a multiplier mu, from psi as a sum of cos(k e), k = 0, 1, ..."""
    k = np.arange(TERMS)
    square = _means(np.add.outer(k, k)) + _means(np.subtract.outer(k, k))
    unit = np.where(k == 0, np.sqrt(0.5), 1.0)  # the constant has twice the mean square of a cosine
    square *= np.outer(unit, unit)
    psi = np.linalg.eigh(square + np.diag(4.0 * mu * k**2))[1][:, 0]
    return float(4.0 * k**2 @ psi**2), float(psi @ square @ psi)


def _means(order: np.ndarray) -> np.ndarray:
    return np.where(order == 0, np.pi**2 / 3.0, 2.0 * np.where(order % 2, -1.0, 1.0) / np.maximum(order**2, 1))
