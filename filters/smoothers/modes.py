"""The smoother of filters for several models: each pair of successive modes by a step of Rauch, Tung, Striebel.

Backwards from the last step, of the filters' means x_i, covariances P_i and probabilities mu_i after step k,

    x_ij, P_ij = x_i, P_i, corrected by the smoothed x_j, P_j of step k + 1 with the model of mode j
    w_ij proportional to Pi_ij mu_i N(smoothed x_j; f_j(x_i), F_j P_i F_j' + Q_j), which sum to 1 over i:
           the probability of mode i at k, if that at k + 1 is j
    smoothed mu_i = sum over j of w_ij (smoothed mu_j);  x_i, P_i those of the mixture of all x_ij

The differences between modes i that lead to j count in the smoothed P_j, and again between the x_ij, so P is
rather too large. The smoothed x_j has no states that mode j lacks: their prediction from x_i, given the other
states, replaces them. After each step a mode gets them from modes that have them (`filters.gaussian.absent`).

Source: Kim (1994), "Dynamic linear models with Markov-switching", and for the density Koch (2000), "Fixed-interval
retrodiction approach to Bayesian IMM-MHT for maneuvering multiple targets".
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from filters.engine.batch import trajectories
from filters.engine.session import Session
from filters.gaussian.multiple_models import MultipleModelFilter
from filters.pages.page_filter import PageFilter
from filters.smoothers.rts import passes, relation_of
from filters.starts import warn_of_restarts
from thruster_env.core.angles import difference, wrapped_where

ROUNDING = 1e-12  # of a covariance in standard deviations


def condition_on_later(
    filter_: PageFilter, states: list[int], x, p, inputs, later, later_cov
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Compare a mode's later states (B, n) with its filter's prediction from x (B, n) and P, and complete them.

    Returns:
        The log densities (B,) of the mode's `states` in the prediction, without a constant.
        Means and covariances of all later states; those that the mode lacks are predicted, given the others.
    """
    levels, means, covs, begun = np.empty(len(x)), later.copy(), later_cov.copy(), filter_.init()
    rest = [i for i in range(x.shape[1]) if i not in states]
    for b in range(len(x)):
        predicted = filter_.predict(begun._replace(mean=x[b], cov=p[b]), inputs[b])
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


def filtered(filter_: MultipleModelFilter, keys, inputs, z) -> tuple[np.ndarray, ...]:
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
) -> tuple[SmoothedModes, np.ndarray]:
    """The result of `smooth_modes`, and the filter's restarts (B,) in the forward pass, without a warning."""
    keys, inputs, measurements = trajectories(filter_, keys, inputs, measurements)
    relations = [relation_of(filter_of_mode, "a mode of a smoother") for filter_of_mode in filter_.mode_filters]
    kinds = [filter_of_mode for filter_of_mode in filter_.mode_filters if isinstance(filter_of_mode, PageFilter)]
    steps = [passes(filter_of_mode, relation) for filter_of_mode, relation in zip(kinds, relations, strict=True)]
    means, covs, logs, restarted, divergences = filtered(filter_, keys, inputs, measurements)
    mu, angles = np.exp(logs), filter_.model.shape.state_angles
    with np.errstate(divide="ignore"):
        log_transition = np.log(filter_.transition_matrix)
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
        anew = np.stack([np.zeros(count, bool), restarted[:, k + 1]], axis=1)
        for i, j in np.ndindex(modes, modes):
            begun = means[:, k, i], covs[:, k, i]
            levels[:, i, j], later, later_cov = condition_on_later(
                kinds[j], states_of_modes[j], *begun, inputs[:, k], x[:, j], p[:, j]
            )
            ends = np.stack([begun[0], later], axis=1), np.stack([begun[1], later_cov], axis=1), anew
            corrected, cov = steps[j](ends, inputs[:, k : k + 1], 1)
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
