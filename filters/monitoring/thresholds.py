"""Thresholds of tests on innovations, from how many steps shall lie between two false alarms of each.

Normalised innovations e of a consistent filter are independent and N(0, 1). The average run length is the mean
number of steps until a test raises an alarm; without a fault it is the mean time between false alarms.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtri, ndtr

NODES = 80  # of the integral equation
LARGEST = 60.0  # of thresholds, in standard deviations


def chi_square(steps: float, degrees: int) -> float:
    """What chi^2 of so many degrees of freedom exceeds once in so many steps."""
    return float(chdtri(degrees, min(1.0 / steps, 1.0)))


def cusum_run_length(threshold: float, reference: float, shift: float = 0.0, sides: int = 2) -> float:
    """Average run length of the CUSUM g = max(0, g + e - k), or of one for each sign, for e ~ N(shift, 1).

        L(u) = 1 + L(0) F(k - u) + int_0^h L(y) f(y + k - u) dy,   1/L = 1/L_above + 1/L_below

    by Gauss-Legendre quadrature.

    Args:
        threshold: h.
        reference: k, half of the bias that is to be found soonest.
        shift: mean of e.
        sides: 2 for both signs, 1 for a bias above zero.

    Source: Page (1954); the integral equation: Goel, Wu (1971), "Determination of A.R.L. and a contour nomogram
    for CUSUM charts", Technometrics 13; two sides: Siegmund (1985), Sequential Analysis, section 2.6.
    """
    rates = [1.0 / _one_sided(threshold, reference, sign * shift) for sign in (1.0, -1.0)[:sides]]
    return 1.0 / sum(rates)


def _one_sided(h: float, k: float, shift: float) -> float:
    nodes, weights = np.polynomial.legendre.leggauss(NODES)
    y, w = 0.5 * h * (nodes + 1.0), 0.5 * h * weights
    k = k - shift
    density = np.exp(-0.5 * (y[None, :] + k - y[:, None]) ** 2) / math.sqrt(2.0 * math.pi)
    from_zero = w * np.exp(-0.5 * (y + k) ** 2) / math.sqrt(2.0 * math.pi)
    matrix = np.block([[1.0 - ndtr(k), -from_zero[None, :]], [-ndtr(k - y)[:, None], np.eye(NODES) - density * w]])
    return float(np.linalg.solve(matrix, np.ones(NODES + 1))[0])


def cusum_threshold(steps: float, reference: float, sides: int = 2) -> float:
    """The threshold h of a CUSUM with so many steps between false alarms, for the reference value k."""
    return _where(lambda h: math.log(cusum_run_length(h, reference, sides=sides) / steps), 1e-6)


def glr_run_length(threshold: float, window: int) -> float:
    """Average run length of the generalised likelihood ratio for a bias that began at most `window` steps ago.

        max_{n <= N} |e_{k-n+1} + ... + e_k| / sqrt(n) >= h,   L = sqrt(2 pi) exp(h^2/2) / (h D)
        D = (h^2/2) sum_{n <= N} nu(h / sqrt n)^2 / n^2,   nu(x) = (2/x) (F(x/2) - 1/2) / (x/2 F(x/2) + f(x/2))

    For windows of 10 to 100 steps simulations agree within 8 %.

    Source: Siegmund (1988), "Approximate tail probabilities for the maxima of some random fields", Annals of
    Probability 16; Siegmund, Venkatraman (1995), "Using the generalized likelihood ratio statistic for sequential
    detection of a change-point", Annals of Statistics 23; nu: Siegmund, Yakir (2007), Statistics of Gene Mapping.
    """
    n = np.arange(1, window + 1)
    x = threshold / np.sqrt(n)
    density = np.exp(-0.125 * x**2) / math.sqrt(2.0 * math.pi)
    nu = (2.0 / x) * (ndtr(0.5 * x) - 0.5) / (0.5 * x * ndtr(0.5 * x) + density)
    chances = 0.5 * threshold**2 * float((nu**2 / n**2).sum())
    return math.sqrt(2.0 * math.pi) * math.exp(0.5 * threshold**2) / (threshold * chances)


def glr_threshold(steps: float, window: int) -> float:
    """The threshold h of the likelihood ratio with so many steps between false alarms."""
    return _where(lambda h: math.log(glr_run_length(h, window) / steps), 1.0)


def _where(function: Callable[[float], float], least: float) -> float:
    """Where a growing function is zero; `least` if it is above zero everywhere."""
    if function(least) >= 0.0:
        return least
    high = 1.0
    while function(high) < 0.0 and high < LARGEST:
        high *= 1.5
    return float(brentq(function, least, high, xtol=1e-10))
