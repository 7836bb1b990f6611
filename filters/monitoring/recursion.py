"""One step of all tests, of one belief: compiled, without an allocation, so that it may run on a boat."""

from __future__ import annotations

import numpy as np

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
        place = int(state[i, NEXT])
        state[i, RING + place] = e
        state[i, NEXT] = float((place + 1) % window)
        state[i, FILLED] = min(state[i, FILLED] + 1.0, float(window))
        sum_of_last, best, length = 0.0, 0.0, 0
        for j in range(int(state[i, FILLED])):
            sum_of_last += state[i, RING + (place - j) % window]
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
