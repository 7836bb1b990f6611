"""All checks of a filter's honesty in one typed report, from estimates and truth."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import Interval, mean_interval
from filters.consistency.nees import SquaresCheck, check_squares
from filters.consistency.scores import (
    LEVELS,
    covered,
    ensemble_crps,
    ensemble_ranks,
    expected_gaussian_crps,
    gaussian_crps,
)
from filters.consistency.uniformity import Uniformity, uniformity
from filters.consistency.whiteness import LAGS, Whiteness, whiteness
from filters.engine.batch import Estimates
from filters.ensembles.recording import Members
from numerics.angles import difference, is_angle, wrapped


class EnsembleCheck(NamedTuple):
    """What the members of an ensemble say, by state."""

    size: int  # number of members
    ranks: tuple[Uniformity, ...]  # of the truth among the members
    crps: tuple[Interval, ...]  # mean CRPS of the members as a distribution, in the state's unit


class ConsistencyReport(NamedTuple):
    """How honest a filter was over B runs of T steps; NaN where it gives no covariance."""

    runs: int
    first_step: int  # the first that counts
    states: tuple[str, ...]  # names, with units
    nees: SquaresCheck
    nis: SquaresCheck
    whiteness: Whiteness
    coverage: tuple[Interval, ...]  # share of each state's errors within 1.96 standard deviations; 0.95 is right
    coverage_by_level: np.ndarray  # (levels, n), of intervals of the levels `filters.consistency.scores.LEVELS`
    crps: tuple[Interval, ...]  # mean CRPS of each state's Gaussian, in its unit
    crps_expected: np.ndarray  # (n,), what it would be if the covariances were right
    crps_ratio: np.ndarray  # (T, n), mean CRPS over runs in units of that expectation, step by step
    divergences: int  # restarts from the prior
    diverged_runs: int  # runs with any
    ensemble: EnsembleCheck | None  # where members were given


def consistency_report(
    estimates: Estimates,
    states: np.ndarray,
    measurements: np.ndarray | None = None,
    *,
    members: Members | None = None,
    first_step: int = 0,
    names: Sequence[str] | None = None,
    lags: int = LAGS,
    angles: Sequence[bool] = (),
) -> ConsistencyReport:
    """Hold a filter's estimates against the truth.

    Args:
        estimates: of B runs, from `filters.run`.
        states: the truth, (B, K + 1, n).
        measurements: (B, K + 1, m); needed only where some are missing (NaN).
        members: of the first of these runs, for ensembles, from `filters.ensembles.recording.record_members`.
        first_step: steps before it are start-up and do not count.
        names: of the states, with units.
        lags: of the innovations' correlation.
        angles: (n,), which states are angles, as the filter's `model.shape.state_angles`; none if empty.

    Raises:
        ValueError: if shapes do not fit or there is only one run.
    """
    if np.shape(states) != estimates.means.shape or len(states) < 2:
        raise ValueError(
            f"states must have the shape of the estimates, {estimates.means.shape}, with at least two runs, "
            f"but got {np.shape(states)}"
        )
    n, late = states.shape[-1], slice(first_step, None)
    names = tuple(names or (f"state {i + 1}" for i in range(n)))
    if len(names) != n:
        raise ValueError(f"names must be {n}, one a state, but got {names!r}")
    errors, covs = difference(estimates.means, states, angles)[:, late], estimates.covs[:, late]
    innovations, innovation_covs = estimates.innovations[:, late], estimates.innovation_covs[:, late]
    present = None if measurements is None else ~np.isnan(measurements[:, late])
    variances = np.einsum("bkii->bki", covs)
    deviations = np.sqrt(np.where(variances > 0, variances, np.nan))
    crps = np.where(deviations > 0, gaussian_crps(errors, deviations), np.nan)
    expected = expected_gaussian_crps(deviations)
    return ConsistencyReport(
        runs=len(states),
        first_step=first_step,
        states=names,
        nees=check_squares("NEES", errors, covs),
        nis=check_squares("NIS", innovations, innovation_covs, present),
        whiteness=whiteness(innovations, innovation_covs, present, lags),
        coverage=tuple(mean_interval(covered(errors[..., i], deviations[..., i])) for i in range(n)),
        coverage_by_level=np.array([_mean(covered(errors, deviations, level), (0, 1)) for level in LEVELS]),
        crps=tuple(mean_interval(crps[..., i]) for i in range(n)),
        crps_expected=_mean(expected, (0, 1)),
        crps_ratio=_mean(crps, 0) / _mean(expected, 0),
        divergences=int(estimates.divergences.sum()),
        diverged_runs=int((estimates.divergences > 0).sum()),
        ensemble=None if members is None else check_ensemble(members, states, angles),
    )


def check_ensemble(members: Members, states: np.ndarray, angles: Sequence[bool] = ()) -> EnsembleCheck:
    """Hold ensembles of the first runs against the truth of all, (B, K + 1, n); angles the short way round."""
    truth, size = states[: len(members.members), members.steps], members.members.shape[-1]

    def near(i):
        values, middle = members.members[..., i, :], truth[..., i, None]
        return middle + wrapped(values - middle) if is_angle(i, angles) else values

    parts = [(truth[..., i], near(i), members.weights) for i in range(states.shape[-1])]
    return EnsembleCheck(
        size,
        tuple(uniformity(ensemble_ranks(*part), steps=size + 1) for part in parts),
        tuple(mean_interval(ensemble_crps(*part)) for part in parts),
    )


def _mean(values: np.ndarray, axes) -> np.ndarray:
    """Mean of the entries that are not NaN; NaN where there is none."""
    counts = (~np.isnan(values)).sum(axis=axes)
    return np.where(counts > 0, np.nansum(values, axis=axes) / np.maximum(counts, 1), np.nan)
