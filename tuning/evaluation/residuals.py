"""Residuals and innovations against the noise that a filter assumes, and noise estimation from the residuals.

In order: heavy tails; a mean NIS that a few blocks of logs carry; noise estimation, by the sample covariances of
x' - f(x, u) and z - h(x) on the true states.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from filters.consistency.nees import normalized_squares
from filters.filter import Filter
from thruster_env.core.checks import correlation_flaws
from thruster_env.core.compiled import is_interpreting
from thruster_env.core.sources import vector_reader, vector_writer
from thruster_env.model.shape import Functions, Shape, constants_reader, for_any_input
from thruster_env.model.state_space import StateSpaceModel
from thruster_env.model.turns import differences_of, errors_of, innovations_of, readings, tangent_of
from tuning.problems.assumed import within
from tuning.problems.check import data_of
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

# Of noise estimation.
FEWEST_PAIRS = 10  # residuals for each entry of a mean, below which there is no covariance worth the name
LEAST_EIGENVALUE = 1e-9  # of R's correlations: channels that are copies of each other have none
TOLERANCE = 0.1  # of variances and correlations of residuals, relative, within which a model is right
ROUNDING = 1e-12  # of a state's largest value, below which residuals are rounding


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
    names = [channel.symbol for channel in innovations_of(filter_.model)]
    ratios = [ratio.reshape(-1, len(names)) for data in problems_data for ratio, _ in _innovations(filter_, data)]
    return heavy_tails(np.concatenate(ratios), names)


def _innovations(filter_: Filter, data: Data):
    """Innovations over deviations (B, T, m) and NIS (B, T) of late steps, part by part; NaN if not scored."""
    for part, estimates in estimates_in_parts(filter_, data):
        late = part.late
        variances = np.einsum("bkii->bki", estimates.innovation_covs[:, late])
        present = ~np.isnan(readings(part.late_scored(part.measurements), filter_.model.measured_turns))
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

    A burst of garbage in one log raises R for all logs, and the mean NIS of the tuned filter still looks right:
    the burst offsets values that are too small everywhere else.

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


class Residuals(NamedTuple):
    """Residuals of a model on true states and on measurements, one per row."""

    process: np.ndarray  # (N, n), x_{k+1} - f(x_k, u_k)
    measurement: np.ndarray  # (N', m), z_k - h(x_k), of the times at which all channels were measured
    process_pairs: tuple[np.ndarray, np.ndarray]  # those of which the next one is there, too, and the next ones
    measurement_pairs: tuple[np.ndarray, np.ndarray]


class Estimated(NamedTuple):
    """Sample means and covariances of residuals, or the reason why there are none."""

    process_cov: np.ndarray | None = None  # (n, n)
    measurement_cov: np.ndarray | None = None  # (m, m)
    process_mean: np.ndarray | None = None  # (n,): what the model lacks in the mean, which no Q can stand for
    measurement_mean: np.ndarray | None = None  # (m,)
    process_correlation: np.ndarray | None = None  # (n,), of each w_k with w_{k+1}: noise that is white has none
    measurement_correlation: np.ndarray | None = None  # (m,)
    reason: str = ""
    tails: Mapping[str, float] = {}  # heavy ones, "v of thrust": share beyond four robust standard deviations


def residuals(model: StateSpaceModel, data: Data) -> Residuals:
    """Residuals of a model on runs with known true states, scored steps only.

    w_k = x_{k+1} - f(x_k, u_k),   v_k = z_k - h(x_k);  angles wrapped, rotations on their tangent

    Args:
        model: with as many states as are known.
        data: with true states.
    """
    states = np.ascontiguousarray(data.known_states[:, data.late])
    inputs = np.ascontiguousarray(data.inputs[:, data.late], dtype=np.float64)
    expected, outputs = predicted(model, states, inputs)
    measured = data.late_scored(data.measurements)
    process = -errors_of(model, expected, states[:, 1:])
    measurement = differences_of(model, measured, outputs)
    complete = [np.isfinite(rows).all(axis=-1) for rows in (process, measurement)]
    both = [mask[:, :-1] & mask[:, 1:] for mask in complete]
    pairs = [
        (rows[:, :-1][mask], rows[:, 1:][mask]) for rows, mask in zip((process, measurement), both, strict=True)
    ]
    return Residuals(process[complete[0]], measurement[complete[1]], *pairs)


def predicted(model: StateSpaceModel, states: np.ndarray, inputs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """F along states (B, T, n) and inputs (B, T - 1, p), (B, T - 1, n), and h, (B, T, channels)."""
    states, inputs = (np.ascontiguousarray(rows, dtype=np.float64) for rows in (states, inputs))
    expected, outputs = np.empty(states[:, 1:].shape), np.empty((*states.shape[:2], model.channels))
    steps = _steps(model.functions, model.any_shape, is_interpreting())
    steps(states, inputs, model.numbers, expected, outputs)
    return expected, outputs


@lru_cache(maxsize=16)
def noise_estimation(problem: Problem, seed: int = 0) -> Estimated:
    """Sample covariances of the residuals of a problem's model before tuning, on the training runs of a seed.

    Q is zero if the residuals of all states are rounding. If there is no truth, if the model has states that the
    truth lacks, or if R would be singular, the result is a reason instead.
    """
    if problem.scale is None:
        return Estimated(reason="there is no truth")
    data = data_of(problem, problem.training_seeds(seed, TRAINING_SEEDS))
    return estimated_from(problem.model(**problem.untuned), data)


def estimated_from(model: StateSpaceModel, data: Data) -> Estimated:
    """Sample covariances of a model's residuals on some runs, or the reason why there are none."""
    if data.states is None:
        return Estimated(reason="there is no truth")
    if data.known_states.shape[-1] != model.n:
        return Estimated(reason=f"of the model's {model.n} states only {data.known_states.shape[-1]} are known")
    model_residuals = residuals(model, data)
    for rows, what in zip(model_residuals[:2], ("states", "channels"), strict=True):
        if len(rows) < FEWEST_PAIRS * rows.shape[1]:
            return Estimated(reason=f"there are too few steps at which all {what} are known")
    q, r = (np.atleast_2d(np.cov(rows, rowvar=False)) for rows in model_residuals[:2])
    if (np.sqrt(np.diag(q)) <= _rounding(model, data)).all():
        q = np.zeros_like(q)
    if not _is_regular(r):
        return Estimated(reason="the measurements have no noise")
    mean_w, mean_v = (rows.mean(axis=0) for rows in model_residuals[:2])
    names = (
        [f"w of {state.symbol}" for state in tangent_of(model)],
        [f"v of {channel.symbol}" for channel in innovations_of(model)],
    )
    w, v = (heavy_tails(*pair) for pair in zip(model_residuals[:2], names, strict=True))
    of_w, of_v = (_correlation(rows) for rows in model_residuals[2:])
    tails = {**(w if q.any() else {}), **v}
    return Estimated(q, r, mean_w, mean_v, of_w, of_v, tails=tails)


def _rounding(model: StateSpaceModel, data: Data) -> np.ndarray:
    """What is rounding in each component (t,) of an error of the true states."""
    largest = np.nanmax(np.abs(data.known_states), axis=(0, 1))
    return ROUNDING * np.delete(largest, [turn.stored for turn in model.turns])


@lru_cache(maxsize=16)
def model_error(problem: Problem, seed: int = 0) -> str:
    """How a problem's model differs from its plant, in a few words; empty if it does not, or if nothing tells.

    On true states, the residuals r of a right model are white with the plant's own variances s^2:

        E[r_k^2]/s^2 = 1,  E[r_k r_{k+1}]/s^2 = 0,  each within 0.1 + 5 sqrt(2/N) of N residuals

    Args:
        problem: with the plant's own Q and R (`true`), and true states of all the model's states.
        seed: of the study whose training runs are taken.
    """
    if problem.true is None or problem.scale is None:
        return ""
    model, data = problem.model(**problem.true), data_of(problem, problem.training_seeds(seed, TRAINING_SEEDS))
    if data.states is None or data.known_states.shape[-1] != model.n:
        return ""
    model_residuals = residuals(model, data)
    rounding = _rounding(model, data)
    errors = _errors(
        tangent_of(model),
        np.diag(model.process_noise_cov),
        model_residuals.process,
        model_residuals.process_pairs,
        rounding,
    )
    variances = np.diag(model.measurement_noise_cov)
    errors |= _errors(
        innovations_of(model), variances, model_residuals.measurement, model_residuals.measurement_pairs, 0.0
    )
    return errors[max(errors)] if errors else ""


def _errors(quantities, variances, rows, pairs, rounding) -> dict[float, str]:
    """The components of residuals (N, d) that are not white with some variances (d,), by error over tolerance."""
    if len(rows) < FEWEST_PAIRS:
        return {}
    tolerance, errors = TOLERANCE + 5.0 * np.sqrt(2.0 / len(rows)), {}
    scale = np.maximum(np.sqrt(variances), rounding)
    squares = (rows**2).mean(axis=0) / scale**2
    lags = (pairs[0] * pairs[1]).mean(axis=0) / scale**2 if len(pairs[0]) >= FEWEST_PAIRS else np.zeros(len(scale))
    for quantity, variance, square, lag in zip(quantities, variances, squares, lags, strict=True):
        error = square - 1.0 if variance == 0.0 else max(abs(square - 1.0), abs(lag))
        if error > tolerance:
            words = f"the residuals of {quantity.short_label} have {square:.3g} times the plant's own variance"
            if variance == 0.0:
                words = f"{quantity.short_label} has residuals where the plant has no noise"
            elif abs(lag) > tolerance:
                words += f" and a correlation of {lag / square:.2f} from step to step"
            errors[error / tolerance] = words
    return errors


def _correlation(pairs: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Correlation of each component of residuals (N, n) with that a step later, (n,); 0 where nothing varies."""
    if len(pairs[0]) < FEWEST_PAIRS:  # channels that are never measured at two steps in a row
        return np.zeros(pairs[0].shape[1])
    now, later = (values - values.mean(axis=0) for values in pairs)
    spread = np.sqrt((now**2).sum(axis=0) * (later**2).sum(axis=0))
    return np.divide((now * later).sum(axis=0), spread, out=np.zeros(now.shape[1]), where=spread > 0)


def _is_regular(cov: np.ndarray) -> bool:
    """Whether a covariance is positive definite, by its correlations."""
    return bool(np.isfinite(cov).all() and correlation_flaws(cov)[0] > LEAST_EIGENVALUE)


@lru_cache(maxsize=64)
def _steps(functions: Functions, shape: Shape, interpreting: bool):
    """The function steps(states, inputs, numbers, expected, outputs) that evaluates f and h along true states."""
    n, m, transition, observe = (
        shape.n,
        shape.channels,
        functions.transition,
        for_any_input(functions.observe, shape),
    )
    substeps = shape.offsets.substeps
    state, store_state, store_measurement = vector_reader(n), vector_writer(n), vector_writer(m)
    control, constants = vector_reader(shape.inputs), constants_reader(shape)

    def steps(states, inputs, numbers, expected, outputs):
        x, z, u, c = np.zeros(n), np.zeros(m), np.zeros(inputs.shape[2]), constants(numbers)
        for b in range(states.shape[0]):
            for i in range(u.shape[0]):
                u[i] = 0.0  # no input acts before the first step
            for k in range(states.shape[1]):
                for i in range(n):
                    x[i] = states[b, k, i]
                store_measurement(z, observe(state(x), control(u), c))
                for i in range(m):
                    outputs[b, k, i] = z[i]
                if k < expected.shape[1]:
                    for i in range(u.shape[0]):
                        u[i] = inputs[b, k, i]
                    for _ in range(int(numbers[substeps])):
                        store_state(x, transition(state(x), control(u), c))
                    for i in range(n):
                        expected[b, k, i] = x[i]

    shapes = (None, None, n), (None, None, None), (None,), (None, None, n), (None, None, m)
    from thruster_env.graphs.loops import Loops

    return Loops(steps, shapes)
