"""Findings in a recorded run that affect the trust in results from it.

They are gaps; rows that were moved, dropped or doubled; inputs without samples; sensors that are stuck or
saturated; samples that are no measurements; outliers and bursts of them; axes or units of inertial sensors that
differ; and the way times were read, if the file does not state it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from thruster_env.core.angles import difference
from thruster_env.logs.imu import of_inertial_sensors
from thruster_env.logs.times import date_text, time_text

if TYPE_CHECKING:
    from thruster_env.logs.log import Log

GAP, MISSING, MOVED, DROPPED, DOUBLED = "gap", "missing rows", "moved", "dropped", "doubled"
STUCK, SATURATED, OUTLIER = "stuck", "saturated", "outlier"
WRAPPED = "wrapped"  # a measured angle
PLACEHOLDER, REPEATED = "placeholder", "repeated"  # samples that are no measurements, and are left out
DAMAGED = "damaged"  # the file: of its messages some are not read
CLOCK, OUTSIDE, STALE = "clock", "outside", "no input"
MISALIGNED, QUATERNION = "axes or units", "quaternion"
SPOILING = (GAP, STALE, STUCK, SATURATED, OUTLIER)  # what moves estimates
OUTLIERS = ("kept", "missing")  # whether a study takes them as measurements or leaves them out
LEVEL = 1e-4
SHORTEST = 8  # samples: a run of equal ones that is worth a word
COMMON = 0.1  # of neighbours that are equal: the channel is quantised
RUNS = 3
CHANGES = 20  # of a channel, at least, from which the rate of a slower sensor is seen
TURNS = {"deg": 360.0, "rad": 2.0 * np.pi}
SPANNED, CLOSED = 0.75, 1.000001  # share of a turn that samples of an angle that wraps span
ACROSS = 0.25  # share of a turn that their steps across its end have at most
SELDOM = 0.25  # share of a channel's samples that a placeholder may have
REPEATS, UNLIKE = 0.6, 0.9  # most new samples in all of a slower sensor, and fewest values in its new samples
SINGLE, MOSTLY = 1.5, 0.9  # resolutions of a single step, and share of such steps in a quantised channel
OFTENER = 4.0
SPIKE, ALONE = 7.0, 2.0
AROUND = 25  # samples before and after, whose differences tell the noise, too
NORMAL = 1.4826  # standard deviation over the median of magnitudes
BURST, APART = 4, 10  # samples of a burst, at least, and the distance of two of them, at most
WILDER = 4.0  # mean size of its steps over the noise before and after it
LONGEST = 0.1  # share of a channel's samples that a burst may have
BESIDE = 0.1  # of an input's range: a larger change explains a peak of the sensor
LISTED = 3  # findings of one kind and channel that are said one by one


class Remark(NamedTuple):
    """A finding in a whole file."""

    kind: str
    channel: str  # such as "input:V_s"; empty for all
    sentence: str  # in words, without a full stop


class Recording(NamedTuple):
    """What became of a file's rows on the grid."""

    gaps: tuple[tuple[int, int], ...] = ()  # first row and number of rows that are missing, where a run is cut
    missing: int = 0  # other rows without any sample
    holes: int = 0  # in so many places
    shifted: int = 0  # samples whose stamps were further from the grid than a tenth of a step
    farthest: float = 0.0  # [s], of them
    jitter: float = 0.0  # [s], the furthest that any stamp is from the grid
    doubled: int = 0  # rows with the stamp of the row before
    dropped: tuple[tuple[str, int], ...] = ()  # samples of a channel beside a nearer one of the same grid time
    damage: tuple[str, ...] = ()  # what of the file is not read because it is damaged, in words
    remarks: tuple[Remark, ...] = ()  # how the file was read
    turns: tuple[tuple[str, float], ...] = ()  # measured angles to which whole turns were added, and a turn


@dataclass(frozen=True)
class Finding:
    """One thing that was found in a log.

    Attributes:
        kind: "damaged", "clock", "outside", "no input", "gap", "missing rows", "moved", "dropped", "doubled",
            "stuck", "saturated", "outlier", "placeholder", "repeated", "wrapped", "axes or
            units" or "quaternion".
        channel: such as "measurement:thrust"; empty for all of a row.
        first: row of the log where it begins; 0 if it is everywhere.
        last: row where it ends, included.
        count: rows or samples that it is about.
        sentence: in words, without a full stop.
    """

    kind: str
    channel: str
    first: int
    last: int
    count: int
    sentence: str


def found_in(log: Log) -> tuple[Finding, ...]:
    """All findings in a log, of its rows first, then channel by channel."""
    findings = [*_of_rows(log)]
    findings += [Finding(MISALIGNED, "", 0, log.steps, 1, text) for text in of_inertial_sensors(log)]
    for channel, quantity in enumerate(log.measured):
        findings += _of_channel(log, channel, f"measurement:{quantity.symbol}")
    return tuple(findings)


def sentences(findings: Sequence[Finding]) -> list[str]:
    """The findings as sentences; for many of one kind and channel the longest, and their number."""
    texts: list[str] = []
    groups: dict[tuple[str, str], list[Finding]] = {}
    for finding in findings:
        groups.setdefault((finding.kind, finding.channel), []).append(finding)
    for group in groups.values():
        if len(group) <= LISTED:
            texts += [f"{finding.sentence}." for finding in group]
            continue
        longest = max(group, key=lambda finding: finding.count)
        more = f" (the longest of {len(group)}, {sum(finding.count for finding in group)} rows in all)"
        texts.append(f"{longest.sentence}{more}.")
    return texts


def remarks_on(logs: Sequence[Log]) -> list[str]:
    """The findings in logs as sentences; for a piece those in the log it was cut from.

    Each begins with the name of its log; findings of one kind in several logs are one sentence, on the longest.
    """
    uncut = {log.name: log for log in (log.uncut or log for log in logs)}
    groups: dict[tuple[str, str], dict[str, list[Finding]]] = {}
    for name, log in uncut.items():
        for finding in log.findings:
            groups.setdefault((finding.kind, finding.channel), {}).setdefault(name, []).append(finding)
    texts: list[str] = []
    for of_logs in groups.values():
        name, findings = max(of_logs.items(), key=lambda item: max(finding.count for finding in item[1]))
        if len(of_logs) == 1:
            texts += [f"{name}: {text}" for text in sentences(findings)]
            continue
        longest = max(findings, key=lambda finding: finding.count)
        count = sum(map(len, of_logs.values()))
        rows = sum(finding.count for group in of_logs.values() for finding in group)
        more = f"the longest of {count} in {len(of_logs)} logs, {rows} rows in all"
        texts.append(f"{name}: {longest.sentence} ({more}).")
    return texts


def has_outliers(logs: Sequence[Log]) -> bool:
    """Whether any of the logs has outliers."""
    return any(finding.kind == OUTLIER for log in logs for finding in (log.uncut or log).findings)


def _of_rows(log: Log) -> list[Finding]:
    recording, last = log.recording, log.steps
    findings = [Finding(DAMAGED, "", 0, last, 1, text) for text in recording.damage]
    findings += [Finding(kind, channel, 0, last, last + 1, text) for kind, channel, text in recording.remarks]
    for first, count in recording.gaps:
        text = f"a gap: {count} rows ({count * log.dt:.4g} s) are missing{_where(log, first, first + count - 1)}"
        findings.append(Finding(GAP, "", first, first + count - 1, count, text))
    if recording.missing:
        holes = f"{recording.holes} place{'' if recording.holes == 1 else 's'}"
        are = "row is" if recording.missing == 1 else "rows are"
        inputs = "; the input is held there" * (log.inputs.shape[1] > 0)
        text = f"{recording.missing} of {last + 1} {are} missing, in {holes}{inputs}"
        findings.append(Finding(MISSING, "", 0, last, recording.missing, text))
    if recording.doubled:
        rows = "row has" if recording.doubled == 1 else "rows have"
        rule = "of two samples of a channel the last is used"
        text = f"{recording.doubled} {rows} the time of the row before; {rule}"
        findings.append(Finding(DOUBLED, "", 0, last, recording.doubled, text))
    if recording.shifted:
        farthest = f"by up to {recording.farthest:.3g} s"
        text = f"{recording.shifted} samples were moved to the grid of {log.dt:g} s, {farthest}"
        findings.append(Finding(MOVED, "", 0, last, recording.shifted, text))
    for channel, count in recording.dropped:
        what = f"{count} samples of {_name(channel)}" if count > 1 else f"1 sample of {_name(channel)}"
        text = f"{what} {('are' if count > 1 else 'is')} not used: another one is nearer to the same grid time"
        findings.append(Finding(DROPPED, channel, 0, last, count, text))
    return findings


def _of_channel(log: Log, column: int, channel: str) -> list[Finding]:
    values = log.measurements[:, column]
    rows = np.flatnonzero(~np.isnan(values))
    if len(rows) < SHORTEST:
        return []
    values, quantity = values[rows], log.measured[column]
    wraps: list[Finding] = []
    if (turn := dict(log.recording.turns).get(channel, 0.0)) > 0.0:
        text = f"{_name(channel)} wraps: whole turns ({turn:.6g}) are added, and a filter needs the same"
        wraps.append(Finding(WRAPPED, channel, 0, log.steps, len(rows), text))
    elif not quantity.angle and turn_of(values, quantity.unit):
        text = f"{_name(channel)} wraps like an angle, and the model does not have it as one (angle=True)"
        wraps.append(Finding(WRAPPED, channel, 0, log.steps, len(rows), text))
    runs = _runs_of_equals(values)
    findings, ends = _saturated(log, channel, rows, values, runs)
    for first, count in _stuck(log, rows, values, runs, quantity.angle):
        if values[first] in ends:  # said already
            continue
        low, high = int(rows[first]), int(rows[first + count - 1])
        text = f"{_name(channel)} is stuck at {values[first]:.6g} for {count} samples{_where(log, low, high)}"
        findings.append(Finding(STUCK, channel, low, high, count, text))
    findings = wraps + findings
    bursts = _bursts(log, rows, values, quantity.angle)
    for begin, end in bursts:
        first, last = int(rows[begin]), int(rows[end])
        text = f"{_name(channel)} has a burst of outliers, {end - begin + 1} samples{_where(log, first, last)}"
        findings.append(Finding(OUTLIER, channel, first, last, end - begin + 1, text))
    spikes = _alone(_spikes(rows, values, quantity.angle), bursts)
    if len(spikes):
        first, last = int(rows[spikes[0]]), int(rows[spikes[-1]])
        spike_count = "1 isolated outlier" if len(spikes) == 1 else f"{len(spikes)} isolated outliers"
        text = f"{_name(channel)} has {spike_count}{_where(log, first, last)}"
        findings.append(Finding(OUTLIER, channel, first, last, len(spikes), text))
    return findings


def outliers(log: Log, channel: str) -> np.ndarray:
    """Rows of the outliers of a measured channel, isolated ones and those in bursts."""
    column = [f"measurement:{quantity.symbol}" for quantity in log.measured].index(channel)
    values = log.measurements[:, column]
    rows = np.flatnonzero(~np.isnan(values))
    if len(rows) < SHORTEST:
        return rows[:0]
    values, angle = values[rows], log.measured[column].angle
    bursts = _bursts(log, rows, values, angle)
    indices = [np.arange(begin, end + 1) for begin, end in bursts]
    return rows[np.sort(np.concatenate([*indices, _alone(_spikes(rows, values, angle), bursts)]).astype(int))]


def unmeasured(values: np.ndarray) -> tuple[np.ndarray, list[tuple[str, str]]]:
    """Which samples of a channel are no measurements, (N,), and kinds and texts of these findings.

    A placeholder of missing numbers, such as -999, comes three times or more and is farther from all other values
    than their range. A sample is repeated if its sensor is slower than the log: either the channel changes in
    every p-th sample alone, or hardly a value comes again later, as it would in a quantised channel. One that
    rises or falls by single steps of its resolution, as a state of charge in per cent, is quantised, too.

    Args:
        values: samples of the channel, (N,).
    """
    left_out, texts = np.zeros(len(values), dtype=bool), []
    levels, counts = np.unique(values, return_counts=True)
    for end, inner in ((0, levels[1:]), (-1, levels[:-1])) if len(levels) > SHORTEST else ():
        if 2 < counts[end] < SELDOM * len(values) and abs(levels[end] - inner[end]) > np.ptp(inner):
            left_out |= values == levels[end]
            text = f"is {levels[end]:.6g} in {counts[end]} samples, far from all others: they are left out"
            texts.append((PLACEHOLDER, text))
            break
    rows = np.flatnonzero(~left_out)
    repeated = np.append(False, np.diff(values[rows]) == 0)
    new = rows[~repeated]
    if len(new) > CHANGES:
        period = int(np.gcd.reduce(np.diff(new)))
        if _is_staircase(np.diff(values[new]), regular=period > 1):
            return left_out, texts
        if period > 1:
            repeated = (rows - new[0]) % period != 0
        elif len(new) > REPEATS * len(rows) or len(levels) < UNLIKE * len(new):
            return left_out, texts
        left_out[rows[repeated]] = True
        times = round(len(rows) / np.count_nonzero(~repeated))
        text = f"has each number {times} times, as its sensor is slower than the log: repeats are left out"
        texts.append((REPEATED, text))
    return left_out, texts


def _is_staircase(changes: np.ndarray, regular: bool) -> bool:
    """Whether changes of a channel are mostly one step of its resolution; of `regular` ones all are the same."""
    if regular:
        return bool(np.allclose(changes, changes[0], rtol=1e-6))
    sizes = np.abs(changes)
    return float(np.mean(sizes < SINGLE * sizes.min())) > MOSTLY


def turn_of(values: np.ndarray, unit: str) -> float:
    """A whole turn in the unit of an angle whose samples wrap, 0 for other samples.

    They span most of a turn and no more, and a step from one of its ends to the other is short on a circle.

    Args:
        values: samples of the channel, (N,).
        unit: "deg" or "rad"; without one both are tried.
    """
    span = float(np.ptp(values)) if len(values) else 0.0
    for turn in (TURNS[unit],) if unit in TURNS else TURNS.values() if not unit else ():
        across = abs(np.diff(values)) > 0.5 * turn
        steps = abs(np.diff(np.unwrap(values, period=turn)))[across]
        if SPANNED * turn < span <= CLOSED * turn and len(steps) and float(np.median(steps)) < ACROSS * turn:
            return turn
    return 0.0


def _runs_of_equals(values: np.ndarray) -> list[tuple[int, int]]:
    """First sample and length of each run of equal samples."""
    starts = np.append(0, np.flatnonzero(np.diff(values) != 0) + 1)
    return list(zip(starts.tolist(), np.diff(np.append(starts, len(values))).tolist(), strict=True))


def _by_chance(values: np.ndarray, first: int, count: int, equal: int, pairs: int) -> bool:
    """Whether a run of equal samples is explained by the frequency of equal neighbours elsewhere.

    If a share p of the neighbours elsewhere, in the channel or at this value, is equal, so many in a row come by
    chance with probability p^(count - 1), times the number of samples; less than LEVEL is no chance.

    Args:
        values: of the channel.
        first: index of the first sample of the run.
        count: its length.
        equal: number of equal neighbours outside the run.
        pairs: number of neighbours outside the run.
    """
    share = (equal + 1) / (pairs + 2)
    here = np.flatnonzero(values[:-1] == values[first])
    here = here[(here < first) | (here >= first + count - 1)]
    share_there = (int((values[here + 1] == values[first]).sum()) + share) / (len(here) + 1)
    return len(values) * max(share, share_there) ** (count - 1) >= LEVEL


def _stuck(
    log: Log, rows: np.ndarray, values: np.ndarray, runs: list[tuple[int, int]], angle: bool
) -> list[tuple[int, int]]:
    """Runs of identical samples in a row that quantisation does not explain.

    At rest, while no input changes, a quantised channel and one that came to 0 without a jump may stay there.
    """
    equal, pairs, stretches = int((np.diff(values) == 0).sum()), len(values) - 1, []
    steps, noise = _steps_and_noise(values, angle)
    for first, count in sorted(runs, key=lambda run: -run[1]):
        equal, pairs = equal - (count - 1), pairs - (count - 1)  # each is held against those that are shorter
        if count < SHORTEST or _by_chance(values, first, count, equal, pairs):
            break
        inputs = log.inputs[rows[first] : rows[first + count - 1]]
        at_rest = len(inputs) == 0 or bool((np.ptp(inputs, axis=0) == 0).all())
        quantised = equal + 1 > COMMON * (pairs + 2)
        last = first + count - 1
        jumps = 0 < first and last < len(steps) and min(abs(steps[[first - 1, last]])) > SPIKE * noise
        if not (at_rest and (quantised or values[first] == 0.0 and not jumps)):
            stretches.append((first, count))
    return sorted(stretches)


def _saturated(
    log: Log, channel: str, rows: np.ndarray, values: np.ndarray, runs: list[tuple[int, int]]
) -> tuple[list[Finding], list[float]]:
    """Findings of saturation, and the values at which the channel saturates.

    That is the largest or the smallest value of a channel, unless it is 0, if it comes in RUNS stretches or more,
    and OFTENER times as often as the value next to it.
    """
    levels, counts = np.unique(values, return_counts=True)
    findings: list[Finding] = []
    ends: list[float] = []
    if len(levels) < SHORTEST:
        return findings, ends
    for level_index, next_index in ((0, 1), (-1, -2)):
        level, count = levels[level_index], int(counts[level_index])
        stretches = [run for run in runs if values[run[0]] == level]
        if level == 0.0 or len(stretches) < RUNS or count < max(SHORTEST, OFTENER * counts[next_index]):
            continue
        first, last = int(rows[stretches[0][0]]), int(rows[sum(stretches[-1]) - 1])
        end = "smallest" if level_index == 0 else "largest"
        text = (
            f"{_name(channel)} is at its {end} value, {level:.6g}, in {count} samples{_where(log, first, last)}: "
            f"it seems to be saturated"
        )
        findings.append(Finding(SATURATED, channel, first, last, count, text))
        ends.append(level)
    return findings, ends


def _alone(spikes: np.ndarray, bursts: list[tuple[int, int]]) -> np.ndarray:
    """The spikes that are in no burst."""
    inside = [(spikes >= begin) & (spikes <= end) for begin, end in bursts]
    return spikes[~np.any(inside, axis=0)] if inside else spikes


def _steps_and_noise(values: np.ndarray, angle: bool) -> tuple[np.ndarray, float]:
    """Steps of samples (N - 1,), and the standard deviation of their noise; infinite where hardly any moves."""
    steps = difference(values[1:, None], values[:-1, None], (angle,))[:, 0]
    sizes = abs(steps[steps != 0])
    if len(sizes) < SHORTEST:
        return steps, np.inf
    return steps, max(NORMAL * float(np.median(abs(steps))), float(np.median(sizes))) / np.sqrt(2.0)


def _heights(steps: np.ndarray) -> np.ndarray:
    """How far each sample but the first and last is above both neighbours, or below both; 0 if it is between."""
    before, after = steps[:-1], -steps[1:]
    return np.where(before * after > 0, np.minimum(abs(before), abs(after)), 0.0)


def _bursts(log: Log, rows: np.ndarray, values: np.ndarray, angle: bool) -> list[tuple[int, int]]:
    """The first and last index of each burst of outliers among the samples of a channel.

    A burst is a stretch of garbage, such as of a loose plug: BURST samples or more, none further than APART
    samples from the next, that are each above both of their neighbours, or below both, by more than SPIKE standard
    deviations of the noise, while no input changes beside them. It is at most a tenth of the channel, and the
    AROUND samples before and after it are calm: a plant that shakes for longer is no burst. Neither are outliers
    that are scattered over the log and happen to be near each other: so many come by chance more often than LEVEL.
    """
    steps, noise = _steps_and_noise(values, angle)
    high, explained, bursts = np.flatnonzero(_heights(steps) > SPIKE * noise) + 1, _explained(log, rows), []
    for group in np.split(high, np.flatnonzero(np.diff(high) > APART) + 1):
        count = int((~explained[group - 1]).sum())
        if count < BURST or _scattered(count, int(np.ptp(group)), len(high), len(values)):
            continue
        begin, end = int(group[0]), int(group[-1])
        beside = [abs(steps[max(begin - 1 - AROUND, 0) : begin - 1]), abs(steps[end + 1 : end + 1 + AROUND])]
        calm = [NORMAL * np.median(part) / np.sqrt(2.0) for part in beside if len(part)]
        if end - begin < LONGEST * len(values) and all(
            abs(steps[begin - 1 : end + 1]).mean() > WILDER * part for part in calm
        ):
            to_end = _edge(values[end:], noise, angle)
            bursts.append((begin - _edge(values[begin::-1], noise, angle), end + to_end))
    return bursts


def _edge(values: np.ndarray, noise: float, angle: bool) -> int:
    """How many of the APART samples after the first one are still far from those behind them."""
    near, behind = values[1 : APART + 1], values[APART + 1 : APART + 1 + AROUND]
    if not len(behind):
        return 0
    away, spread = (abs(difference(part[:, None], np.median(behind), (angle,))[:, 0]) for part in (near, behind))
    far = np.flatnonzero(away > SPIKE * max(noise, NORMAL * float(np.median(spread))))
    return int(far[-1]) + 1 if len(far) else 0


def _scattered(count: int, span: int, total: int, samples: int) -> bool:
    """Whether so many peaks within a span of samples are explained by the frequency of peaks elsewhere.

    total P(Poisson(span (total - count)/samples) >= count - 1) >= LEVEL
    """
    mean = span * max(total - count, 1) / samples
    at_most = np.exp(-mean) * np.cumsum(np.append(1.0, np.cumprod(mean / np.arange(1.0, count - 1))))[-1]
    return total * (1.0 - at_most) >= LEVEL


def _explained(log: Log, rows: np.ndarray) -> np.ndarray:
    """Whether an input changes much beside each sample but the first and last, (N - 2,)."""
    inputs = log.inputs
    if len(inputs) < 2 or not inputs.shape[1]:
        return np.zeros(len(rows) - 2, dtype=bool)
    spread = np.ptp(inputs, axis=0)
    changes = (abs(np.diff(inputs, axis=0)) > BESIDE * spread).any(axis=1) & bool((spread > 0).any())
    counts = np.append(0, np.cumsum(changes))  # changes before the input of each row
    first, last = (np.clip(part - 1, 0, len(counts) - 1) for part in (rows[:-2] - 1, rows[2:]))
    return counts[last] > counts[first]


def _spikes(rows: np.ndarray, values: np.ndarray, angle: bool) -> np.ndarray:
    """Indices of samples that stand out from both neighbours.

    A spike is above both of its neighbours, or below both, by more than SPIKE standard deviations of the noise
    (estimated by the medians of all and of near differences) and by ALONE times the differences of its neighbours
    from each other and from those beyond: a jump or a peak of the signal is not a spike. A normal one is one in
    10^8.
    """
    steps, noise = _steps_and_noise(values, angle)
    if not np.isfinite(noise):
        return np.empty(0, int)
    height = _heights(steps)
    neighbouring = np.maximum(np.append(0.0, abs(steps[:-2])), np.append(abs(steps[2:]), 0.0))
    across = abs(steps[:-1] + steps[1:])
    apart = np.diff(rows)
    near = np.maximum(apart[:-1], apart[1:]) <= np.median(apart)
    spikes = np.flatnonzero(near & (height > SPIKE * noise) & (height > ALONE * np.maximum(neighbouring, across)))
    local = [np.median(abs(steps[max(k - AROUND, 0) : k + AROUND])) * NORMAL / np.sqrt(2.0) for k in spikes]
    return spikes[height[spikes] > SPIKE * np.array(local)] + 1


def _where(log: Log, first: int, last: int) -> str:
    since, until = (log.start + (row * log.dt if log.stamps is None else log.stamps[row]) for row in (first, last))
    begin, end = time_text(since, log.dt), time_text(until, log.dt)
    if first == last:
        return f" in row {first}, at {begin} s{date_text(since)}"
    return f" in rows {first} to {last}, {begin} to {end} s{date_text(since)}"


def _name(channel: str) -> str:
    return channel.partition(":")[2]
