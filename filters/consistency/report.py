"""All checks of a filter's consistency in one report, from estimates and, where it is known, the truth.

NEES is the normalised estimation error squared, NIS the normalised innovation squared, CRPS the continuous ranked
probability score.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.intervals import (
    LEVELS,
    Interval,
    Uniformity,
    covered,
    ensemble_crps,
    ensemble_ranks,
    expected_gaussian_crps,
    gaussian_crps,
    mean_interval,
    uniformity,
)
from filters.consistency.nees import LAGS, SquaresCheck, Whiteness, check_whitened, whitened, whiteness_of
from filters.engine.batch import Estimates
from filters.ensembles.rank_histogram import Members
from thruster_env.core.angles import difference, is_angle, wrapped


class EnsembleCheck(NamedTuple):
    """Ranks and CRPS of the members of an ensemble, by state."""

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
    coverage_by_level: np.ndarray  # (levels, n), of intervals of the levels `filters.consistency.intervals.LEVELS`
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
    tails: tuple[float, ...] = ()  # kurtosis of each channel's whitened innovations; 3 of normal ones
    repeats: tuple[int, ...] = ()  # longest stretch of equal readings of each channel; empty if unknown
    constants: tuple[str, ...] = ()  # names of the model's constants, which may be estimated as states
    blown: str = ""  # what `blow_up.blow_up_sentence` says of the model


class Residuals(NamedTuple):
    """Errors or innovations of B runs over T steps that count, with the filter's expectation."""

    values: np.ndarray  # (B, T, d)
    whitened: np.ndarray  # (B, T, d), as `filters.consistency.nees.whitened`
    deviations: np.ndarray  # (B, T, d), expected standard deviations


class Findings(NamedTuple):
    """The inputs of a `ConsistencyReport`, without the covariances of every step."""

    errors: Residuals
    innovations: Residuals
    present: np.ndarray | None  # (B, T, m), which measurements were there; None for all
    divergences: np.ndarray  # (B,), restarts from the prior
    repeats: np.ndarray | None = None  # (B, m), longest stretch of equal readings


def findings(
    estimates: Estimates,
    states: np.ndarray | None,
    measurements: np.ndarray | None,
    first_step: int = 0,
    angles: Sequence[bool] = (),
    counted: np.ndarray | None = None,
) -> Findings:
    """Errors and innovations of a filter's estimates; arguments are those of `consistency_report`."""
    late = slice(first_step, None)
    truth = np.full(estimates.means.shape, np.nan) if states is None else states
    errors = difference(estimates.means, truth, angles)[:, late]
    mask = None if counted is None else counted[:, late]
    present = None if measurements is None else ~np.isnan(measurements[:, late])
    if mask is not None:
        everything = np.ones(estimates.innovations[:, late].shape, dtype=bool)
        present = (everything if present is None else present) & mask[..., None]
    return Findings(
        _residuals(errors, estimates.covs[:, late], mask),
        _residuals(estimates.innovations[:, late], estimates.innovation_covs[:, late], mask),
        present,
        estimates.divergences,
        None if measurements is None else longest_stretches(_mask_padding(measurements, counted)[:, late]),
    )


def _mask_padding(measurements: np.ndarray, counted: np.ndarray | None) -> np.ndarray:
    """Measurements (B, K + 1, m), NaN after each run's last step that counts."""
    if counted is None:
        return measurements
    exists = np.logical_or.accumulate(counted[:, ::-1], axis=1)[:, ::-1]
    return np.where(exists[..., None], measurements, np.nan)


def longest_stretches(measurements: np.ndarray) -> np.ndarray:
    """Number of steps of the longest stretch of equal readings of each run and channel, (B, m) of (B, T, m)."""
    longest = current = np.ones((len(measurements), measurements.shape[-1]), dtype=int)
    for k in range(1, measurements.shape[1]):
        current = np.where(measurements[:, k] == measurements[:, k - 1], current + 1, 1)
        longest = np.maximum(longest, current)
    return longest


def joined(parts: Sequence[Findings]) -> Findings:
    """Findings of all runs, from parts in their order."""
    present = [part.present for part in parts if part.present is not None]
    return Findings(
        Residuals(*map(np.concatenate, zip(*(part.errors for part in parts), strict=True))),
        Residuals(*map(np.concatenate, zip(*(part.innovations for part in parts), strict=True))),
        np.concatenate(present) if present else None,
        np.concatenate([part.divergences for part in parts]),
        None if any(part.repeats is None for part in parts) else np.concatenate([part.repeats for part in parts]),
    )


def _residuals(values: np.ndarray, covs: np.ndarray, mask: np.ndarray | None) -> Residuals:
    """Residuals of all steps; NaN where the mask (B, T) is false."""
    residuals = Residuals(values, whitened(values, covs), _deviations(covs))
    if mask is None:
        return residuals
    return Residuals(*(np.where(mask[..., None], array, np.nan) for array in residuals))


def consistency_report(
    estimates: Estimates,
    states: np.ndarray | None,
    measurements: np.ndarray | None = None,
    *,
    first_step: int = 0,
    angles: Sequence[bool] = (),
    counted: np.ndarray | None = None,
    **options,
) -> ConsistencyReport:
    """Compare a filter's estimates with the truth, and its innovations with their expected covariance.

    Args:
        estimates: of B runs, from `filters.run`.
        states: the truth, (B, K + 1, n); None where it is not known.
        measurements: (B, K + 1, m); needed only where some are missing (NaN).
        first_step: first step that counts; steps before it are start-up.
        angles: (n,), which states are angles, as the filter's `model.shape.state_angles`; none if empty.
        counted: (B, K + 1) bool, which steps count, of runs of different lengths or with a truth here and there;
            all if None.
        **options: members, names, channels and lags, as `report_of` takes them.

    Raises:
        ValueError: if shapes do not fit or there is only one run.
    """
    if states is not None and np.shape(states) != estimates.means.shape:
        rule = f"states must have the shape of the estimates, {estimates.means.shape}"
        raise ValueError(f"{rule}, but got {np.shape(states)}")
    result = findings(estimates, states, measurements, first_step, angles, counted)
    if states is not None and counted is not None:
        states = np.where(counted[..., None], states, np.nan)
    return report_of(result, states, first_step=first_step, angles=angles, **options)


def report_of(
    result: Findings,
    states: np.ndarray | None,
    *,
    members: Members | None = None,
    first_step: int = 0,
    names: Sequence[str] | None = None,
    angles: Sequence[bool] = (),
    channels: Sequence[str] | None = None,
    lags: int = LAGS,
) -> ConsistencyReport:
    """The report of findings; other arguments and errors are those of `consistency_report`.

    Args:
        result: findings of all runs, at least two.
        states: the truth, (B, K + 1, n); None where it is not known.
        members: of the first of these runs, for ensembles, from `filters.ensembles.rank_histogram.record_members`.
        first_step: the first that counts.
        names: of the states, with units.
        angles: (n,), which states are angles.
        channels: names of the measurements, with units.
        lags: of the innovations' correlation; of fewer steps, one less than the steps.
    """
    errors, whitened_errors, deviations = result.errors
    innovations, whitened_innovations, expected_deviations = result.innovations
    if len(errors) < 2:
        raise ValueError(f"a consistency report must have at least two runs, but got {len(errors)}")
    n, m, present = errors.shape[-1], innovations.shape[-1], result.present
    names = _component_names("names", names, n, "state")
    channels = _component_names("channels", channels, m, "channel")
    measured = innovations if present is None else np.where(present, innovations, np.nan)
    crps = np.where(deviations > 0, gaussian_crps(errors, deviations), np.nan)
    expected = expected_gaussian_crps(deviations)
    return ConsistencyReport(
        runs=len(errors),
        first_step=first_step,
        states=names,
        nees=check_whitened("NEES", whitened_errors),
        nis=check_whitened("NIS", whitened_innovations, present),
        whiteness=_whiteness(whitened_innovations, present, lags),
        coverage=tuple(mean_interval(covered(errors[..., i], deviations[..., i])) for i in range(n)),
        coverage_by_level=np.array([_mean(covered(errors, deviations, level), (0, 1)) for level in LEVELS]),
        crps=tuple(mean_interval(crps[..., i]) for i in range(n)),
        crps_expected=_mean(expected, (0, 1)),
        crps_ratio=_mean(crps, 0) / _mean(expected, 0),
        tails=_kurtosis(whitened_innovations, present),
        repeats=() if result.repeats is None else tuple(result.repeats.max(axis=0).tolist()),
        divergences=int(result.divergences.sum()),
        diverged_runs=int((result.divergences > 0).sum()),
        ensemble=None if members is None or states is None else check_ensemble(members, states, angles),
        channels=channels,
        innovation_coverage=tuple(
            mean_interval(covered(measured[..., j], expected_deviations[..., j])) for j in range(m)
        ),
        innovation_coverage_by_level=np.array(
            [_mean(covered(measured, expected_deviations, level), (0, 1)) for level in LEVELS]
        ),
        has_truth=states is not None,
    )


def _whiteness(e: np.ndarray, present: np.ndarray | None, lags: int) -> Whiteness:
    """`whiteness_of` with fewer lags where there are not more steps; of a single step it says nothing."""
    if e.shape[1] == 1:
        return whiteness_of(np.full((len(e), 2, e.shape[-1]), np.nan), lags=1)
    return whiteness_of(e, present, min(lags, e.shape[1] - 1))


def check_ensemble(members: Members, states: np.ndarray, angles: Sequence[bool] = ()) -> EnsembleCheck:
    """Compare ensembles of the first runs with the truth of all, (B, K + 1, n); angles are wrapped."""
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


def _component_names(rule: str, names: Sequence[str] | None, count: int, kind: str) -> tuple[str, ...]:
    names = tuple(names or (f"{kind} {i + 1}" for i in range(count)))
    if len(names) != count:
        raise ValueError(f"{rule} must be {count}, one a {kind}, but got {names!r}")
    return names


def _deviations(covs: np.ndarray) -> np.ndarray:
    variances = np.einsum("bkii->bki", covs)
    return np.sqrt(np.where(variances > 0, variances, np.nan))


def _mean(values: np.ndarray, axes) -> np.ndarray:
    counts = (~np.isnan(values)).sum(axis=axes)
    return np.where(counts > 0, np.nansum(values, axis=axes) / np.maximum(counts, 1), np.nan)


def _kurtosis(whitened_ones: np.ndarray, present: np.ndarray | None) -> tuple[float, ...]:
    """E v^4 / (E v^2)^2 of each channel's whitened innovations (B, T, m), NaN without any."""
    measured = whitened_ones if present is None else np.where(present, whitened_ones, np.nan)
    with np.errstate(all="ignore"):
        fourth, second = (_mean(measured**power, (0, 1)) for power in (4, 2))
        return tuple((fourth / second**2).tolist())
