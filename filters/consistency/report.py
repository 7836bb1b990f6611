"""All checks of a filter's consistency in one typed report, from estimates and, where it is known, the truth."""

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
    """How consistent a filter was over B runs of T steps; NaN without covariance or truth."""

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
    channels: tuple[str, ...]  # names of the measurements, with units
    innovation_coverage: tuple[Interval, ...]  # share of each channel's innovations within 1.96 deviations of S
    innovation_coverage_by_level: np.ndarray  # (levels, m)
    has_truth: bool  # without it only the innovations are looked at


def consistency_report(
    estimates: Estimates,
    states: np.ndarray | None,
    measurements: np.ndarray | None = None,
    *,
    members: Members | None = None,
    first_step: int = 0,
    names: Sequence[str] | None = None,
    angles: Sequence[bool] = (),
    channels: Sequence[str] | None = None,
    lags: int = LAGS,
) -> ConsistencyReport:
    """Hold a filter's estimates against the truth, and its innovations against what it expected of them.

    Args:
        estimates: of B runs, from `filters.run`.
        states: the truth, (B, K + 1, n); None where it is not known.
        measurements: (B, K + 1, m); needed only where some are missing (NaN).
        members: of the first of these runs, for ensembles, from `filters.ensembles.recording.record_members`.
        first_step: steps before it are start-up and do not count.
        names: of the states, with units.
        angles: (n,), which states are angles, as the filter's `model.shape.state_angles`; none if empty.
        channels: names of the measurements, with units.
        lags: of the innovations' correlation.

    Raises:
        ValueError: if shapes do not fit or there is only one run.
    """
    if (states is not None and np.shape(states) != estimates.means.shape) or len(estimates.means) < 2:
        raise ValueError(
            f"states must have the shape of the estimates, {estimates.means.shape}, with at least two runs, "
            f"but got {np.shape(states if states is not None else estimates.means)}"
        )
    n, m, late = estimates.means.shape[-1], estimates.innovations.shape[-1], slice(first_step, None)
    names = _named("names", names, n, "state")
    channels = _named("channels", channels, m, "channel")
    truth = np.full(estimates.means.shape, np.nan) if states is None else states
    errors, covs = difference(estimates.means, truth, angles)[:, late], estimates.covs[:, late]
    innovations, innovation_covs = estimates.innovations[:, late], estimates.innovation_covs[:, late]
    present = None if measurements is None else ~np.isnan(measurements[:, late])
    deviations, expected_deviations = _deviations(covs), _deviations(innovation_covs)
    seen = innovations if present is None else np.where(present, innovations, np.nan)
    crps = np.where(deviations > 0, gaussian_crps(errors, deviations), np.nan)
    expected = expected_gaussian_crps(deviations)
    return ConsistencyReport(
        runs=len(errors),
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
        ensemble=None if members is None or states is None else check_ensemble(members, states, angles),
        channels=channels,
        innovation_coverage=tuple(
            mean_interval(covered(seen[..., j], expected_deviations[..., j])) for j in range(m)
        ),
        innovation_coverage_by_level=np.array(
            [_mean(covered(seen, expected_deviations, level), (0, 1)) for level in LEVELS]
        ),
        has_truth=states is not None,
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


def _named(rule: str, names: Sequence[str] | None, count: int, kind: str) -> tuple[str, ...]:
    """Names of so many components, numbered where there are none; ValueError if there are more or fewer."""
    names = tuple(names or (f"{kind} {i + 1}" for i in range(count)))
    if len(names) != count:
        raise ValueError(f"{rule} must be {count}, one a {kind}, but got {names!r}")
    return names


def _deviations(covs: np.ndarray) -> np.ndarray:
    """Standard deviations (B, T, d) of covariances (B, T, d, d); NaN where a variance is not positive."""
    variances = np.einsum("bkii->bki", covs)
    return np.sqrt(np.where(variances > 0, variances, np.nan))


def _mean(values: np.ndarray, axes) -> np.ndarray:
    """Mean of the entries that are not NaN; NaN where there is none."""
    counts = (~np.isnan(values)).sum(axis=axes)
    return np.where(counts > 0, np.nansum(values, axis=axes) / np.maximum(counts, 1), np.nan)
