"""Inflation that adapts to the innovations, around the kernels of any ensemble filter.

    predict: x_j = mean + t^1/2 (x_j - mean) at the end of the step
    update:  t = max(1, t + u), u the mode of  (1 + g u) exp(-u^2/(2 deviation^2)),
             g = d log N(v; 0, (t'/t) A + R)/dt' at t' = t,  A = S - R the forecast's own part of S

One factor t is kept in the belief, in its extras; it begins at 1. Before each update it is normal with a standard
deviation that does not shrink, so that it can follow a model whose errors change; its likelihood is linear about
the last value. An error of the model which is not in Q widens the innovations, and so the ensemble.

Source: Anderson (2007), "An adaptive covariance inflation error correction algorithm for ensemble filters", for
one factor; the linear likelihood is that of Anderson (2009), "Spatially and temporally varying adaptive covariance
inflation for ensemble filters", here of all channels at once.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places
from thruster_env.numerics.compiled import inlined
from thruster_env.plants.layout import number_places


@inlined
def score_of(row, innovation, cov, numbers, r, z, lower):
    """W'A w - tr(S^-1 A), w = S^-1 v and A = S less R, over channels that are there; lower (m, m) is scratch."""
    m, found = len(z), 0.0
    for i in range(m):
        for j in range(i + 1):
            total = row[cov + i * m + j]
            for k in range(j):
                total -= lower[i, k] * lower[j, k]
            lower[i, j] = total**0.5 if i == j else total / lower[j, j]
    w = np.zeros(m)
    for i in range(m):
        total = row[innovation + i]
        for k in range(i):
            total -= lower[i, k] * w[k]
        w[i] = total / lower[i, i]
    for i in range(m - 1, -1, -1):
        for k in range(i + 1, m):
            w[i] -= lower[k, i] * w[k]
        w[i] /= lower[i, i]
    column = np.zeros(m)
    for j in range(m):
        if z[j] == z[j]:
            for i in range(m):
                seen = z[i] == z[i]
                column[i] = row[cov + i * m + j] - numbers[r + i * m + j] if seen else 0.0
            for i in range(m):
                found += w[i] * column[i] * w[j]
            for i in range(m):
                for k in range(i):
                    column[i] -= lower[i, k] * column[k]
                column[i] /= lower[i, i]
            for i in range(m - 1, j - 1, -1):
                for k in range(i + 1, m):
                    column[i] -= lower[k, i] * column[k]
                column[i] /= lower[i, i]
            found -= column[j]
    return found


@lru_cache(maxsize=64)
def with_adaptive_inflation(kernels: Kernels, deviation_place: int) -> Kernels:
    """An ensemble's kernels that inflate each forecast by a factor that is kept in the belief, and adapt it."""
    n, m = kernels.n, kernels.m
    places = memory_places(n, m)
    factor, innovation, cov, r = places.extras, places.innovation, places.innovation_cov, number_places(n, m).r
    start_plainly, predict_plainly, update_plainly = kernels.start, kernels.predict, kernels.update

    @inlined
    def start(memory, numbers, size):
        start_plainly(memory, numbers, size)
        memory[0][factor] = 1.0

    @inlined
    def predict(memory, u, numbers, size):
        predict_plainly(memory, u, numbers, size)
        row, table, _ = memory
        spread = row[factor] ** 0.5
        for i in range(n):
            mean = 0.0
            for j in range(size):
                mean += table[i, j] / size
            for j in range(size):
                table[i, j] = mean + spread * (table[i, j] - mean)

    @inlined
    def update(memory, z, numbers, size):
        update_plainly(memory, z, numbers, size)
        row, _, _ = memory
        slope = 0.5 * score_of(row, innovation, cov, numbers, r, z, np.zeros((m, m))) / row[factor]
        # A root of u^2 + u/slope - deviation^2: the larger one where the slope is positive, else the smaller one.
        product = 2.0 * slope * numbers[deviation_place] ** 2
        move = product / (1.0 + (1.0 + 2.0 * slope * product) ** 0.5)
        row[factor] = max(row[factor] + move, 1.0) if abs(move) < np.inf else 1.0

    return kernels._replace(start=start, predict=predict, update=update, extras=1)
