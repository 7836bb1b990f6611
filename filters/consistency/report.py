"""All checks of a filter's consistency in one report, from estimates and, if it is known, the truth.

In order: the report; remedies for symptoms in the innovations that no Q and R can cure; and sentences, each a
function of the numbers that it states.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.nees import (
    FEWEST_RUNS,
    LAGS,
    LEVELS,
    POSITIVE,
    SHARE,
    Interval,
    SquaresCheck,
    Uniformity,
    Whiteness,
    check_whitened,
    covered,
    ensemble_crps,
    ensemble_ranks,
    gaussian_crps,
    mean_interval,
    uniformity,
    whitened,
    whiteness_of,
)
from filters.engine.batch import Estimates
from filters.ensembles.square_root import Members
from thruster_env.core.angles import difference, is_angle, wrapped

# Of symptoms.
HEAVY = 6.0  # kurtosis of innovations; of Laplace's distribution
STUCK = 40  # equal readings in a row, beyond what a quantised sensor at rest gives for long

# Of sentences.
SLIGHT_FACTOR = 1.2  # a mean NEES or NIS this close to the right one is off by little
SLIGHT_DISTANCE = 0.02  # so are distributions this close
SLIGHT_CORRELATION = 0.05  # and correlations this small
SIGNIFICANT = 0.05
NEVER = ("dt", "time_step")  # constants that are no quantity of the plant
EVEN = "even, as far as these runs show"
MOST_CONSTANTS = 8  # of a model, that are named
MOST_STATES = 6  # that get a sentence
NO_TRUTH = "These data have no truth: the following is based on the innovations alone."


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
    coverage_by_level: np.ndarray  # (levels, n), of intervals of the levels `filters.consistency.nees.LEVELS`
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
    blown: str = ""  # what `nees.blow_up_sentence` says of the model


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
    late, (n, t) = slice(first_step, None), (estimates.means.shape[-1], estimates.covs.shape[-1])
    if n != t:
        rule = "estimates must have a variance of each state, which rotations have not"
        raise ValueError(f"{rule}, but got {t} for {n}: docs/attitude.md has the errors to compare with P")
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
        members: of the first of these runs, for ensembles, from `filters.ensembles.square_root.record_members`.
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
    expected = deviations / np.sqrt(np.pi)  # if the deviations are right
    return ConsistencyReport(
        runs=len(errors),
        first_step=first_step,
        states=names,
        nees=check_whitened("NEES", whitened_errors),
        nis=check_whitened("NIS", whitened_innovations, present),
        whiteness=_whiteness(whitened_innovations, present, lags),
        coverage=tuple(mean_interval(covered(errors[..., i], deviations[..., i]), within=SHARE) for i in range(n)),
        coverage_by_level=np.array([_mean(covered(errors, deviations, level), (0, 1)) for level in LEVELS]),
        crps=tuple(mean_interval(crps[..., i], within=POSITIVE) for i in range(n)),
        crps_expected=_mean(expected, (0, 1)),
        crps_ratio=_mean(crps, 0) / _mean(expected, 0),
        tails=_kurtosis(whitened_innovations, present),
        repeats=() if result.repeats is None else tuple(result.repeats.max(axis=0).tolist()),
        divergences=int(result.divergences.sum()),
        diverged_runs=int((result.divergences > 0).sum()),
        ensemble=None if members is None or states is None else check_ensemble(members, states, angles),
        channels=channels,
        innovation_coverage=tuple(
            mean_interval(covered(measured[..., j], expected_deviations[..., j]), within=SHARE) for j in range(m)
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
        tuple(mean_interval(ensemble_crps(*part), within=POSITIVE) for part in parts),
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


def symptoms(report: ConsistencyReport) -> list[str]:
    """A remedy for each symptom of a report, without a full stop."""
    remedies = []
    stuck = [name for name, longest in zip(report.channels, report.repeats, strict=False) if longest >= STUCK]
    if stuck:
        remedies.append(
            f"look at {', '.join(stuck)}, which has {max(report.repeats)} equal readings in a row: a stuck "
            "sensor does not measure; replace its readings by NaN"
        )
    elif any(kurtosis > HEAVY for kurtosis in report.tails):
        remedies.append(
            "a filter that models outliers, `--filter ekf-robust`, because innovations have heavy tails "
            f"(kurtosis {max(report.tails):.3g} where 3 is normal); `thruster identify --gate` leaves them "
            "out"
        )
    if report.divergences:
        remedies.append("more substeps of the model, or a smaller sample time, because estimates blow up")
    return remedies


def sentences(report: ConsistencyReport) -> list[str]:
    """A report in sentences, one per check, a remedy last; of many states those with the worst coverage."""
    parts = [] if report.has_truth else [NO_TRUTH]
    for check in (report.nees, report.nis) if report.has_truth else (report.nis,):
        parts.append(squares_sentence(check, report.runs))
        if not np.isnan(check.mean.value):
            parts.append(distribution_sentence(check))
    parts.append(whiteness_sentence(report.whiteness, report.channels))
    if report.has_truth:
        parts += _state_sentences(report)
    else:
        pairs = zip(report.channels, report.innovation_coverage, strict=True)
        parts += [coverage_sentence(f"the expected {name}", part, "the measurement") for name, part in pairs]
    parts.append(divergence_sentence(report.divergences, report.diverged_runs, report.runs))
    parts.append(remedy_sentence(report))
    return [sentence for sentence in parts if sentence]


def _state_sentences(report: ConsistencyReport) -> list[str]:
    ensemble, n = report.ensemble, len(report.states)
    off = [-abs(part.value - 0.95) for part in report.coverage]
    worst = sorted(sorted(range(n), key=off.__getitem__)[:MOST_STATES])
    parts = []
    for i in worst:
        of_members = None if ensemble is None else ensemble.crps[i]
        parts.append(coverage_sentence(report.states[i], report.coverage[i]))
        parts.append(crps_sentence(report.states[i], report.crps[i], report.crps_expected[i], of_members))
    if n > MOST_STATES and not np.isnan(off).all():
        parts.append(
            f"Of {n} states these are the {MOST_STATES} whose coverage is furthest off; that of the others lies "
            f"within {100 * sorted(-part for part in off)[-MOST_STATES - 1]:.2g} percentage points of 95 %."
        )
    if ensemble is not None:
        parts += [ranks_sentence(report.states[i], ensemble.ranks[i], ensemble.size) for i in worst]
    return parts


def confidence(mean: Interval, dimension: float) -> str:
    """In a word or two: is a filter with this mean NEES or NIS overconfident?"""
    if mean.covers(dimension):
        return "consistent"
    ratio = mean.value / dimension
    word = "overconfident" if ratio > 1 else "underconfident"
    return f"slightly {word}" if 1 / SLIGHT_FACTOR < ratio < SLIGHT_FACTOR else word


def mean_sentence(name: str, mean: Interval, dimension: float) -> str:
    """The verdict of a mean NEES or NIS on the covariance."""
    if np.isnan(mean.value):
        return f"No {name}: the filter gives no covariance, or a singular one."
    return f"{confidence(mean, dimension).capitalize()}: mean {name} {span(mean)} where {dimension:.3g} is right."


def squares_sentence(check: SquaresCheck, runs: int) -> str:
    """The mean NEES or NIS, and how many steps lie in their band."""
    sentence = mean_sentence(check.name, check.mean, check.dimension)
    if np.isnan(check.mean.value):
        return sentence
    low, high = np.nanmedian(check.band, axis=0)
    return (
        f"{sentence[:-1]}; the mean of {runs} runs lies in its 95 % band, about [{low:.3g}, {high:.3g}], "
        f"in {100 * check.share_inside:.0f} % of the steps."
    )


def distribution_sentence(check: SquaresCheck) -> str:
    """Whether all values together are distributed as they should be."""
    if _alike(check.distribution):
        verdict = "is that of chi-square, as far as these runs show"
    elif check.distribution.distance < SLIGHT_DISTANCE:
        verdict = "is close to chi-square"
    else:
        verdict = "is not that of chi-square"
    return (
        f"The distribution of {check.name} {verdict}: {100 * check.beyond.value:.1f} % of the values lie beyond "
        f"its 95 % point ({_test(check.distribution)})."
    )


def whiteness_sentence(whiteness: Whiteness, channels: Sequence[str] = ()) -> str:
    """Whether innovations are white, else the likely cause; `channels` names the measurements."""
    if whiteness.statistic == 0:
        return "No test of whiteness: the filter gives no innovation covariance, or nothing was measured."
    largest_at = np.unravel_index(np.argmax(np.abs(whiteness.correlations)), whiteness.correlations.shape)
    lag, i, j = (int(index) for index in largest_at)
    largest = whiteness.correlations[lag, i, j]
    after = "from one step to the next" if lag == 0 else f"over {lag + 1} steps"
    channels = channels or [f"channel {index + 1}" for index in range(whiteness.correlations.shape[1])]
    of = "" if len(channels) == 1 else f", of {channels[i]} with {channels[j]}"
    share, width = 100 * whiteness.share_inside, np.median(whiteness.half_widths)
    numbers = (
        f"the largest correlation is {largest:+.2g} {after}{of}; {share:.0f} % of them lie within "
        f"±{width:.2g}, where 95 % do by chance ({probability_text(whiteness.p_value)})"
    )
    if whiteness.p_value >= SIGNIFICANT:
        return f"Innovations are white, as far as these runs show: {numbers}."
    if abs(largest) < SLIGHT_CORRELATION:
        return f"Innovations are nearly white: {numbers}."
    if largest > 0:
        return f"Innovations are not white, the filter follows too slowly or its model is wrong: {numbers}."
    return f"Innovations are not white, the filter follows the noise: {numbers}."


def coverage_sentence(name: str, coverage: Interval, contained: str = "the truth") -> str:
    """Whether a 95 % interval contains the truth, or a measurement, as often as stated."""
    if np.isnan(coverage.value):
        return ""
    low, value, high = 100 * coverage.low, 100 * coverage.value, 100 * coverage.high
    amiss = "too rarely" if value < 95 else "more often than stated"
    return (
        f"The 95 % interval of {name} contains {contained} in {value:.1f} % [{low:.1f}, {high:.1f}] of cases: "
        f"{'as it should' if coverage.covers(0.95) else amiss}."
    )


def crps_sentence(name: str, crps: Interval, expected: float, of_members: Interval | None = None) -> str:
    """A state's CRPS, also relative to its expectation under the covariance."""
    if np.isnan(crps.value):
        return ""
    members = "" if of_members is None else f"; that of the members themselves is {span(of_members)}"
    return (
        f"CRPS of {name}: {span(crps)}, {crps.value / expected:.3g} times its expected value under the "
        f"covariance{members}."
    )


def ranks_sentence(name: str, ranks: Uniformity, size: int) -> str:
    """Where the truth stands among the members of an ensemble."""
    low, high = ranks.frequencies[0], ranks.frequencies[-1]
    return (
        f"Ranks of the truth among the {size} members, {name}: {ranks_verdict(ranks)}; the outermost bars of the "
        f"histogram are {low:.2g} and {high:.2g} times the expected height ({_test(ranks)})."
    )


def ranks_verdict(ranks: Uniformity) -> str:
    """In a few words: do the members lie where the truth may be?

    The outermost bars have a check of their own, because the test of the distribution is hardly sensitive to them.
    """
    (first_low, first_high), (last_low, last_high) = ranks.frequency_band[[0, -1]]
    if min(first_low, last_low) > 1:
        return "too often outermost, because the members are too close together"
    if max(first_high, last_high) < 1:
        return "too rarely outermost, because the members are too far apart"
    if _alike(ranks):
        return EVEN
    return "lopsided, for the members lie too " + (
        "high" if ranks.frequencies[0] > ranks.frequencies[-1] else "low"
    )


def divergence_sentence(divergences: int, diverged_runs: int, runs: int) -> str:
    """How often a filter diverged."""
    if divergences == 0:
        return "No run diverged."
    return f"{diverged_runs} of {runs} runs diverged and restarted from the prior, {divergences} times in all."


def remedy_sentence(report: ConsistencyReport) -> str:
    """What to try: from NIS and the innovations' correlation, else from NEES; empty if nothing needs to be done.

    If the model blows up between samples, that is the only remedy: no Q and R mend it.

    Source: Mehra (1970), "On the identification of variances and adaptive Kalman filtering": with too small a gain
    innovations are correlated positively, with too large a gain negatively.
    """
    nees, nis = report.nees, report.nis
    if report.blown:
        return report.blown
    if np.isnan(nis.mean.value):
        return ""
    over = nis.mean.value > SLIGHT_FACTOR * nis.dimension
    under = nis.mean.value < nis.dimension / SLIGHT_FACTOR
    next_step = np.diagonal(report.whiteness.correlations[0])
    strongest = next_step[np.argmax(np.abs(next_step))]
    slow, quick = strongest > SLIGHT_CORRELATION, strongest < -SLIGHT_CORRELATION
    word = "consistent" if np.isnan(nees.mean.value) else confidence(nees.mean, nees.dimension)
    white = is_white(report.whiteness)
    lasting = "overconfident" in word and not white and not quick
    if over:
        what = "raise Q, or repair the model" if slow else "raise R" if quick else "raise Q and R alike"
    elif under:
        what = "lower R" if slow else "lower Q" if quick else "lower Q and R alike"
    elif slow or quick:
        what = "raise Q and lower R, or repair the model" if slow else "lower Q and raise R"
    elif "overconfident" in word and _ranks_are_right(report):
        what = "more members; their ranks are right, but their covariance is a rough estimate"
    elif word == "overconfident":
        what = "raise Q where nothing is measured, or repair the model there"
        what += "; the innovations are consistent" if white else ""
    elif word == "underconfident":
        what = "lower Q where nothing is measured" + ("; the innovations are consistent" if white else "")
    else:
        what = ""
    remedies = symptoms(report)
    if lasting and not remedies:
        second = _augment(report.constants) if estimable(report.constants) else "repair the model"
        first = what or "raise Q"
        if second not in first:
            what = f"{first}; or {second}" if over or under or slow else f"{second}; or {first}"
    tried = "; ".join([*remedies, *([what] if what else [])])
    return f"To try: {tried}." if tried else ""


def is_white(whiteness: Whiteness) -> bool:
    """Whether innovations are white as far as the runs show, or were not tested: no sentence says otherwise."""
    return whiteness.statistic == 0 or bool(whiteness.p_value >= SIGNIFICANT)


def estimable(constants: Sequence[str]) -> list[str]:
    """The constants of a model that may be estimated as states: all but the sample time."""
    return [name for name in constants if name not in NEVER]


def _augment(constants: Sequence[str]) -> str:
    """Advice for a model whose errors last: make a constant that may be off a state."""
    constants = estimable(constants)
    names = ", ".join(constants[:MOST_CONSTANTS])
    more = f" and {len(constants) - MOST_CONSTANTS} more" if len(constants) > MOST_CONSTANTS else ""
    return (
        f"estimate a constant of the model that may be off (it has {names}{more}) as a further state, with "
        "`thruster compare --augment NAME` or `filters.augmented_model`"
    )


def _ranks_are_right(report: ConsistencyReport) -> bool:
    return report.ensemble is not None and all(ranks_verdict(ranks) == EVEN for ranks in report.ensemble.ranks)


def _alike(check: Uniformity) -> bool:
    return check.p_value >= SIGNIFICANT if not np.isnan(check.p_value) else check.distance < SLIGHT_DISTANCE


def _test(check: Uniformity) -> str:
    if np.isnan(check.p_value):
        return f"distance {check.distance:.2g}; a test takes {FEWEST_RUNS} runs"
    return f"distance {check.distance:.2g}, {probability_text(check.p_value)}"


def probability_text(p: float) -> str:
    """A p-value as text."""
    return "p < 0.001" if p < 0.001 else f"p = {p:.2g}"


def rounded(value: float) -> str:
    """A number to three digits."""
    return f"{value:.0f}" if 1000 <= abs(value) < 1e6 else f"{value:.3g}"


def span(value: Interval) -> str:
    """An interval as text: its value, and the ends in brackets."""
    return f"{rounded(value.value)} [{rounded(value.low)}, {rounded(value.high)}]"
