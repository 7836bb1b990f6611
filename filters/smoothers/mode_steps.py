"""What the smoother of filters for several models does in a step: what later states tell, weights, mixtures."""

from __future__ import annotations

import numpy as np

from filters.engine.session import Session
from filters.gaussian.multiple_models import MultipleModelFilter
from filters.pages.page_filter import PageFilter
from thruster_env.core.angles import difference, wrapped_where

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
