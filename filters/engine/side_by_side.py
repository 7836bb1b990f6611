"""Batches of filters from pages: runs side by side in vectors, a program's instruction for eight of them.

The memory of eight beliefs lies together, number i of all of them in one line: `rows[group, 8 i + j]`. Each stage
of a step goes over four such groups, whose instructions the processor works on at the same time.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places
from filters.engine.restart import LARGEST, restart_if_lost
from thruster_env.core.compiled import function_fingerprint, narrow
from thruster_env.model.layout import LANES, number_places

GROUPS = 4  # worked on one after the other in each stage: their instructions overlap


def build_side_by_side(kernels: Kernels) -> Callable:
    """Return `run(keys, inputs, measurements, numbers, noise, out, first, last)`.

    It filters runs first ... last - 1, by `kernels.vectors`. Empty places of a group are filled with copies of the
    last run. For the rest see `filters.engine.compile.batch`.
    """
    n, m, start = kernels.n, kernels.m, kernels.start
    begin, advance, finish, update = kernels.vectors
    places, source, width, groups = memory_places(n, m), number_places(n, m), LANES, GROUPS
    mean, cov, innovation, s = places.mean, places.cov, places.innovation, places.innovation_cov
    divergences, log_likelihood, substeps = places.divergences, places.log_likelihood, source.substeps
    q_place, r_place, checked = source.q, source.r, places.gain
    length, restart = places.extras + kernels.extras + kernels.scratch, restart_if_lost(kernels)
    fingerprint = function_fingerprint(start, begin, advance, finish, update, within=__name__)

    @narrow
    def run(keys, inputs, measurements, given_numbers, noise, out, first, last):
        fingerprint  # noqa: B018 - part of the cache's key
        qs, rs = noise
        means, covs, innovations, innovation_covs, log_likelihoods, counts = out
        numbers = given_numbers.copy()  # its own: noise of one step is written into it
        one, memory = np.zeros(length), (np.zeros((0, 0)), np.zeros(0))
        rows, zs = np.zeros((groups, length * width)), np.zeros((groups, m * width))
        us = np.zeros((groups, inputs.shape[2] * width))
        for b in range(first, last, groups * width):
            count = min(groups * width, last - b)
            used = (count + width - 1) // width
            one[:] = 0.0
            start((one, *memory), numbers, 0)
            for g in range(used):
                for i in range(length):
                    for j in range(width):
                        rows[g, i * width + j] = one[i]
            for k in range(measurements.shape[1]):
                if k > 0:
                    for g in range(used):
                        for j in range(width):
                            for i in range(inputs.shape[2]):
                                us[g, i * width + j] = inputs[b + min(g * width + j, count - 1), k - 1, i]
                    if qs.shape[0] > 0:
                        for i in range(qs.shape[1]):
                            numbers[q_place + i] = qs[k - 1, i]
                    for g in range(used):
                        begin(rows[g], us[g], numbers)
                    for _ in range(int(numbers[substeps])):
                        for g in range(used):
                            advance(rows[g], us[g], numbers)
                    for g in range(used):
                        finish(rows[g], us[g], numbers)
                if rs.shape[0] > 0:
                    for i in range(rs.shape[1]):
                        numbers[r_place + i] = rs[k, i]
                for g in range(used):
                    for j in range(width):
                        for i in range(m):
                            zs[g, i * width + j] = measurements[b + min(g * width + j, count - 1), k, i]
                total, least = 0.0, 0.0
                for g in range(used):
                    update(rows[g], zs[g], numbers)
                    for i in range(checked * width):
                        total += abs(rows[g, i])
                    for i in range(n):
                        for j in range(width):
                            variance = rows[g, (cov + i * (n + 1)) * width + j]
                            least = variance if variance < least else least
                if not (total < LARGEST and least >= 0.0):
                    for g in range(used):
                        for j in range(width):
                            for i in range(length):
                                one[i] = rows[g, i * width + j]
                            restart((one, *memory), numbers, 0)
                            for i in range(length):
                                rows[g, i * width + j] = one[i]
                for j in range(count):
                    g, at = j // width, j % width
                    for i in range(n):
                        means[b + j, k, i] = rows[g, (mean + i) * width + at]
                        for i_2 in range(n):
                            covs[b + j, k, i, i_2] = rows[g, (cov + i * n + i_2) * width + at]
                    for i in range(m):
                        innovations[b + j, k, i] = rows[g, (innovation + i) * width + at]
                        for i_2 in range(m):
                            innovation_covs[b + j, k, i, i_2] = rows[g, (s + i * m + i_2) * width + at]
                    log_likelihoods[b + j, k] = rows[g, log_likelihood * width + at]
            for j in range(count):
                counts[b + j] = rows[j // width, divergences * width + j % width]

    return run
