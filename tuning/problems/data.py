"""`Data`: inputs and measurements of many runs and, if they are known, true states and outputs.

In order: `Data`, a filter's estimates on it, part by part, and the seeds of a study for training, validation, the
choice of the ensemble size, and held-out evaluation.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from filters.consistency.time_constants import Run
from filters.engine.batch import Estimates, run
from filters.estimators.foreign import ForeignFilter
from filters.filter import Filter
from thruster_env.core.checks import at_least, with_progress
from thruster_env.core.parallel import cores
from thruster_env.model.shape import LANES

FIRST_SCORED_STEP = 50  # RMSE is of steps 50 to 500; the start-up is reported separately
MOST_BYTES = 2**28  # of a part's estimates: a run of 1000 steps with forty states and channels takes 26 MB
MOST_SEEDS = 20_000  # runs of 500 steps with so many seeds take a gigabyte
SEEDS_APART = 1_000_000  # training seeds of study seed s start at s times this, held-out seeds half-way on ...
SIZES_FROM = SEEDS_APART // 4  # ... those that choose the ensemble size in between ...
VALIDATION_FROM = 3 * SEEDS_APART // 4  # ... and those on which the best trials meet the baselines behind


class Data(NamedTuple):
    """The data of a problem for B seeds and K steps; filters update with measurement k + 1 after input k.

    A step is scored from `first_scored` on, where it counts (`scored` is the one definition, for every metric). It
    does not count where a run is over, or its truth is not known. Everything after a run's last scored step is
    padding: nothing there, not even NaN, changes any result.
    """

    seeds: tuple[int, ...]
    inputs: np.ndarray  # (B, K, p)
    measurements: np.ndarray  # (B, K + 1, m), NaN where missing
    filter_keys: np.ndarray  # (B, 2), keys of the filters' random numbers
    first_scored: int = FIRST_SCORED_STEP  # the first step that is scored
    states: np.ndarray | None = None  # (B, K + 1, n), the first states of the model; None where there is no truth
    outputs: Mapping[str, np.ndarray] | None = None  # (B, K + 1) each, by symbol; None where there is no truth
    counted: np.ndarray | None = None  # (B, K + 1) bool, which steps count; None where all do
    begun: np.ndarray | None = None  # (B, n), where each run begins; None for the mean of the model's prior

    @property
    def late(self) -> slice:
        """The steps from the first scored one on, whether they count or not."""
        return slice(self.first_scored, None)

    @property
    def scored(self) -> np.ndarray:
        """Which steps are scored, (B, K + 1) bool."""
        scored = np.ones(self.measurements.shape[:2], dtype=bool) if self.counted is None else self.counted.copy()
        scored[:, : self.first_scored] = False
        return scored

    @property
    def scored_counts(self) -> np.ndarray:
        """Number of scored steps of each run, (B,)."""
        return self.scored.sum(axis=1)

    @property
    def rows(self) -> np.ndarray:
        """Number of rows of each run, (B,): up to its last step that counts."""
        count, times = self.measurements.shape[:2]
        if self.counted is None:
            return np.full(count, times)
        return np.where(self.counted.any(axis=1), times - self.counted[:, ::-1].argmax(axis=1), 0)

    @property
    def known_states(self) -> np.ndarray:
        """The true states, (B, K + 1, n), NaN where a step does not count; ValueError where they are unknown."""
        if self.states is None:
            raise ValueError("data must have true states, but got data without truth")
        return self.states if self.counted is None else where_true(self.counted, self.states, np.nan)

    @property
    def steps(self) -> int:
        """Number K of steps."""
        return self.inputs.shape[1]

    @property
    def beginning(self) -> Data:
        """The steps before the first scored one, without truth."""
        first, observed = self.first_scored, self.seen
        inputs, measurements = observed.inputs[:, : max(first - 1, 0)], observed.measurements[:, :first]
        return self._replace(inputs=inputs, measurements=measurements, states=None, outputs=None, counted=None)

    @property
    def seen(self) -> Data:
        """The data as filters see them: in a run's padding nothing is measured, and the last input is held."""
        if self.counted is None:
            return self
        times, last = np.arange(self.steps + 1), self.rows[:, None] - 1
        latest = np.minimum(times[:-1], np.maximum(last - 1, 0))[..., None]
        measurements = where_true(times <= last, self.measurements, np.nan)
        return self._replace(inputs=np.take_along_axis(self.inputs, latest, axis=1), measurements=measurements)

    def late_scored(self, values: np.ndarray) -> np.ndarray:
        """The late ones of values (B, K + 1, ...) of every step, NaN where a step is not scored."""
        if self.counted is None:
            return values[:, self.late]
        return where_true(self.counted[:, self.late], values[:, self.late], np.nan)

    def scored_rows(self, values: np.ndarray) -> np.ndarray:
        """Values (B, K + 1, ...) of all scored steps of all runs, one after the other."""
        return values[self.scored]

    def counted_rows(self, values: np.ndarray) -> np.ndarray:
        """Values (B, K + 1, ...) of all steps that count, scored or not, one after the other."""
        return values.reshape(-1, *values.shape[2:]) if self.counted is None else values[self.counted]

    def pooled(self, values: np.ndarray) -> np.ndarray:
        """Mean of values (B, K + 1, ...) over all scored steps of all runs."""
        if self.counted is None:
            return values[:, self.late].mean(axis=(0, 1))
        return self.scored_rows(values).mean(axis=0)

    def every(self, count: int) -> Data:
        """The same runs measured at every so many steps alone, from the first scored one on: a slower sample time.

        What was measured between is missing, so that a filter predicts over all of it with its own model.
        """
        measured = np.arange(self.steps + 1) % count == self.first_scored % count
        return self._replace(measurements=np.where(measured[:, None], self.measurements, np.nan))

    def slice(self, first: int, last: int) -> Data:
        """The runs from `first` up to, but without, `last`."""
        return self.select(slice(first, last))

    def select(self, part: Any) -> Data:
        """The runs of a slice, or of indices (count,) in any order."""
        return self._replace(
            seeds=tuple(self.seeds[i] for i in np.arange(len(self.seeds))[part].tolist()),
            inputs=self.inputs[part],
            measurements=self.measurements[part],
            filter_keys=self.filter_keys[part],
            states=None if self.states is None else self.states[part],
            outputs=None
            if self.outputs is None
            else {name: values[part] for name, values in self.outputs.items()},
            counted=None if self.counted is None else self.counted[part],
            begun=None if self.begun is None else self.begun[part],
        )

    def one(self, index: int) -> Data:
        """A single run, without padding."""
        run, rows = self.slice(index, index + 1), int(self.rows[index])
        return run._replace(
            inputs=run.inputs[:, : max(rows - 1, 0)],
            measurements=run.measurements[:, :rows],
            states=None if run.states is None else run.states[:, :rows],
            outputs=None
            if run.outputs is None
            else {name: values[:, :rows] for name, values in run.outputs.items()},
            counted=None if run.counted is None else run.counted[:, :rows],
        )

    def read_only(self) -> Data:
        """The same data with arrays that cannot be written to, so that they can be shared."""
        arrays = [self.inputs, self.measurements, self.filter_keys, self.states, self.counted]
        for array in (*arrays, *(self.outputs or {}).values()):
            if array is not None:
                array.setflags(write=False)
        return self


def checked_first_scored_step(value: Any, steps: int) -> int:
    """The first scored step of runs of `steps` steps; ValueError if no step would be scored."""
    first = at_least("first_scored_step", value, 0)
    if first >= steps:
        raise ValueError(
            f"first_scored_step must be at most {steps - 1} in runs of {steps} steps, but got {first}: pass "
            f"first_scored_step=0 to score every step, or longer runs"
        )
    return first


def runs_of(data: Data, count: int = 2) -> list[Run]:
    """Keys (1, 2), inputs (1, K, p) and measurements (1, K + 1, m) of the first runs, without padding."""
    runs = [data.one(index) for index in range(min(count, len(data.seeds)))]
    return [(part.filter_keys, part.inputs, part.measurements) for part in runs if part.steps > 1]


def where_true(mask: np.ndarray, values: np.ndarray, other: float) -> np.ndarray:
    """Values (B, T, ...) where a mask (B, T) is true, elsewhere a number."""
    return np.where(mask.reshape(mask.shape + (1,) * (values.ndim - mask.ndim)), values, other)


def padded(arrays: Sequence[np.ndarray], rows: int, fill: float | None = np.nan) -> np.ndarray:
    """Arrays (rows or fewer, ...) of single runs as one, (B, rows, ...).

    Args:
        arrays: of the runs.
        rows: of the result; longer ones are cut.
        fill: what stands after a run's end; its last row if None.
    """
    first = np.asarray(arrays[0])
    out = np.full((len(arrays), rows, *first.shape[1:]), 0.0 if fill is None else fill)
    for index, array in enumerate(arrays):
        count = min(len(array), rows)
        out[index, :count] = array[:count]
        if fill is None and count:
            out[index, count:] = array[count - 1]
    return out


def mask_of(lengths: Sequence[int], rows: int) -> np.ndarray | None:
    """Which of `rows` rows exist of runs of these lengths, (B, rows) bool; None where all do."""
    mask = np.arange(rows) < np.asarray(lengths)[:, None]
    return None if mask.all() else mask


def only(counted: np.ndarray | None, known: Any) -> np.ndarray | None:
    """Which steps count, where only those of a mask (B, K + 1) may; None where all do."""
    both = np.asarray(known) if counted is None else counted & known
    return None if both.all() else both


def estimates_in_parts(filter_: Filter, data: Data) -> Iterator[tuple[Data, Estimates]]:
    """Run a filter on parts of the runs, in order; yield the data of each part and the estimates on them.

    The estimates of a part take at most about 256 MB, or are those of as many runs as there are cores.
    """
    parts = parts_of(filter_, data)
    for first, last in with_progress("runs", parts, [last - first for first, last in parts]):
        part = data.slice(first, last)
        yield part, estimates_on(filter_, part)


def estimates_on(filter_: Filter, data: Data) -> Estimates:
    """Run a filter over all runs of some data; results and restarts in a run's padding are not counted.

    An estimator of another package runs as far as each run goes, for it may have no estimate beyond.
    """
    observed = data.seen
    if data.begun is not None or (data.counted is not None and isinstance(filter_, ForeignFilter)):
        return _one_by_one(filter_, data)
    estimates = run(filter_, observed.filter_keys, observed.inputs, observed.measurements)
    if data.counted is None:
        return estimates
    divergences = estimates.divergences.copy()
    for index in np.flatnonzero((divergences > 0) & (data.rows <= data.steps)).tolist():
        divergences[index] = _alone(filter_, data, index).divergences[0]
    return estimates._replace(divergences=divergences)


def _one_by_one(filter_: Filter, data: Data) -> Estimates:
    """Estimates of runs of different lengths, NaN in their padding."""
    runs = [_alone(filter_, data, index) for index in range(len(data.seeds))]
    *fields, restarts = Estimates._fields
    parts = {name: padded([getattr(estimates, name)[0] for estimates in runs], data.steps + 1) for name in fields}
    return Estimates(**parts, **{restarts: np.concatenate([estimates.divergences for estimates in runs])})


def _alone(filter_: Filter, data: Data, index: int) -> Estimates:
    part = data.one(index)
    if data.begun is not None:
        filter_ = replace(filter_, model=filter_.model.replace(prior_mean=data.begun[index]))
    return run(filter_, part.filter_keys, part.inputs, part.measurements)


def parts_of(filter_: Filter, data: Data) -> list[tuple[int, int]]:
    """First run, and the one after the last, of each part that `estimates_in_parts` makes of some data."""
    n, (count, times, m) = filter_.kernel_model.n, data.measurements.shape
    a_run = 8 * times * (n + n * n + m + m * m + 1)
    size = max(MOST_BYTES // a_run, cores())
    size = size // LANES * LANES or size  # filters without an ensemble run so many side by side
    return [(first, min(first + size, count)) for first in range(0, count, size)]


def training_seeds(seed: int, count: int) -> range:
    """Training seeds of a study with a given seed."""
    first = at_least("seed", seed, 0) * SEEDS_APART
    return range(first, first + at_least("the number of training seeds", count, 2, SEEDS_APART // 2))


def held_out_seeds(seed: int, count: int) -> range:
    """Held-out seeds of a study with a given seed, which it never uses."""
    first = at_least("seed", seed, 0) * SEEDS_APART + SEEDS_APART // 2
    return range(first, first + at_least("the number of held-out seeds", count, 2, MOST_SEEDS))


def size_seeds(seed: int, count: int) -> range:
    """Seeds on which a study with a given seed chooses the ensemble size, and nothing else."""
    first = at_least("seed", seed, 0) * SEEDS_APART + SIZES_FROM
    return range(first, first + at_least("the number of seeds for the ensemble size", count, 2, MOST_SEEDS))


def validation_seeds(seed: int, count: int) -> range:
    """Seeds on which the best trials of a study with a given seed meet the baselines, and nothing else."""
    first = at_least("seed", seed, 0) * SEEDS_APART + VALIDATION_FROM
    return range(first, first + at_least("the number of validation seeds", count, 2, MOST_SEEDS))
