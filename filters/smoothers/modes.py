"""The smoother of filters for several models: each pair of successive modes by a step of Rauch, Tung, Striebel.

Backwards from the last step, of the filters' means x_i, covariances P_i and probabilities mu_i after step k,

    x_ij, P_ij = x_i, P_i, corrected by the smoothed x_j, P_j of step k + 1 with the model of mode j
    w_ij proportional to Pi_ij mu_i N(smoothed x_j; f_j(x_i), F_j P_i F_j' + Q_j), which sum to 1 over i:
           the probability of mode i at k, if that at k + 1 is j
    smoothed mu_i = sum over j of w_ij (smoothed mu_j);  x_i, P_i those of the mixture of all x_ij

What parts the modes i that lead to j is in the smoothed P_j, and again between the x_ij: P is on the safe side.
Of states that mode j lacks its smoothed x_j tells nothing: their place takes what the prediction from x_i says of
them, given the others. After each step a mode has them from those that know them (`filters.gaussian.absent`).

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
from filters.smoothers.points import relation_of
from filters.smoothers.rts import passes
from filters.starts import warn_of_restarts
from thruster_env.core.angles import difference, wrapped_where

# What the smoother of filters for several models does in a step: what later states tell, weights, mixtures.


ROUNDING = 1e-12  # of a covariance in standard deviations


def told(
    filter_: PageFilter, own: list[int], x, p, inputs, later, later_cov
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """What the later states (B, n) of a mode, of which some are its own, tell of x (B, n) and P.

    Returns:
        The log densities (B,) of its own states by what its filter predicts, but for a constant.
        Means and covariances of all later states, of which the others follow from these by the prediction.
    """
    levels, means, covs, begun = np.empty(len(x)), later.copy(), later_cov.copy(), filter_.init()
    rest = [i for i in range(x.shape[1]) if i not in own]
    for b in range(len(x)):
        predicted = filter_.predict(begun._replace(mean=x[b], cov=p[b]), inputs[b])
        scale = np.sqrt(np.diag(predicted.cov))
        scale = np.where(scale > 0.0, scale, 1.0)
        cov = predicted.cov / np.outer(scale, scale)
        off = (difference(later[b], predicted.mean, filter_.model.shape.state_angles) / scale)[own]
        near = cov[np.ix_(own, own)] + ROUNDING * np.eye(len(own))  # which may be singular
        levels[b] = -np.log(scale[own]).sum() - 0.5 * (
            np.linalg.slogdet(near)[1] + off @ np.linalg.solve(near, off)
        )
        if rest:
            slopes = np.linalg.solve(near, cov[np.ix_(own, rest)])
            known = (later_cov[b] / np.outer(scale, scale))[np.ix_(own, own)]
            means[b, rest] = predicted.mean[rest] + scale[rest] * (off @ slopes)
            joint = np.empty_like(cov)
            joint[np.ix_(own, own)], joint[np.ix_(own, rest)] = known, known @ slopes
            joint[np.ix_(rest, own)] = joint[np.ix_(own, rest)].T
            joint[np.ix_(rest, rest)] = cov[np.ix_(rest, rest)] + slopes.T @ (known - near) @ slopes
            covs[b] = joint * np.outer(scale, scale)
    return levels, means, covs


def complete(filter_: MultipleModelFilter, mu, means, covs) -> None:
    """Give the modes, of probabilities (B, M), what they lack: in means (B, M, n) and covariances."""
    angles = filter_.model.shape.state_angles
    for one in filter_.absent_states:
        s, square = list(one.states), np.ix_(one.states, one.states)
        have = [k for k in range(mu.shape[1]) if k not in one.modes]
        total = mu[:, have].sum(axis=1)
        for b in np.flatnonzero((total > 0.0) | one.given):
            if not one.given:
                w = mu[b : b + 1, have] / total[b]
                mean, cov = (it[0] for it in merged(w, means[b : b + 1, have], covs[b : b + 1, have], angles))
            for k in one.modes:
                if one.given:
                    mean, cov = filter_.mode_filters[k].model.prior_mean, filter_.mode_filters[k].model.prior_cov
                means[b, k, s] = mean[s]
                covs[b, k, s] = covs[b, k][:, s] = 0.0
                covs[b, k][square] = cov[square]


def weights_of(prior: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """The w (B, i, j) of log prior weights and densities; where none is possible each mode follows from itself."""
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
    """Means (B, K + 1, M, n), covariances, log probabilities of the modes, restarts of all, and their number.

    A step in which all modes begin anew is such a restart, (B, K + 1) bool; the number (B,) is that of the filter,
    which counts a mode that begins anew alone, too.
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
        keys: those of `filters.smooth`, and so are the others.
        inputs: u, (B, K, p).
        measurements: z, (B, K + 1, m), NaN where missing.

    Raises:
        ValueError: as `filters.smooth`.
    """
    found, divergences = smoothed_modes(filter_, keys, inputs, measurements)
    warn_of_restarts(filter_, divergences, keys, inputs, measurements)
    return found


def smoothed_modes(
    filter_: MultipleModelFilter,
    keys: np.ndarray | None,
    inputs: np.ndarray | None,
    measurements: np.ndarray | None,
) -> tuple[SmoothedModes, np.ndarray]:
    """What `smooth_modes` gives, and the filter's restarts on the way forwards, (B,), without a warning."""
    keys, inputs, measurements = trajectories(filter_, keys, inputs, measurements)
    relations = [relation_of(one, "a mode of a smoother") for one in filter_.mode_filters]
    kinds = [one for one in filter_.mode_filters if isinstance(one, PageFilter)]
    steps = [passes(one, relation) for one, relation in zip(kinds, relations, strict=True)]
    means, covs, logs, restarted, divergences = filtered(filter_, keys, inputs, measurements)
    mu, angles = np.exp(logs), filter_.model.shape.state_angles
    with np.errstate(divide="ignore"):
        log_transition = np.log(filter_.transition_matrix)
    count, times, modes, n = means.shape
    absent = [{i for one in filter_.absent_states if j in one.modes for i in one.states} for j in range(modes)]
    own = [[i for i in range(n) if i not in some] for some in absent]
    found = SmoothedModes(np.empty((count, times, n)), np.empty((count, times, n, n)), mu.copy())
    x, p = means[:, -1], covs[:, -1]
    found.means[:, -1], found.covs[:, -1] = merged(mu[:, -1], x, p, angles)
    for k in reversed(range(times - 1)):
        pair_x, pair_p = np.empty((count, modes, modes, n)), np.empty((count, modes, modes, n, n))
        levels = np.empty((count, modes, modes))
        anew = np.stack([np.zeros(count, bool), restarted[:, k + 1]], axis=1)
        for i, j in np.ndindex(modes, modes):
            begun = means[:, k, i], covs[:, k, i]
            levels[:, i, j], later, later_cov = told(kinds[j], own[j], *begun, inputs[:, k], x[:, j], p[:, j])
            ends = np.stack([begun[0], later], axis=1), np.stack([begun[1], later_cov], axis=1), anew
            corrected, cov = steps[j](ends, inputs[:, k : k + 1], 1)
            pair_x[:, i, j], pair_p[:, i, j] = corrected[:, 0], cov[:, 0]
        w = weights_of(log_transition + logs[:, k, :, None], levels)
        joint = w * found.probabilities[:, k + 1, None, :]  # of modes i at k and j at k + 1
        now = np.where(restarted[:, k + 1, None], mu[:, k], joint.sum(axis=2))
        of_i = joint.sum(axis=2, keepdims=True)
        shares = np.where(of_i > 0.0, joint / np.where(of_i > 0.0, of_i, 1.0), 1.0 / modes)
        of_modes = [merged(shares[:, i], pair_x[:, i], pair_p[:, i], angles) for i in range(modes)]
        x, p = (np.stack(part, axis=1) for part in zip(*of_modes, strict=True))
        complete(filter_, now, x, p)
        found.probabilities[:, k] = now
        found.means[:, k], found.covs[:, k] = merged(now, x, p, angles)
    return found, divergences
