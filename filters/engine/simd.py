"""SIMD batches: trajectories of filters without an ensemble, side by side in vectorised code.

Number i of all beliefs of a block lies in one line of memory. Each stage of a step is a loop over the block with
no inner loop, which the compiler vectorises: an extended Kalman step of the thruster takes a quarter of the time.
What cannot be vectorised still runs, at the speed of single trajectories.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from filters.engine.belief import Kernels
from filters.engine.layout import memory_places
from filters.engine.restart import LARGEST, restart_if_lost, row_magnitude
from numerics.compiled import function_fingerprint, inlined, narrow
from plants.layout import number_places

# Beliefs in a block, and so the distance of one belief's numbers. The compiler has to know it: it then sees that
# what is written for one belief is never read for another.
BLOCK = 32


def _all_predicting(kernels: Kernels) -> Callable:
    """Return `predict_all(rows, us, ensemble, numbers, width)` for the first `width` beliefs of a block."""
    if kernels.stages is None:
        predict = kernels.predict

        @narrow
        @inlined
        def predict_all(rows, us, ensemble, numbers, width):
            table, draws = ensemble
            for j in range(width):
                predict((rows[j], table, draws), us[j], numbers, 0)

        return predict_all
    begin, advance, finish = kernels.stages
    substeps_place = number_places(kernels.n, kernels.m).substeps

    @narrow
    @inlined
    def predict_in_stages(rows, us, ensemble, numbers, width):
        table, draws = ensemble
        for j in range(width):
            begin((rows[j], table, draws), us[j], numbers, 0)
        for _ in range(int(numbers[substeps_place])):
            for j in range(width):
                advance((rows[j], table, draws), us[j], numbers, 0)
        for j in range(width):
            finish((rows[j], table, draws), us[j], numbers, 0)

    return predict_in_stages


def build_lanes(kernels: Kernels) -> Callable:
    """Return `lanes(together, keys, inputs, measurements, numbers, noise, out, first, last)`.

    It filters trajectories first ... last - 1. Blocks are filled up to a multiple of `together`, the numbers in a
    vector register, with copies of their last trajectory. For the rest see `filters.engine.compile.batch`.
    """
    n, m, start, predict, update = kernels.n, kernels.m, kernels.start, kernels.predict, kernels.update
    places, source = memory_places(n, m), number_places(n, m)
    mean, cov, innovation, s = places.mean, places.cov, places.innovation, places.innovation_cov
    key_0, key_1, divergences = places.key_0, places.key_1, places.divergences
    log_likelihood, q_place, r_place = places.log_likelihood, source.q, source.r
    length, table_rows = places.extras + kernels.extras + kernels.scratch, kernels.table_rows
    predict_all, magnitude, restart = _all_predicting(kernels), row_magnitude(n, m), restart_if_lost(kernels)
    fingerprint = function_fingerprint(start, predict, update, within=__name__)

    @narrow
    def lanes(together, keys, inputs, measurements, given_numbers, noise, out, first, last):
        fingerprint  # noqa: B018 - part of the cache's key
        qs, rs = noise
        means, covs, innovations, innovation_covs, log_likelihoods, counts = out
        table, draws = ensemble = np.zeros((table_rows, 0)), np.zeros(0)
        numbers = given_numbers.copy()  # its own: noise of one step is written into it
        rows, us, zs = np.zeros((length, BLOCK)).T, np.zeros((inputs.shape[2], BLOCK)).T, np.zeros((m, BLOCK)).T
        for b in range(first, last, BLOCK):
            count = min(BLOCK, last - b)
            width = (count + together - 1) // together * together
            for j in range(width):
                rows[j, :] = 0.0
                rows[j, key_0] = keys[b + min(j, count - 1), 0]
                rows[j, key_1] = keys[b + min(j, count - 1), 1]
                start((rows[j], table, draws), numbers, 0)
            for k in range(measurements.shape[1]):
                if k > 0:
                    for j in range(width):
                        for i in range(us.shape[1]):
                            us[j, i] = inputs[b + min(j, count - 1), k - 1, i]
                    if qs.shape[0] > 0:
                        for i in range(qs.shape[1]):
                            numbers[q_place + i] = qs[k - 1, i]
                    predict_all(rows, us, ensemble, numbers, width)
                for j in range(width):
                    for i in range(m):
                        zs[j, i] = measurements[b + min(j, count - 1), k, i]
                if rs.shape[0] > 0:
                    for i in range(rs.shape[1]):
                        numbers[r_place + i] = rs[k, i]
                for j in range(width):
                    update((rows[j], table, draws), zs[j], numbers, 0)
                total = 0.0
                for j in range(width):
                    total += magnitude(rows[j])
                if not total < LARGEST:
                    for j in range(width):
                        restart((rows[j], table, draws), numbers, 0)
                for j in range(count):
                    for i in range(n):
                        means[b + j, k, i] = rows[j, mean + i]
                        for i_2 in range(n):
                            covs[b + j, k, i, i_2] = rows[j, cov + i * n + i_2]
                    for i in range(m):
                        innovations[b + j, k, i] = rows[j, innovation + i]
                        for i_2 in range(m):
                            innovation_covs[b + j, k, i, i_2] = rows[j, s + i * m + i_2]
                    log_likelihoods[b + j, k] = rows[j, log_likelihood]
            for j in range(count):
                counts[b + j] = rows[j, divergences]

    return lanes
