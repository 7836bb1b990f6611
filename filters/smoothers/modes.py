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
from filters.gaussian.multiple_models import MultipleModelFilter
from filters.pages.page_filter import PageFilter
from filters.restarts import warn_of_restarts
from filters.smoothers.backwards import passes
from filters.smoothers.mode_steps import complete, filtered, merged, told, weights_of
from filters.smoothers.relations import relation_of


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
