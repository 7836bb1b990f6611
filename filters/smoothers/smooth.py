"""Smoothers: estimates of each state from measurements of later steps as well as from earlier ones."""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np

from filters.engine.batch import noise_rows, run, trajectories
from filters.engine.bounded import constrained
from filters.ensembles.ensemble import EnsembleFilter
from filters.filter import Filter
from filters.gaussian.multiple_models import MultipleModelFilter
from filters.pages.page_filter import PageFilter
from filters.smoothers.ensemble import smooth_ensembles
from filters.smoothers.modes import smoothed_modes
from filters.smoothers.points import relation_of
from filters.smoothers.rts import smooth_backwards
from filters.starts import warn_of_restarts
from thruster_env.core.checks import at_least


class Smoothed(NamedTuple):
    """Estimates of B trajectories of K steps; that of step k uses the measurements up to k + lag.

    Attributes:
        means: of the states, (B, K + 1, n), in the units of the model.
        covs: covariances of the errors, (B, K + 1, n, n).
    """

    means: np.ndarray
    covs: np.ndarray


def smooth(
    filter_: Filter,
    keys: np.ndarray | None = None,
    inputs: np.ndarray | None = None,
    measurements: np.ndarray | None = None,
    lag: int | None = None,
    *,
    process_noise_covs: np.ndarray | None = None,
    measurement_noise_covs: np.ndarray | None = None,
) -> Smoothed:
    """Filter trajectories forwards and correct the estimates by later measurements.

    - Kalman filters, also scheduled, extended or iterated extended, unscented and cubature Kalman filters: the
      recursion of Rauch, Tung and Striebel backwards, on the filter's own linearisation or sigma points.
    - Filters of several models: `smooth_modes`, which also returns the probabilities of the modes; without a lag.
    - Ensemble Kalman filters of all kinds: the smoother of Evensen and van Leeuwen. Each update moves the members
      of earlier steps, too. Each adds its sampling error, so that a small ensemble gains by a short lag only.

    The recursion backwards, with both covariances given the measurements up to k, is

        G_k = cov(x_k, x_{k+1}) cov(x_{k+1})^-1,   mean_k += G_k (smoothed mean_{k+1} - predicted mean_{k+1}),
        P_k += G_k (smoothed P_{k+1} - predicted P_{k+1}) G_k'

    The recursion runs without bounds on states, like the filter's; its estimates are constrained at the end, by
    truncation or projection.

    With lag = 0 the result is the filter's own. The full smoother of an ensemble takes K/2 updates per step, so
    give it a lag of the length of the system's memory.

    Args:
        filter_: a filter of one of these types.
        keys: random keys, one a trajectory, (B, 2); those of seeds 0, 1, ..., B - 1 if None.
        inputs: u, (B, K, p), in the units of the model's inputs; None for a model without inputs.
        measurements: z, (B, K + 1, m), in the units of the model's measurements, NaN where missing.
        lag: number of later measurements that each estimate uses (fixed-lag smoothing); all of them if None.
        process_noise_covs: Q of every step, (K, n, n), in place of the model's, as `filters.run` takes it.
        measurement_noise_covs: R of every measurement, (K + 1, m, m), likewise.

    Returns:
        `Smoothed`, which does not depend on the number of cores; a `RestartWarning` if the filter restarted.

    Raises:
        ValueError: if shapes do not fit, an input is not finite, or there is no smoother for the filter.

    Source: Rauch, Tung, Striebel (1965), "Maximum likelihood estimates of linear dynamic systems"; Sarkka (2008),
    "Unscented Rauch-Tung-Striebel smoother"; Evensen, van Leeuwen (2000), "An ensemble Kalman smoother for
    nonlinear dynamics"; fixed lag: Anderson, Moore (1979), Optimal Filtering, chapter 7.
    """
    covs = {"process_noise_covs": process_noise_covs, "measurement_noise_covs": measurement_noise_covs}
    estimates, divergences = smoothed(filter_, keys, inputs, measurements, lag, **covs)
    warn_of_restarts(filter_, divergences, keys, inputs, measurements, **covs)
    return estimates


def smoothed(
    filter_: Filter,
    keys: np.ndarray | None,
    inputs: np.ndarray | None,
    measurements: np.ndarray | None,
    lag: int | None = None,
    *,
    process_noise_covs: np.ndarray | None = None,
    measurement_noise_covs: np.ndarray | None = None,
) -> tuple[Smoothed, np.ndarray]:
    """The result of `smooth`, and the filter's restarts (B,) in the forward pass, without a warning."""
    keys, inputs, measurements = trajectories(filter_, keys, inputs, measurements)
    steps = inputs.shape[1]
    lag = steps if lag is None else min(at_least("lag", lag, 0), steps)
    noise = noise_rows(filter_, steps + 1, process_noise_covs, measurement_noise_covs)
    if isinstance(filter_, EnsembleFilter):
        *smoothed_moments, divergences = smooth_ensembles(filter_, keys, inputs, measurements, lag, noise)
        return Smoothed(*smoothed_moments), divergences
    if isinstance(filter_, MultipleModelFilter):
        if lag < steps:
            raise ValueError(f"a filter of several models must be smoothed without a lag, but got {lag}")
        of_modes, divergences = smoothed_modes(filter_, keys, inputs, measurements)
        return Smoothed(of_modes.means, of_modes.covs), divergences
    bounds, by = filter_.model.bounds, filter_.model.bounded_by
    if bounds:
        filter_ = dataclasses.replace(filter_, model=filter_.model.replace(bounds=()))
    relation = relation_of(filter_, "a smoother", ", imm, mmae or an ensemble Kalman filter")
    assert isinstance(filter_, PageFilter)
    covs = {"process_noise_covs": process_noise_covs, "measurement_noise_covs": measurement_noise_covs}
    estimates = run(filter_, keys, inputs, measurements, **covs)
    free = smooth_backwards(filter_, relation, estimates, inputs, lag, noise[0])
    return Smoothed(*(constrained(*free, bounds, by) if bounds else free)), estimates.divergences
