"""The smoother of filters for several models: each pair of successive modes by a step of Rauch, Tung, Striebel.

Backwards from the last step, of the filters' means x_i, covariances P_i and probabilities mu_i after step k,

    x_ij, P_ij = x_i, P_i, corrected by the smoothed x_j, P_j of step k + 1 with the model of mode j
    w_ij proportional to Pi_ij mu_i N(smoothed x_j; f_j(x_i), F_j P_i F_j' + Q_j), which sum to 1 over i:
           the probability of mode i at k, if that at k + 1 is j
    smoothed mu_i = sum over j of w_ij (smoothed mu_j);  x_i, P_i those of the mixture of all x_ij

What parts the modes i that lead to j is in the smoothed P_j, and again between the x_ij: P is on the safe side.

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
from filters.smoothers.relations import relation_of
from filters.smoothers.rts import passes
from thruster_env.numerics.angles import difference, wrapped_where

ROUNDING = 1e-12  # of a covariance in standard deviations


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
    keys, inputs, measurements = trajectories(filter_, keys, inputs, measurements)
    if filter_.absent_states:
        lacked = ", ".join(filter_.model.states[i].symbol for one in filter_.absent_states for i in one.states)
        raise ValueError(f"a smoother needs modes that have all states of the model, but some lack {lacked}")
    relations = [relation_of(one, "a mode of a smoother") for one in filter_.mode_filters]
    kinds = [one for one in filter_.mode_filters if isinstance(one, PageFilter)]
    steps = [passes(one, relation) for one, relation in zip(kinds, relations, strict=True)]
    means, covs, mu, restarted = _filtered(filter_, keys, inputs, measurements)
    angles, transition = filter_.model.shape.state_angles, filter_.transition_matrix
    count, times, modes, n = means.shape
    found = SmoothedModes(np.empty((count, times, n)), np.empty((count, times, n, n)), mu.copy())
    x, p = means[:, -1], covs[:, -1]
    found.means[:, -1], found.covs[:, -1] = _merged(mu[:, -1], x, p, angles)
    for k in reversed(range(times - 1)):
        pair_x, pair_p = np.empty((count, modes, modes, n)), np.empty((count, modes, modes, n, n))
        levels = np.empty((count, modes, modes))
        anew = np.stack([np.zeros(count, bool), restarted[:, k + 1]], axis=1)
        for i, j in np.ndindex(modes, modes):
            ends = np.stack([means[:, k, i], x[:, j]], axis=1), np.stack([covs[:, k, i], p[:, j]], axis=1), anew
            corrected, cov = steps[j](ends, inputs[:, k : k + 1], 1)
            pair_x[:, i, j], pair_p[:, i, j] = corrected[:, 0], cov[:, 0]
            levels[:, i, j] = _levels(kinds[j], means[:, k, i], covs[:, k, i], inputs[:, k], x[:, j])
        w = _weights(transition * mu[:, k, :, None], levels)
        joint = w * found.probabilities[:, k + 1, None, :]  # of modes i at k and j at k + 1
        now = np.where(restarted[:, k + 1, None], mu[:, k], joint.sum(axis=2))
        of_i = joint.sum(axis=2, keepdims=True)
        shares = np.where(of_i > 0.0, joint / np.where(of_i > 0.0, of_i, 1.0), 1.0 / modes)
        merged = [_merged(shares[:, i], pair_x[:, i], pair_p[:, i], angles) for i in range(modes)]
        x, p = (np.stack(part, axis=1) for part in zip(*merged, strict=True))
        found.probabilities[:, k] = now
        found.means[:, k], found.covs[:, k] = _merged(now, x, p, angles)
    return found


def _levels(filter_: PageFilter, x, p, inputs, later) -> np.ndarray:
    """Log densities (B,) of later states by what a filter predicts of x (B, n) and P, but for a constant."""
    found, begun = np.empty(len(x)), filter_.init()
    for b in range(len(x)):
        predicted = filter_.predict(begun._replace(mean=x[b], cov=p[b]), inputs[b])
        scale = np.sqrt(np.diag(predicted.cov))
        scale = np.where(scale > 0.0, scale, 1.0)
        off = difference(later[b], predicted.mean, filter_.model.shape.state_angles) / scale
        near = predicted.cov / np.outer(scale, scale) + ROUNDING * np.eye(len(off))  # which may be singular
        found[b] = -np.log(scale).sum() - 0.5 * (np.linalg.slogdet(near)[1] + off @ np.linalg.solve(near, off))
    return found


def _weights(prior: np.ndarray, levels: np.ndarray) -> np.ndarray:
    """The w (B, i, j) of prior weights and log densities; where none is possible each mode follows from itself."""
    levels = np.where((prior > 0.0) & np.isfinite(levels), levels, -np.inf)
    top = levels.max(axis=1, keepdims=True)
    raw = prior * np.exp(levels - np.where(np.isfinite(top), top, 0.0))
    total = raw.sum(axis=1, keepdims=True)
    return np.where(total > 0.0, raw / np.where(total > 0.0, total, 1.0), np.eye(prior.shape[1]))


def _filtered(filter_: MultipleModelFilter, keys, inputs, z) -> tuple[np.ndarray, ...]:
    """Means (B, K + 1, M, n), covariances, probabilities of the modes, and which steps are restarts."""
    (count, times, _), n, modes = z.shape, filter_.model.n, len(filter_.mode_filters)
    means, covs = np.empty((count, times, modes, n)), np.empty((count, times, modes, n, n))
    mu, divergences = np.empty((count, times, modes)), np.zeros((count, times))
    session = Session(filter_)
    for b in range(count):
        for k in range(times):
            if k:
                session.step(inputs[b, k - 1], z[b, k])
            else:
                session.start(keys[b], z[b, 0])
            means[b, k], covs[b, k], mu[b, k] = filter_.mode_estimates(session.belief())
            divergences[b, k] = session.divergences
    return means, covs, mu, np.diff(divergences, axis=1, prepend=divergences[:, :1]) > 0


def _merged(weights, means, covs, angles) -> tuple[np.ndarray, np.ndarray]:
    """Mean (B, n) and covariance of mixtures (B, M), angles near the most probable part."""
    likely = np.take_along_axis(means, weights.argmax(axis=1)[:, None, None], axis=1)
    apart = difference(means, likely, angles)
    shift = np.einsum("bj,bjn->bn", weights, apart)
    rest = apart - shift[:, None]
    cov = np.einsum("bj,bjnm->bnm", weights, covs) + np.einsum("bj,bjn,bjm->bnm", weights, rest, rest)
    return wrapped_where(likely[:, 0] + shift, angles), 0.5 * (cov + np.swapaxes(cov, 1, 2))
