"""Residuals of another kind than a filter assumes: heavy tails, and a few blocks of logs that carry the mean NIS.

NIS is the normalised innovation squared. A burst of garbage in one log raises R for all logs, and the mean NIS of
the tuned filter still looks right, because the burst makes up for what is too small everywhere else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from filters.consistency.nees import normalized_squares
from filters.consistency.report import rounded
from filters.filter import Filter
from tuning.problems.assumed import within
from tuning.problems.data import Data, estimates_in_parts
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Problem
from tuning.search.plan import HELD_OUT_SEEDS, TRAINING_SEEDS, VALIDATION_SEEDS

FAR = 4.0  # robust standard deviations, beyond which residuals are counted
NORMAL_SHARE = 6.334e-5  # of normal residuals beyond these
FEWEST = 3  # independent residuals beyond, of which tails are called heavy ...
LEAST_SHARE = 8.0  # ... if their share is so many times that of normal ones ...
LEVEL = 1e-4  # ... and comes by chance more seldom than this
MEDIAN = 0.6745  # of magnitudes of standard normal numbers
MOST_CORRELATED = 0.99  # correlation of neighbours, as far as clusters are computed
FEWEST_BLOCKS = 6  # of which a mean is said to be carried by some
CARRIES = 4.0  # mean NIS of a block over the median block, from which it stands out
MOST_BLOCKS = 0.25  # share of the blocks that may stand out: more are no exception
LIFTED = 1.5  # mean NIS with the blocks that stand out over that without them
LARGE = 4.0  # innovation of a row over the robust deviation of its channel, from which it belongs to the burst
MOST_SPANS, NEAR = 3, 25  # spans that are named, and the distance in rows up to which two are one


class Tails(NamedTuple):
    """The tails of residuals: the share beyond four robust deviations, and its chance if they are normal."""

    share: float
    p_value: float
    clusters: int  # of those beyond: their number over the length of a cluster

    @property
    def are_heavy(self) -> bool:
        """Whether they are heavier than normal ones: not by chance, and by more than matters."""
        enough = self.clusters >= FEWEST and self.share > LEAST_SHARE * NORMAL_SHARE
        return enough and self.p_value < LEVEL


def tails_of(residuals: np.ndarray) -> Tails:
    """The tails of N residuals; NaN are left out.

        s = median |r - median r| / 0.6745,   c = #{|r - median r| > 4 s},   p = P(Poisson(6.3e-5 N/f) >= c/f)

    The robust deviation s is not raised by the tails, as a sample variance is. The factor f = (1 + a^2)/(1 - a^2),
    with the correlation a of neighbours up to 4 s, is the length of their clusters. Normal residuals are called
    heavy in fewer than 0.1 % of samples of 50 or more, also if a = 0.95 (tests).

    Args:
        residuals: of one quantity, (N,), in order of time.
    """
    from scipy.special import pdtrc

    known = residuals[~np.isnan(residuals)]
    known = known - np.median(known) if len(known) else known
    deviation = float(np.median(abs(known))) / MEDIAN if len(known) else 0.0
    if deviation <= 0.0:  # of quantised or constant residuals there is no such deviation
        return Tails(0.0, 1.0, 0)
    share = float((abs(known) > FAR * deviation).mean())
    clipped = np.clip(known, -FAR * deviation, FAR * deviation)
    square = min(float(clipped[1:] @ clipped[:-1]) / float(clipped @ clipped), MOST_CORRELATED) ** 2
    number = len(known) * (1.0 - square) / (1.0 + square)
    count = int(share * number)
    return Tails(share, float(pdtrc(count - 1, NORMAL_SHARE * number)) if count else 1.0, count)


def heavy_tails(residuals: np.ndarray, names: Sequence[str]) -> dict[str, float]:
    """The share beyond four robust deviations of each component of residuals (N, d) with heavy tails, by name."""
    tails = {name: tails_of(residuals[:, i]) for i, name in enumerate(names)}
    return {name: part.share for name, part in tails.items() if part.are_heavy}


def tails_in_words(shares: Mapping[str, float]) -> str:
    """Shares of residuals beyond four robust deviations, and that of normal ones."""
    parts = [f"{100 * share:.2g} % of {name}" for name, share in shares.items()]
    return f"{', '.join(parts)} lie beyond four robust standard deviations, where 0.006 % is right"


def heavy_innovations(filter_: Filter, problems_data: Sequence[Data]) -> dict[str, float]:
    """`heavy_tails` of a filter's innovations over their deviations in S, of scored steps."""
    if not filter_.has_covariance:
        return {}
    names = [channel.symbol for channel in filter_.model.measurements]
    ratios = [ratio.reshape(-1, len(names)) for data in problems_data for ratio, _ in _innovations(filter_, data)]
    return heavy_tails(np.concatenate(ratios), names)


def _innovations(filter_: Filter, data: Data):
    """Innovations over deviations (B, T, m) and NIS (B, T) of late steps, part by part; NaN if not scored."""
    for part, estimates in estimates_in_parts(filter_, data):
        late = part.late
        variances = np.einsum("bkii->bki", estimates.innovation_covs[:, late])
        present = ~np.isnan(part.late_scored(part.measurements))
        with np.errstate(all="ignore"):
            ratios = estimates.innovations[:, late] / np.sqrt(variances)
            nis = normalized_squares(estimates.innovations[:, late], estimates.innovation_covs[:, late])
        yield np.where(present, ratios, np.nan), np.where(present.any(axis=-1), nis, np.nan)


class UnevenNis(NamedTuple):
    """A mean NIS that a few blocks of logs carry.

    Attributes:
        mean: over the number of channels, of all blocks.
        rest: the same without the blocks that stand out.
        carrying: of the blocks that stand out ...
        blocks: ... among so many.
        channel: symbol of the measurement with the largest innovations there.
        spans: logs and times of these innovations, the worst first, in words.
    """

    mean: float
    rest: float
    carrying: int
    blocks: int
    channel: str
    spans: tuple[str, ...]


def uneven_nis(filter_: Filter, problem: Problem, seed: int = 0) -> UnevenNis | None:
    """Whether a few blocks of logs, at most a fourth, carry a filter's mean NIS; None if not, and without logs.

        r_b = sum of NIS / number of measured values of block b,   stands out: r_b > 4 median r,
        carried: mean NIS > 1.5 times the mean without those that stand out

    Args:
        filter_: the filter, of a covariance.
        problem: of logs; all of its blocks are looked at, training and held out.
        seed: of the study.
    """
    inner = within(problem)
    if not isinstance(inner, LogProblem) or not filter_.has_covariance:
        return None
    seeds = {*problem.training_seeds(seed, TRAINING_SEEDS), *problem.validation_seeds(seed, VALIDATION_SEEDS)}
    data = problem.data(tuple(sorted(seeds | {*problem.held_out_seeds(seed, HELD_OUT_SEEDS)})))
    parts = list(_innovations(filter_, data))
    ratios, nis = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    counts, sums = (~np.isnan(ratios)).sum(axis=(1, 2)), np.nansum(nis, axis=1)
    measured = counts > 0
    if measured.sum() < FEWEST_BLOCKS or not np.isfinite(sums).all():
        return None
    by_block = sums / np.maximum(counts, 1)
    out = measured & (by_block > CARRIES * np.median(by_block[measured]))
    rest = sums[~out].sum() / counts[~out].sum()
    mean = sums.sum() / counts.sum()
    if not 0 < out.sum() <= MOST_BLOCKS * measured.sum() or not mean > LIFTED * rest > 0.0:
        return None
    channel = int(np.nansum(ratios[out] ** 2, axis=(0, 1)).argmax())
    spans = _spans(inner, data, abs(ratios[..., channel]), out, by_block)
    symbol = problem.model().measurements[channel].symbol
    return UnevenNis(float(mean), float(rest), int(out.sum()), int(measured.sum()), symbol, spans)


def _spans(
    problem: LogProblem, data: Data, sizes: np.ndarray, out: np.ndarray, by_block: np.ndarray
) -> tuple[str, ...]:
    """Logs and times of the large innovations of blocks that stand out; those near each other are one span."""
    large = sizes > LARGE * float(np.nanmedian(sizes)) / MEDIAN
    by_rows: list[tuple[int, int, int, float]] = []  # log, its first and last row, NIS
    for b in np.flatnonzero(out).tolist():
        steps, block = np.flatnonzero(large[b]), problem.parts.blocks[data.seeds[b]]
        if len(steps):
            first, last = (block.first + data.first_scored + int(step) for step in steps[[0, -1]])
            by_rows.append((block.run, first, last, float(by_block[b])))
    spans: list[tuple[int, int, int, float]] = []
    for run, first, last, nis in sorted(by_rows):
        if spans and spans[-1][0] == run and first - spans[-1][2] <= NEAR:
            spans[-1] = run, spans[-1][1], last, max(spans[-1][3], nis)
        else:
            spans.append((run, first, last, nis))
    worst = sorted(spans, key=lambda span: -span[3])[:MOST_SPANS]
    return tuple(problem.span_label(run, first, last) for run, first, last, _ in worst)


def uneven_sentence(uneven: UnevenNis, channels: int) -> str:
    """A mean NIS that a few blocks carry, where, and what to do."""
    blocks = f"{uneven.carrying} of {uneven.blocks} blocks {'carries' if uneven.carrying == 1 else 'carry'}"
    means = [rounded(channels * mean) for mean in (uneven.mean, uneven.rest)]
    where = f"in {'; '.join(uneven.spans)}" if uneven.spans else "spread over them"
    effect = ", so that R or Q is too large for the others" if uneven.rest < 1.0 / LIFTED else ""
    return (
        f"{blocks} the mean NIS, {means[0]}; without {'it' if uneven.carrying == 1 else 'them'} it is {means[1]}, "
        f"where {channels} is right{effect}. The large innovations are of {uneven.channel}, {where}. If that is "
        "garbage, leave it out (--outliers missing, outliers='missing' in Python, where the findings name it; "
        "otherwise make these cells of the log empty), or take --filter ekf-robust."
    )
