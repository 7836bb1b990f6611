"""One step of all tests, of one belief: compiled, without an allocation, so that it may run on a boat.

Normalised innovations e of a consistent filter are independent and N(0, 1). The average run length is the mean
number of steps until a test raises an alarm; without a fault it is the mean time between false alarms.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import brentq
from scipy.special import chdtri, ndtr

OUTLIER, CUSUM, GLR, VARIANCE, STUCK, MISSING = range(6)
# Of a channel: both CUSUMs, and the steps at which they left zero; squares and their number; equal readings and
# the last one; missing ones; how many innovations are in the ring, and where the next one goes; then the ring.
ABOVE, ABOVE_SINCE, BELOW, BELOW_SINCE, SQUARES, COUNT, EQUAL, LAST, GONE, FILLED, NEXT, RING = range(12)
LARGEST = 1e100  # of normalised innovations


def step_tests(state, k, innovation, cov, z, limits, raised, since, sizes):
    """Work out all tests of a step.

    Args:
        state: (m, RING + N), changed; zeros before the first step.
        k: number of the step.
        innovation: v (m,).
        cov: S (m, m).
        z: measurement (m,), NaN where nothing was measured.
        limits: what `Monitor.limits` gives.
        raised: set: whether a test raises an alarm at this step, (6, m).
        since: set where it does: the step at which it began, (6, m).
        sizes: set where it does: biases and outliers in the measurement's unit, ratios of variances, else numbers
            of steps, (6, m).

    Returns:
        Whether a channel is dead: stuck or missing, at this step as since its alarm.
    """
    m, window = innovation.shape[0], state.shape[1] - RING
    reference, cusum, glr, low, high, block = limits[0], limits[1], limits[2], limits[3], limits[4], limits[5]
    stuck, missing = limits[6], limits[7]
    largest, worst = 0.0, 0
    for i in range(m):
        for test in range(6):
            raised[test, i] = False
        if not z[i] == z[i]:
            state[i, GONE] += 1.0
            if state[i, GONE] == missing:
                raised[MISSING, i], since[MISSING, i], sizes[MISSING, i] = True, k - missing + 1.0, missing
            continue
        state[i, GONE] = 0.0
        deviation = cov[i, i] ** 0.5
        e = innovation[i] / deviation
        if not abs(e) < LARGEST:  # a filter that is lost says nothing of a sensor
            continue
        if abs(e) > largest:
            largest, worst = abs(e), i
        state[i, EQUAL] = state[i, EQUAL] + 1.0 if z[i] == state[i, LAST] and state[i, EQUAL] > 0.0 else 1.0
        state[i, LAST] = z[i]
        if state[i, EQUAL] == stuck:
            raised[STUCK, i], since[STUCK, i], sizes[STUCK, i] = True, k - stuck + 1.0, stuck
        for sign, total, began in ((1.0, ABOVE, ABOVE_SINCE), (-1.0, BELOW, BELOW_SINCE)):
            if state[i, total] == 0.0:
                state[i, began] = k
            state[i, total] = max(0.0, state[i, total] + sign * e - reference)
            if state[i, total] >= cusum:
                count = k - state[i, began] + 1.0
                raised[CUSUM, i], since[CUSUM, i] = True, state[i, began]
                sizes[CUSUM, i] = sign * (state[i, total] / count + reference) * deviation
                state[i, total] = 0.0
        state[i, SQUARES] += e * e
        state[i, COUNT] += 1.0
        if state[i, COUNT] == block:
            if not low <= state[i, SQUARES] <= high:
                raised[VARIANCE, i], since[VARIANCE, i] = True, k - block + 1.0
                sizes[VARIANCE, i] = state[i, SQUARES] / block
            state[i, SQUARES] = state[i, COUNT] = 0.0
        newest = int(state[i, NEXT])
        state[i, RING + newest] = e
        state[i, NEXT] = float((newest + 1) % window)
        state[i, FILLED] = min(state[i, FILLED] + 1.0, float(window))
        sum_of_last, best, length = 0.0, 0.0, 0
        for j in range(int(state[i, FILLED])):
            sum_of_last += state[i, RING + (newest - j) % window]
            ratio = sum_of_last * sum_of_last / (j + 1.0)
            if ratio > best:
                best, length = ratio, j + 1
                sizes[GLR, i] = sum_of_last / (j + 1.0) * deviation
        if best >= glr * glr:
            raised[GLR, i], since[GLR, i] = True, k - length + 1.0
            state[i, FILLED] = 0.0
    if largest > 0.0:
        squared, present = squared_innovation(innovation, cov, z)
        if squared >= limits[7 + present]:
            raised[OUTLIER, worst], since[OUTLIER, worst], sizes[OUTLIER, worst] = True, k, innovation[worst]
    dead = False
    for i in range(m):
        dead = dead or state[i, EQUAL] >= stuck or state[i, GONE] >= missing
    return dead


def squared_innovation(innovation, cov, z):
    """V' S^-1 v of the channels that are there, by elimination, and their number."""
    m, count, total = innovation.shape[0], 0, 0.0
    s, v = cov.copy(), innovation.copy()
    for i in range(m):
        if z[i] == z[i]:
            count += 1
            total += v[i] * v[i] / s[i, i]
            for j in range(i + 1, m):
                factor = s[j, i] / s[i, i]
                v[j] -= factor * v[i]
                for a in range(i + 1, m):
                    s[j, a] -= factor * s[i, a]
    return total, count


def run_tests(state, innovations, covs, measurements, limits, raised, since, sizes):
    """Work out all tests of K steps; raised, since and sizes are (K, 6, m)."""
    for k in range(innovations.shape[0]):
        step_tests(
            state, float(k), innovations[k], covs[k], measurements[k], limits, raised[k], since[k], sizes[k]
        )


def new_state(channels: int, window: int) -> np.ndarray:
    """The state before the first step."""
    return np.zeros((channels, RING + window))


# Thresholds of tests on innovations, from how many steps shall lie between two false alarms of each.

NODES = 80  # of the integral equation
LARGEST_THRESHOLD = 60.0  # of thresholds, in standard deviations


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
    while function(high) < 0.0 and high < LARGEST_THRESHOLD:
        high *= 1.5
    return float(brentq(function, least, high, xtol=1e-10))
