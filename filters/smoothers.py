"""Smoothers: estimates of each state from measurements of later steps as well as from earlier ones.

In order: the ensemble Kalman smoother, in which each measurement also moves the members of earlier steps;
`smoothed`, forwards and backwards over runs (`filters.runs.smooth`); and the fixed-lag smoother of a running
filter, which estimates the state some steps ago from all measurements so far.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from filters.engine.batch import Beliefs, Prepared, noise_rows, run, trajectories
from filters.engine.belief import Belief, Kernels, constrained, memory_offsets, restart_if_lost
from filters.engine.compile import new_memory
from filters.engine.session import Session
from filters.ensembles.ensemble import EnsembleFilter, named
from filters.filter import Filter, PageFilter
from filters.gaussian.multiple_models import MultipleModelFilter
from filters.pages.kernels import analysis_of
from filters.rts import earliest_rows, passes, relation_of, smooth_backwards
from filters.starts import warn_of_restarts
from thruster_env.core.angles import difference, wrapped_where
from thruster_env.core.checks import at_least
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.parallel import spread
from thruster_env.core.sources import joiner, vector_part, written_out
from thruster_env.model.shape import number_offsets
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import refuse_rotations

# The smoother of filters for several models: each pair of successive modes by a step of Rauch, Tung, Striebel.
#
# Backwards from the last step, of the filters' means x_i, covariances P_i and probabilities mu_i after step k,
#
#     x_ij, P_ij = x_i, P_i, corrected by the smoothed x_j, P_j of step k + 1 with the model of mode j
#     w_ij proportional to Pi_ij mu_i N(smoothed x_j; f_j(x_i), F_j P_i F_j' + Q_j), which sum to 1 over i:
#            the probability of mode i at k, if that at k + 1 is j
#     smoothed mu_i = sum over j of w_ij (smoothed mu_j);  x_i, P_i those of the mixture of all x_ij
#
# The differences between modes i that lead to j count in the smoothed P_j, and again between the x_ij, so P is
# rather too large. The smoothed x_j has no states that mode j lacks: their prediction from x_i, given the other
# states, replaces them. After each step a mode gets them from modes that have them
# (`filters.gaussian.blending`).
#
# Source: Kim (1994), "Dynamic linear models with Markov-switching", and for the density Koch (2000), "Fixed-
# interval retrodiction approach to Bayesian IMM-MHT for maneuvering multiple targets".


ROUNDING = 1e-12  # of a covariance in standard deviations


def condition_on_later(
    filter_: PageFilter, prior: Belief, states: list[int], x, p, inputs, later, later_cov
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare a mode's later states (B, n) with its filter's prediction from x (B, n) and P, and complete them.

    The belief of its prior, which takes longer to make than a prediction, lends all parts but x and P.

    Returns:
        The log densities (B,) of the mode's `states` in the prediction, without a constant.
        Means and covariances of all later states; those that the mode lacks are predicted, given the others.
    """
    levels, means, covs = np.empty(len(x)), later.copy(), later_cov.copy()
    rest = [i for i in range(x.shape[1]) if i not in states]
    for b in range(len(x)):
        predicted = filter_.predict(prior._replace(mean=x[b], cov=p[b]), inputs[b])
        scale = np.sqrt(np.diag(predicted.cov))
        scale = np.where(scale > 0.0, scale, 1.0)
        cov = predicted.cov / np.outer(scale, scale)
        off = (difference(later[b], predicted.mean, filter_.model.shape.state_angles) / scale)[states]
        near = cov[np.ix_(states, states)] + ROUNDING * np.eye(len(states))  # which may be singular
        levels[b] = -np.log(scale[states]).sum() - 0.5 * (
            np.linalg.slogdet(near)[1] + off @ np.linalg.solve(near, off)
        )
        if rest:
            slopes = np.linalg.solve(near, cov[np.ix_(states, rest)])
            known = (later_cov[b] / np.outer(scale, scale))[np.ix_(states, states)]
            means[b, rest] = predicted.mean[rest] + scale[rest] * (off @ slopes)
            joint = np.empty_like(cov)
            joint[np.ix_(states, states)], joint[np.ix_(states, rest)] = known, known @ slopes
            joint[np.ix_(rest, states)] = joint[np.ix_(states, rest)].T
            joint[np.ix_(rest, rest)] = cov[np.ix_(rest, rest)] + slopes.T @ (known - near) @ slopes
            covs[b] = joint * np.outer(scale, scale)
    return levels, means, covs


def complete(filter_: MultipleModelFilter, mu, means, covs) -> None:
    """Fill in states that modes lack, in means (B, M, n) and covariances, with mode probabilities mu (B, M)."""
    angles = filter_.model.shape.state_angles
    for group in filter_.absent_states:
        s, square = list(group.states), np.ix_(group.states, group.states)
        have = [k for k in range(mu.shape[1]) if k not in group.modes]
        total = mu[:, have].sum(axis=1)
        for b in np.flatnonzero((total > 0.0) | group.from_prior):
            if not group.from_prior:
                w = mu[b : b + 1, have] / total[b]
                mean, cov = (it[0] for it in merged(w, means[b : b + 1, have], covs[b : b + 1, have], angles))
            for k in group.modes:
                if group.from_prior:
                    mean, cov = filter_.mode_filters[k].model.prior_mean, filter_.mode_filters[k].model.prior_cov
                means[b, k, s] = mean[s]
                covs[b, k, s] = covs[b, k][:, s] = 0.0
                covs[b, k][square] = cov[square]


def weights_of(prior: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """The w (B, i, j) from log prior weights and densities; w_jj = 1 if no mode can lead to j."""
    levels = np.where(np.isfinite(prior) & np.isfinite(levels), prior + levels, -np.inf)
    top = levels.max(axis=1, keepdims=True)
    raw = np.exp(levels - np.where(np.isfinite(top), top, 0.0))
    total = raw.sum(axis=1, keepdims=True)
    return np.where(total > 0.0, raw / np.where(total > 0.0, total, 1.0), np.eye(prior.shape[1]))


def merged(weights, means, covs, angles) -> tuple[np.ndarray, np.ndarray]:
    """Mean (B, n) and covariance of mixtures (B, M), angles near the most probable part."""
    likely = np.take_along_axis(means, weights.argmax(axis=1)[:, None, None], axis=1)
    apart = difference(means, likely, angles)
    shift = np.einsum("bj,bjn->bn", weights, apart)
    rest = apart - shift[:, None]
    cov = np.einsum("bj,bjnm->bnm", weights, covs) + np.einsum("bj,bjn,bjm->bnm", weights, rest, rest)
    return wrapped_where(likely[:, 0] + shift, angles), 0.5 * (cov + np.swapaxes(cov, 1, 2))


def filtered(
    filter_: MultipleModelFilter, keys, inputs, z, step_filters: Sequence[MultipleModelFilter] | None = None
) -> tuple[np.ndarray, ...]:
    """Means (B, K + 1, M, n), covariances, log probabilities of the modes, full restarts, and numbers of restarts.

    A full restart, (B, K + 1) bool, is a step in which all modes restart; the number (B,) is that of the filter,
    which also counts restarts of single modes.
    """
    (count, times, _), n, modes = z.shape, filter_.model.n, len(filter_.mode_filters)
    means, covs = np.empty((count, times, modes, n)), np.empty((count, times, modes, n, n))
    logs, divergences = np.empty((count, times, modes)), np.zeros((count, times))
    session, prior = Session(filter_), filter_.mode_moments(filter_.init())
    for b in range(count):
        for k in range(times):
            if k:
                if step_filters is not None:
                    session.set_numbers(step_filters[k - 1].numbers)
                session.step(inputs[b, k - 1], z[b, k])
            else:
                session.start(keys[b], z[b, 0])
            means[b, k], covs[b, k], logs[b, k] = filter_.mode_moments(session.belief())
            divergences[b, k] = session.divergences
    more = np.diff(divergences, axis=1, prepend=divergences[:, :1]) > 0
    anew = (means == prior[0]).all((2, 3)) & (covs == prior[1]).all((2, 3, 4)) & (logs == prior[2]).all(2)
    return means, covs, logs, more & anew, divergences[:, -1]


class SmoothedModes(NamedTuple):
    """Estimates of B trajectories of K steps by a filter of M modes, given all measurements.

    Attributes:
        means: of the states, (B, K + 1, n), in the units of the model.
        covs: covariances of the errors, (B, K + 1, n, n).
        probabilities: of the modes, (B, K + 1, M).
    """

    means: np.ndarray
    covs: np.ndarray
    probabilities: np.ndarray


def smooth_modes(
    filter_: MultipleModelFilter,
    keys: np.ndarray | None = None,
    inputs: np.ndarray | None = None,
    measurements: np.ndarray | None = None,
) -> SmoothedModes:
    """Smooth the estimates of a filter of several models, and the probabilities of its modes.

    Args:
        filter_: "imm" or "mmae", whose modes have filters that `filters.smooth` takes.
        keys: as for `filters.smooth`, like the other arguments.
        inputs: u, (B, K, p).
        measurements: z, (B, K + 1, m), NaN where missing.

    Raises:
        ValueError: as `filters.smooth`.
    """
    estimates, divergences = smoothed_modes(filter_, keys, inputs, measurements)
    warn_of_restarts(filter_, divergences, keys, inputs, measurements)
    return estimates


def smoothed_modes(
    filter_: MultipleModelFilter,
    keys: np.ndarray | None,
    inputs: np.ndarray | None,
    measurements: np.ndarray | None,
    step_filters: Sequence[MultipleModelFilter] | None = None,
) -> tuple[SmoothedModes, np.ndarray]:
    """The result of `smooth_modes`, and the filter's restarts (B,) in the forward pass, without a warning."""
    refuse_rotations(filter_.model)
    keys, inputs, measurements = trajectories(filter_, keys, inputs, measurements)
    relations = [relation_of(filter_of_mode, "a mode of a smoother") for filter_of_mode in filter_.mode_filters]
    kinds: Any = filter_.mode_filters  # which have pages, as they have relations
    steps = [passes(kind, relation) for kind, relation in zip(kinds, relations, strict=True)]
    priors = [kind.init() for kind in kinds]
    means, covs, logs, restarted, divergences = filtered(filter_, keys, inputs, measurements, step_filters)
    mu, angles = np.exp(logs), filter_.model.shape.state_angles
    count, times, modes, n = means.shape
    absent = [
        {i for group in filter_.absent_states if j in group.modes for i in group.states} for j in range(modes)
    ]
    states_of_modes = [[i for i in range(n) if i not in lacking] for lacking in absent]
    estimates = SmoothedModes(np.empty((count, times, n)), np.empty((count, times, n, n)), mu.copy())
    x, p = means[:, -1], covs[:, -1]
    estimates.means[:, -1], estimates.covs[:, -1] = merged(mu[:, -1], x, p, angles)
    for k in reversed(range(times - 1)):
        pair_x, pair_p = np.empty((count, modes, modes, n)), np.empty((count, modes, modes, n, n))
        levels = np.empty((count, modes, modes))
        of_step = filter_ if step_filters is None else step_filters[k]
        kinds = of_step.mode_filters
        with np.errstate(divide="ignore"):
            log_transition = np.log(of_step.transition_matrix)
        anew = np.stack([np.zeros(count, bool), restarted[:, k + 1]], axis=1)
        for i, j in np.ndindex(modes, modes):
            begun = means[:, k, i], covs[:, k, i]
            levels[:, i, j], later, later_cov = condition_on_later(
                kinds[j], priors[j], states_of_modes[j], *begun, inputs[:, k], x[:, j], p[:, j]
            )
            ends = np.stack([begun[0], later], axis=1), np.stack([begun[1], later_cov], axis=1), anew
            corrected, cov = steps[j](ends, inputs[:, k : k + 1], 1, kinds[j].numbers[None])
            pair_x[:, i, j], pair_p[:, i, j] = corrected[:, 0], cov[:, 0]
        w = weights_of(log_transition + logs[:, k, :, None], levels)
        joint = w * estimates.probabilities[:, k + 1, None, :]  # of modes i at k and j at k + 1
        now = np.where(restarted[:, k + 1, None], mu[:, k], joint.sum(axis=2))
        of_i = joint.sum(axis=2, keepdims=True)
        shares = np.where(of_i > 0.0, joint / np.where(of_i > 0.0, of_i, 1.0), 1.0 / modes)
        of_modes = [merged(shares[:, i], pair_x[:, i], pair_p[:, i], angles) for i in range(modes)]
        x, p = (np.stack(part, axis=1) for part in zip(*of_modes, strict=True))
        complete(filter_, now, x, p)
        estimates.probabilities[:, k] = now
        estimates.means[:, k], estimates.covs[:, k] = merged(now, x, p, angles)
    return estimates, divergences


def smooth_ensembles(
    filter_: EnsembleFilter,
    keys: np.ndarray,
    inputs: np.ndarray,
    measurements: np.ndarray,
    earliest: np.ndarray,
    noise: tuple[np.ndarray, np.ndarray],
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means (B, K + 1, n) and covariances of an ensemble given some later measurements, and restarts (B,).

    The analysis of measurement k is repeated for each pair (x_k, x_l) of the members now and at an earlier step l
    >= earliest[k], with a state of twice the size whose first half is measured. So the members of step l get the
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
    refuse_rotations(filter_.model)
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
        smooth(now, pair, history, size, data, numbers, earliest, out, first, last)

    spread(part, count)
    return out


def _paired_model(model: StateSpaceModel) -> StateSpaceModel:
    """The model of a state (x_k, x_l): the first half moves and is measured, the second stays."""
    nothing = np.zeros((model.n, model.n))
    functions = model.functions
    transition, observe = _paired_functions(functions.transition, functions.observe, model.n, model.feeds)
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
def _paired_functions(transition: Callable, observe: Callable, n: int, feeds: bool) -> tuple[Callable, Callable]:
    now, past = (vector_part(n, 2 * n, first) for first in (0, n))
    names: dict[str, Any] = {"now": now, "past": past, "join": joiner(n, n)}
    moves = written_out("moves", "x, u, c", "join(f(now(x), u, c), past(x))", f=transition, **names)
    arguments = "u, c" if feeds else "c"
    return moves, written_out("observe", f"x, {arguments}", f"h(now(x), {arguments})", h=observe, now=now)


@lru_cache(maxsize=64)
def _smoother(kernels: Kernels, analyse_pair: Callable, interpreting: bool) -> Callable:
    n, m = kernels.n, kernels.m
    start, predict, update, restart = kernels.start, kernels.predict, kernels.update, restart_if_lost(kernels)
    layout, pair_offsets = memory_offsets(n, m), memory_offsets(2 * n, m)
    key_0, key_1, step, divergences = layout.key_0, layout.key_1, layout.step, layout.divergences
    pair_key_0, pair_key_1, pair_step = pair_offsets.key_0, pair_offsets.key_1, pair_offsets.step
    mean, cov, summarise = layout.mean, layout.cov, kernels.summarise
    feed, acting, pair_acting = len(kernels.acting), layout.extras, pair_offsets.extras
    q_offset, r_offset, pair_r_offset = number_offsets(n, m).q, number_offsets(n, m).r, number_offsets(2 * n, m).r

    def copy(target, at, source, first):
        for i in range(n):
            for j in range(target.shape[1]):
                target[at + i, j] = source[first + i, j]

    def smooth(now, pair, history, size, data, numbers, earliest, out, first, last):
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
                            own_parameters[q_offset + i] = qs[k - 1, i]
                    predict(now, u, own_parameters, size)
                else:
                    start(now, own_parameters, size)
                if rs.shape[0] > 0:
                    for i in range(rs.shape[1]):
                        own_parameters[r_offset + i] = pair_numbers[pair_r_offset + i] = rs[k, i]
                copy(forecast, 0, table, 0)
                update(now, z, own_parameters, size)
                restart(now, own_parameters, size)
                copy(history, k * n, table, 0)
                if row[divergences] > 0.0:
                    restarts[b] += 1.0
                    oldest, row[divergences] = k, 0.0
                pair_row[pair_step] = row[step]
                for i in range(feed):
                    pair_row[pair_acting + i] = row[acting + i]
                for past in range(max(oldest, int(earliest[k])), k):
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

    memory, squares = [(None,), (None, None), (None,)], ((None, 2 * n * n), (None, 2 * m * m))
    data = [(None, 2), (None, None, None), (None, None, m), *squares]
    out = [(None, None, n), (None, None, n, n), (None,)]
    from thruster_env.graphs.loops import Loops

    return Loops(smooth, (memory, memory, (None, None), None, data, [(None,), (None,)], (None,), out, None, None))


class Smoothed(NamedTuple):
    """Estimates of B trajectories of K steps; that of step k uses the measurements up to k + lag.

    Attributes:
        means: of the states, (B, K + 1, n), in the units of the model.
        covs: covariances of the errors, (B, K + 1, n, n).
    """

    means: np.ndarray
    covs: np.ndarray


def smoothed_rows(data: Prepared, lag: int | None) -> tuple[Smoothed, np.ndarray]:
    """`smoothed` at the rows of the user's measurements, which the lag counts."""
    rows = None if lag is None or len(data.rows) == data.measurements.shape[1] else data.rows
    arguments = data.keys, data.inputs, data.measurements
    estimates, divergences = smoothed(data.filter, *arguments, lag, rows=rows, **data.noise)
    return Smoothed(*(part[:, data.rows] for part in estimates)), divergences


def smoothed(
    filter_: Filter,
    keys: np.ndarray | None,
    inputs: np.ndarray | None,
    measurements: np.ndarray | None,
    lag: int | None = None,
    *,
    rows: np.ndarray | None = None,
    process_noise_covs: np.ndarray | None = None,
    measurement_noise_covs: np.ndarray | None = None,
    step_filters: Sequence[Filter] | None = None,
) -> tuple[Smoothed, np.ndarray]:
    """The result of `filters.smooth`, and the filter's restarts (B,) in the forward pass, without a warning.

    The lag counts `rows`, all if None; `step_filters` are those of `filters.engine.batch.run`.
    """
    keys, inputs, measurements = trajectories(filter_, keys, inputs, measurements)
    most = (inputs.shape[1] + 1 if rows is None else len(rows)) - 1
    lag = most if lag is None else min(at_least("lag", lag, 0), most)
    noise = noise_rows(filter_, inputs.shape[1] + 1, process_noise_covs, measurement_noise_covs, step_filters)
    if isinstance(filter_, EnsembleFilter):
        *smoothed_moments, divergences = smooth_ensembles(
            filter_, keys, inputs, measurements, earliest_rows(inputs.shape[1] + 1, lag, rows), noise
        )
        return Smoothed(*smoothed_moments), divergences
    if isinstance(filter_, MultipleModelFilter):
        if lag < most:
            raise ValueError(f"a filter of several models must be smoothed without a lag, but got {lag}")
        of_steps: Any = step_filters
        of_modes, divergences = smoothed_modes(filter_, keys, inputs, measurements, of_steps)
        return Smoothed(of_modes.means, of_modes.covs), divergences
    bounds, by = filter_.model.bounds, filter_.model.bounded_by
    if bounds:
        filter_ = dataclasses.replace(filter_, model=filter_.model.replace(bounds=()))
    relation = relation_of(filter_, "a smoother", ", imm, mmae or an ensemble Kalman filter")
    assert isinstance(filter_, PageFilter)
    covs = {"process_noise_covs": process_noise_covs, "measurement_noise_covs": measurement_noise_covs}
    estimates = run(filter_, keys, inputs, measurements, **covs, step_filters=step_filters)
    free = smooth_backwards(filter_, relation, estimates, inputs, lag, noise[0], rows)
    return Smoothed(*(constrained(*free, bounds, by) if bounds else free)), estimates.divergences


class WithSmoother:
    """A session, or the beliefs of all copies, that also estimates the state `lag` steps ago.

    After step k this is x_{max(k - lag, 0)} given the measurements up to k, in the first steps the initial state.
    The last lag + 1 estimates of the filter are kept, and each step makes one pass of the smoother of Rauch, Tung
    and Striebel over them. So the results equal those of `filters.smooth` with the same lag, at about `lag` times
    the cost of a filter step. Each step keeps the dt and Q that the session had.

    Source: Anderson, Moore (1979), Optimal Filtering, chapter 7, for the fixed lag.
    """

    def __init__(self, runs: Session | Beliefs, filter_: Filter, lag: int, count: int = 1):
        """Take the session or the beliefs, their filter and the lag, a whole number; `start` comes next.

        Raises ValueError for another lag, and a filter without a smoother of this kind.
        """
        self._runs, self._lag = runs, at_least("smoothing_lag", lag, 0)
        self._relation = relation_of(filter_, "a smoothing_lag")
        assert isinstance(filter_, PageFilter)
        self._filter = filter_
        n, t, model = filter_.model.n, filter_.model.t, filter_.kernel_model
        self._means, self._covs = np.zeros((count, lag + 1, n)), np.zeros((count, lag + 1, t, t))
        self._restarted = np.zeros((count, lag + 1), dtype=bool)
        self._inputs, self._age = np.zeros((count, lag, model.inputs)), np.zeros(count, dtype=int)
        self._numbers = self._first_numbers(lag)
        self._divergences = np.zeros(count)
        self._passes: Callable | None = None

    def __getstate__(self) -> dict:
        """All attributes except machine code, which is looked up again."""
        return vars(self) | {"_passes": None}

    def __setstate__(self, state: dict) -> None:
        vars(self).update(state)

    def __getattr__(self, name: str):
        """Return other attributes, such as the estimate, of the session or the beliefs."""
        if name.startswith("_"):
            raise AttributeError(name)
        return getattr(self._runs, name)

    def start(self, *arguments) -> None:
        """Start with a key and a measurement, or copies (which, keys, measurements)."""
        self._runs.start(*arguments)
        which = arguments[0] if len(arguments) == 3 else slice(None)
        mean, cov, divergences = self._estimate()
        # Earlier steps are not used; they get the first estimate, at which the model can be evaluated.
        self._means[which], self._covs[which] = mean[which, None], cov[which, None]
        self._inputs[which], self._restarted[which], self._age[which] = 0.0, False, 0
        self._divergences[which] = divergences[which]
        self._numbers, self._passes = self._first_numbers(self._lag), None

    def step(self, u, z, idle: np.ndarray | None = None) -> None:
        """Predict with u and update with z; NaN marks a missing channel."""
        self._runs.step(u, z, **({} if idle is None else {"idle": idle}))
        mean, cov, divergences = self._estimate()
        newest = (self._means, mean), (self._covs, cov), (self._restarted, divergences > self._divergences)
        for history, new in (*newest, (self._inputs, np.reshape(u, (len(mean), -1)))):
            if history.shape[1]:
                history[:, :-1] = history[:, 1:]
                history[:, -1] = new
        if isinstance(self._runs, Session) and len(self._numbers):
            self._numbers[:-1] = self._numbers[1:]
            self._numbers[-1] = self._runs.numbers
        self._divergences, self._age = divergences, np.minimum(self._age + 1, self._lag)

    def smoothed(self) -> tuple[np.ndarray, np.ndarray]:
        """Mean (n,) and covariance (n, n) of the state `lag` steps ago; for copies with a row for each."""
        if self._passes is None:
            self._passes = passes(self._filter, self._relation)
        estimates = self._means, self._covs, self._restarted
        oldest = np.arange(len(self._age)), self._lag - self._age
        means, covs = (part[oldest] for part in self._passes(estimates, self._inputs, self._lag, self._numbers))
        return (means[0], covs[0]) if isinstance(self._runs, Session) else (means, covs)

    def _first_numbers(self, lag: int) -> np.ndarray:
        """The filter's numbers; for a session, which may change them, a row for each step."""
        return np.repeat(self._filter.numbers[None], lag if isinstance(self._runs, Session) else 1, axis=0)

    def _estimate(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        runs = self._runs
        if isinstance(runs, Session):
            return runs.mean[None], runs.cov[None], np.array([float(runs.divergences)])
        n, t = self._means.shape[2], self._covs.shape[3]
        return runs.part("mean", n), runs.part("cov", t, t), runs.part("divergences")
