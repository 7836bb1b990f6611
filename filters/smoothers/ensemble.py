"""The ensemble Kalman smoother: each measurement moves the members of earlier steps, too."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from functools import lru_cache
from typing import Any

import numpy as np

from filters.engine.belief import Kernels, memory_places, restart_if_lost
from filters.engine.compile import new_memory
from filters.ensembles.ensemble import EnsembleFilter, named
from filters.pages.members import analysis_of
from thruster_env.core.compiled import CompiledOrPython, function_fingerprint, inlined, is_interpreting
from thruster_env.core.sources import joiner, vector_part, written_out
from thruster_env.core.threads import spread
from thruster_env.model.shape import number_places
from thruster_env.model.state_space import StateSpaceModel


def smooth_ensembles(
    filter_: EnsembleFilter,
    keys: np.ndarray,
    inputs: np.ndarray,
    measurements: np.ndarray,
    lag: int,
    noise: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means (B, K + 1, n) and covariances of an ensemble given `lag` later measurements, and restarts (B,).

    The analysis of measurement k is repeated for each pair (x_k, x_l) of the members now and at an earlier step l
    >= k - lag, with a state of twice the size whose first half is measured. So the members of step l get the
    analysis that they would get as part of one long state: with perturbed measurements
    x_lj += cov(x_l, y) S^-1 (z - v_j - y_j). Relaxation acts only on the members now, and steps before a restart
    from the prior are not changed.

    `noise` is the result of `filters.engine.batch.noise_rows`.

    Raises ValueError for a filter with rotations, which would mix the members of one step only, with a radius,
    because localisation moves each state with other weights, or with a window.
    """
    rotations = getattr(filter_, "rotations", 0)
    if rotations:
        raise ValueError(f"a smoothed filter must have rotations 0, but got {rotations}")
    if getattr(filter_, "radius", 0.0) or filter_.by_parts:
        raise ValueError(f"a smoothed ensemble must have one gain for all states, but got {named(filter_)}")
    paired = dataclasses.replace(filter_, model=_paired_model(filter_.kernel_model))
    kernels, pair_kernels, size = filter_.kernels(), paired.kernels(), filter_.size
    analyse_pair = analysis_of(filter_.plain_page, paired.model.functions, paired.model.shape)
    count, times, _ = measurements.shape
    n = kernels.n
    out = np.empty((count, times, n)), np.empty((count, times, n, n)), np.zeros(count)
    smooth = _smoother(kernels, analyse_pair, is_interpreting())

    def part(first: int, last: int) -> None:
        now, pair = new_memory(kernels, size), new_memory(pair_kernels, size)
        history = np.zeros((times * n, now[1].shape[1]))
        numbers = filter_.numbers, paired.numbers
        data = keys, inputs, measurements, *noise
        smooth(now, pair, history, size, data, numbers, lag, out, first, last)

    spread(part, count)
    return out


def _paired_model(model: StateSpaceModel) -> StateSpaceModel:
    """The model of a state (x_k, x_l): the first half moves and is measured, the second stays."""
    nothing = np.zeros((model.n, model.n))
    transition, observe = _paired_functions(model.functions.transition, model.functions.observe, model.n)
    return StateSpaceModel(
        transition=transition,
        observe=observe,
        process_noise_cov=np.block([[model.process_noise_cov, nothing], [nothing, nothing]]),
        measurement_noise_cov=model.measurement_noise_cov,
        prior_mean=np.tile(model.prior_mean, 2),
        prior_cov=np.block([[model.prior_cov, nothing], [nothing, nothing]]),
        inputs=model.inputs,
        constants=model.constants,
        substeps=model.substeps,
        measurements=model.measurements,  # of which some may be angles
    )


@lru_cache(maxsize=64)
def _paired_functions(transition: Callable, observe: Callable, n: int) -> tuple[Callable, Callable]:
    now, past = (vector_part(n, 2 * n, first) for first in (0, n))
    names: dict[str, Any] = {"now": now, "past": past, "join": joiner(n, n)}
    moves = written_out("moves", "x, u, c", "join(f(now(x), u, c), past(x))", f=transition, **names)
    return moves, written_out("observe", "x, c", "h(now(x), c)", h=observe, now=now)


@lru_cache(maxsize=64)
def _smoother(kernels: Kernels, analyse_pair: Callable, interpreting: bool) -> CompiledOrPython:
    n, m = kernels.n, kernels.m
    start, predict, update, restart = kernels.start, kernels.predict, kernels.update, restart_if_lost(kernels)
    layout, pair_places = memory_places(n, m), memory_places(2 * n, m)
    key_0, key_1, step, divergences = layout.key_0, layout.key_1, layout.step, layout.divergences
    pair_key_0, pair_key_1, pair_step = pair_places.key_0, pair_places.key_1, pair_places.step
    mean, cov, summarise = layout.mean, layout.cov, kernels.summarise
    q_place, r_place, pair_r_place = number_places(n, m).q, number_places(n, m).r, number_places(2 * n, m).r
    fingerprint = function_fingerprint(start, predict, update, analyse_pair, within=__name__)

    @inlined
    def copy(target, at, source, first):
        for i in range(n):
            for j in range(target.shape[1]):
                target[at + i, j] = source[first + i, j]

    def smooth(now, pair, history, size, data, numbers, lag, out, first, last):
        fingerprint  # noqa: B018 - part of the cache's key
        keys, inputs, measurements, qs, rs = data
        means, covs, restarts = out
        row, table, _ = now
        pair_row, pair_table, _ = pair
        own_parameters, pair_numbers = numbers
        forecast = np.zeros((n, table.shape[1]))
        u, z, times = np.zeros(inputs.shape[2]), np.zeros(m), measurements.shape[1]
        for b in range(first, last):
            row[key_0] = pair_row[pair_key_0] = keys[b, 0]
            row[key_1] = pair_row[pair_key_1] = keys[b, 1]
            row[step] = row[divergences] = 0.0
            oldest = 0
            for k in range(times):
                for i in range(m):
                    z[i] = measurements[b, k, i]
                if k > 0:
                    for i in range(u.shape[0]):
                        u[i] = inputs[b, k - 1, i]
                    if qs.shape[0] > 0:
                        for i in range(qs.shape[1]):
                            own_parameters[q_place + i] = qs[k - 1, i]
                    predict(now, u, own_parameters, size)
                else:
                    start(now, own_parameters, size)
                if rs.shape[0] > 0:
                    for i in range(rs.shape[1]):
                        own_parameters[r_place + i] = pair_numbers[pair_r_place + i] = rs[k, i]
                copy(forecast, 0, table, 0)
                update(now, z, own_parameters, size)
                restart(now, own_parameters, size)
                copy(history, k * n, table, 0)
                if row[divergences] > 0.0:
                    restarts[b] += 1.0
                    oldest, row[divergences] = k, 0.0
                pair_row[pair_step] = row[step]
                for past in range(max(oldest, k - lag), k):
                    copy(pair_table, 0, forecast, 0)
                    copy(pair_table, n, history, past * n)
                    analyse_pair(pair, z, pair_numbers, size)
                    copy(history, past * n, pair_table, n)
            for k in range(times):
                copy(table, 0, history, k * n)
                summarise(now, size)
                for i in range(n):
                    means[b, k, i] = row[mean + i]
                    for j in range(n):
                        covs[b, k, i, j] = row[cov + i * n + j]

    return CompiledOrPython(smooth)
