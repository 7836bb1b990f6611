"""`Log`: inputs, measurements and reference channels of one recorded run, on a grid or on its own stamps.

A model for rows on their own stamps has the length of a step as one more input:

    x_{k+1} = f(x_k, u_k, r_k dt) + w_k,  w_k ~ N(0, r_k Q);   r_k dt is the length of step k

The Q of a model is that of a step of dt, and others are in proportion (`continuous.noise_for_dt`). A log on its
own stamps is then rows of numbers, and whatever takes such rows takes the log.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from thruster_env.core.checks import as_floats, finite, positive, short_repr
from thruster_env.core.derivatives import by_complex_step
from thruster_env.core.equal_functions import makes_functions
from thruster_env.core.sources import tuple_of, written_out
from thruster_env.logs.columns import INPUT, MEASUREMENT, STATE
from thruster_env.logs.findings import Finding, Recording, found_in
from thruster_env.logs.grid import Series, count_steps, mean_held, resolution_of, sampled
from thruster_env.model.continuous import same_dt
from thruster_env.model.quantities import Quantity
from thruster_env.model.shape import Shape
from thruster_env.model.state_space import StateSpaceModel

FEWEST_STEPS = 2


# Of rows that two logs share.
WINDOW = 20  # rows in a row that are the same; of shorter logs half of them
FEWEST = 4
FACTOR = np.uint64(0x9E3779B97F4A7C15)  # odd, of the hash of a window
RATIO = Quantity("length of a step over dt", "step_ratio")


@dataclass(frozen=True, eq=False)
class Log:
    """One recorded run. Row k holds what was measured at time k dt, and the input that acts from then on.

    A log on its own stamps has row k at `stamps[k]`, and only what goes by the clock can filter it.

    `thruster simulate --out` writes rows like this, and so does a recorder that reads its sensors right after it
    has sent a command. Channels are named as in `input:V_s`, `measurement:thrust`, `state:omega_m` and `output:T`.

    Attributes:
        name: of the run, its file if it has one.
        dt: sample time [s].
        inputs: (K, p), finite.
        measurements: (K + 1, m), NaN where there is no sample.
        references: channels that filters do not see, (K + 1,) each: true states, and outputs of the model such as
            the thrust of a load cell; NaN where there is no sample.
        input_quantities: names and units of the p inputs.
        measured: names and units of the m measurements.
        referred: name and unit of each reference, by channel.
        start: time stamp of row 0 in the file [s].
        source: samples of channels at their own times, before they are put on the grid; for other channels the
            rows themselves.
        offsets: how far the clock of a channel is ahead [s], by channel; it is subtracted from its times.
        irregular: whether the time stamps of the file lay on no grid.
        recording: what became of the file's rows on the grid; empty where the log is not from a file.
        uncut: the log that this one is a piece of, between gaps; None for one that is no piece.
        stamps: times of the rows [s], (K + 1,), 0 at row 0 and increasing; None for a log on a grid.
        until: whether the file's input of a row acts until then, as a current that is sampled with a voltage does.
            `inputs` have the one of row k + 1 in place k.
    """

    name: str
    dt: float
    inputs: np.ndarray
    measurements: np.ndarray
    input_quantities: tuple[Quantity, ...]
    measured: tuple[Quantity, ...]
    references: Mapping[str, np.ndarray] = field(default_factory=dict)
    referred: Mapping[str, Quantity] = field(default_factory=dict)
    start: float = 0.0
    source: Mapping[str, Series] = field(default_factory=dict)
    offsets: Mapping[str, float] = field(default_factory=dict)
    irregular: bool = False
    recording: Recording = Recording()
    uncut: Log | None = None
    stamps: np.ndarray | None = None
    until: bool = False

    def __post_init__(self):
        positive("dt of a log", self.dt)
        steps = len(self.inputs)
        wanted = {"inputs": (steps, len(self.input_quantities)), "measurements": (steps + 1, len(self.measured))}
        parts = {"inputs": self.inputs, "measurements": self.measurements, **self.references}
        held_parts = {}
        for name, part in parts.items():
            array = np.array(as_floats(part))
            shape = wanted.get(name, (steps + 1,))
            if array.shape != shape or np.isinf(array).any() or (name == "inputs" and np.isnan(array).any()):
                rule = "finite" if name == "inputs" else "finite or NaN"
                raise ValueError(
                    f"{name} of log {self.name} must be {rule} and of shape {shape}, but got {short_repr(array)} "
                    f"of shape {array.shape}"
                )
            array.setflags(write=False)
            held_parts[name] = array
        if steps < FEWEST_STEPS:
            raise ValueError(f"a log must have at least {FEWEST_STEPS + 1} rows, but {self.name} has {steps + 1}")
        if self.stamps is not None:
            object.__setattr__(self, "stamps", _checked_stamps(self.stamps, steps, self.name))
        object.__setattr__(self, "inputs", held_parts.pop("inputs"))
        object.__setattr__(self, "measurements", held_parts.pop("measurements"))
        object.__setattr__(self, "references", held_parts)

    @property
    def steps(self) -> int:
        """Number K of steps."""
        return len(self.inputs)

    @property
    def times(self) -> np.ndarray:
        """Times of the rows [s], (K + 1,), 0 at row 0."""
        return self.dt * np.arange(self.steps + 1) if self.stamps is None else self.stamps

    @property
    def input_rows(self) -> np.ndarray:
        """The inputs by the rows of the file, (K + 1, p): NaN in the last or, `until` their rows, in the first."""
        nothing = np.full((1, self.inputs.shape[1]), np.nan)
        return np.vstack((nothing, self.inputs) if self.until else (self.inputs, nothing))

    @property
    def resolution(self) -> float:
        """The resolution of the file's stamps in float64 [s]."""
        return resolution_of(abs(self.start) + float(self.times[-1]))

    @property
    def pieces(self) -> tuple[tuple[int, int], ...]:
        """First row and number of rows of each piece between gaps; one piece if there is no gap."""
        ends = [(first, first + count) for first, count in self.recording.gaps]
        starts = [0, *(end for _, end in ends)]
        lasts = [*(first for first, _ in ends), self.steps + 1]
        return tuple((first, last - first) for first, last in zip(starts, lasts, strict=True))

    @cached_property
    def findings(self) -> tuple[Finding, ...]:
        """Findings in the log: `thruster_env.logs.findings.found_in`."""
        return found_in(self)

    @cached_property
    def digest(self) -> str:
        """A short hash of all numbers, dt and units; not of the name."""
        sha = hashlib.sha256(f"{self.dt!r}".encode())
        ones = [*self.input_quantities, *self.measured, *(self.referred[key] for key in sorted(self.references))]
        sha.update("\0".join(f"{quantity.symbol} {quantity.unit}" for quantity in ones).encode())
        for part in (self.inputs, self.measurements, *(self.references[key] for key in sorted(self.references))):
            sha.update(np.ascontiguousarray(part + 0.0).tobytes())
        if self.stamps is not None:
            sha.update(self.stamps.tobytes())
        return sha.hexdigest()[:12]

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of all channels."""
        inputs = (f"{INPUT}:{quantity.symbol}" for quantity in self.input_quantities)
        return (*inputs, *(f"{MEASUREMENT}:{quantity.symbol}" for quantity in self.measured), *self.references)

    def true_states(self, model: StateSpaceModel) -> np.ndarray | None:
        """The states of a model, (K + 1, n), NaN in rows without one; None where no row has all.

        Of a model with rotations as many of its first states as there are: those of its quaternion, at least.
        """
        columns = [self.references.get(f"{STATE}:{state.symbol}") for state in model.states]
        count = next((i for i, column in enumerate(columns) if column is None), len(columns))
        if count < len(columns):
            ends = {turn.stored + turn.size + 1 for turn in model.turns}
            count = max((end for end in ends if end <= count), default=0)
        present = [column for column in columns[:count] if column is not None]
        if not present:
            return None
        states = np.column_stack(present)
        known = ~np.isnan(states).any(axis=1)
        return np.where(known[:, None], states, np.nan) if known.any() else None

    def series(self, channel: str) -> Series:
        """Samples of a channel, at times [s] by its own clock, since row 0."""
        if channel in self.source:
            return self.source[channel]
        kind, _, symbol = self._known(channel).partition(":")
        times = self.times + self.offsets.get(channel, 0.0)
        if channel in self.references:
            values = self.references[channel]
        else:
            quantities, rows = (
                (self.input_quantities, self.inputs) if kind == INPUT else (self.measured, self.measurements)
            )
            values = rows[:, [quantity.symbol for quantity in quantities].index(symbol)]
        times, present = times[: len(values)], ~np.isnan(values)
        return Series(times[present], values[present])

    def named(self, name: str) -> Log:
        """The same log under another name."""
        return replace(self, name=name)

    def _known(self, channel: str) -> str:
        if channel not in self.channels:
            rule = f"a channel of log {self.name} must be one of {', '.join(self.channels)}"
            raise ValueError(f"{rule}, but got {short_repr(channel)}")
        return channel


def at_offset(log: Log, channel: str, seconds: float) -> Log:
    """A log with another clock offset of one channel, which is put on the grid again from its own samples.

    The result is continuous in the offset: see `thruster_env.logs.grid` for how samples are interpolated.

    Args:
        log: a log.
        channel: such as "measurement:speed".
        seconds: how far the channel's clock is ahead of the log's [s]; 0 for as it was recorded.

    Raises:
        ValueError: for an unknown channel, or an offset that is no number.
    """
    if log.stamps is not None:
        raise ValueError(f"a clock offset must move samples on a grid, but log {log.name} has its own stamps")
    seconds, series = finite(f"the clock offset of {channel}", seconds), log.series(channel)
    changes: dict = {"offsets": {**log.offsets, channel: seconds}, "source": {**log.source, channel: series}}
    kind, _, symbol = channel.partition(":")
    arguments = series, log.dt, log.steps + 1, seconds
    if channel in log.references:
        changes["references"] = {**log.references, channel: sampled(*arguments, log.referred[channel].angle)}
    elif kind == INPUT:
        column = [quantity.symbol for quantity in log.input_quantities].index(symbol)
        values = mean_held(series, log.dt, log.steps, seconds, log.input_quantities[column].angle)
        changes["inputs"] = _with_column(log.inputs, column, values)
    else:
        column = [quantity.symbol for quantity in log.measured].index(symbol)
        values = sampled(*arguments, log.measured[column].angle)
        changes["measurements"] = _with_column(log.measurements, column, values)
    return replace(log, **changes)


def seen_by(model: StateSpaceModel, measurements: np.ndarray) -> np.ndarray:
    """Measurements (K + 1, m) of rows of a log as a model can take them.

    If h takes the input, the first is left out, because the input until then is unknown.
    """
    if not model.feeds:
        return measurements
    measurements = measurements.copy()
    measurements[0] = np.nan
    return measurements


def piece_of(log: Log, first: int, rows: int) -> Log:
    """So many rows of a log from one of them on, which remembers the log."""
    kept_rows, since, source = slice(first, first + rows), float(log.times[first]), {}
    for channel, series in log.source.items():
        times = series.times - since
        shifted = times - log.offsets.get(channel, 0.0)
        low = max(int(np.searchsorted(shifted, -0.5 * log.dt)) - 1, 0)  # what is held at the first row
        high = int(np.searchsorted(shifted, (rows - 0.5) * log.dt))
        if channel.partition(":")[0] != INPUT:
            low = int(np.searchsorted(shifted, -0.5 * log.dt))
        source[channel] = Series(times[low:high], series.values[low:high])
    return replace(
        log,
        name=f"{log.name}, rows {first} to {first + rows - 1}",
        inputs=log.inputs[first : first + rows - 1],
        measurements=log.measurements[kept_rows],
        references={key: values[kept_rows] for key, values in log.references.items()},
        start=log.start + since,
        source=source,
        recording=Recording(),
        uncut=log,
        stamps=None if log.stamps is None else log.stamps[kept_rows] - since,
    )


def _checked_stamps(times: np.ndarray, steps: int, name: str) -> np.ndarray:
    stamps = np.array(as_floats(times))
    if stamps.shape != (steps + 1,) or stamps[0] != 0.0 or not (np.diff(stamps) > 0.0).all():
        rule = f"{steps + 1} increasing times from 0 on"
        raise ValueError(f"stamps of log {name} must be {rule}, but got {short_repr(stamps)}")
    stamps.setflags(write=False)
    return stamps


def _with_column(rows: np.ndarray, column: int, values: np.ndarray) -> np.ndarray:
    rows = rows.copy()
    rows[:, column] = values
    return rows


def shared_by(first: Sequence[Log], second: Sequence[Log]) -> tuple[Log, Log] | None:
    """The first pair of logs, one from each group, that share consecutive rows; None if there is none.

    Rows with measurements are compared by inputs and measurements, independent of their times and the logs' names.
    Rows in which no measurement changes, as at rest, are ignored, except in identical logs.
    """
    logs = [*first, *second]
    by_digest = {log.digest: log for log in first}
    for log in second:
        if log.digest in by_digest:
            return by_digest[log.digest], log
    rows = [_measured_rows(log) for log in logs]
    width = max(FEWEST, min(WINDOW, *(len(log_rows) // 2 for log_rows in rows)))
    flat = np.ascontiguousarray(np.concatenate(rows)).view(f"V{8 * rows[0].shape[1]}")[:, 0]
    numbers = np.unique(flat, return_inverse=True)[1].astype(np.uint64)
    pieces = np.split(numbers, np.cumsum([len(log_rows) for log_rows in rows])[:-1])
    inputs = first[0].inputs.shape[1]
    hashes = [_hashes(piece, log_rows[:, inputs:], width) for piece, log_rows in zip(pieces, rows, strict=True)]
    log_of_hash: dict[int, Log] = {}
    for log, log_hashes in zip(first, hashes, strict=False):
        log_of_hash.update(dict.fromkeys(log_hashes.tolist(), log))
    for log, log_hashes in zip(second, hashes[len(first) :], strict=True):
        common = next((hash_ for hash_ in log_hashes.tolist() if hash_ in log_of_hash), None)
        if common is not None:
            return log_of_hash[common], log
    return None


def _measured_rows(log: Log) -> np.ndarray:
    measured = ~np.isnan(log.measurements[:-1]).all(axis=1)
    return np.column_stack((log.inputs, log.measurements[:-1]))[measured] + 0.0


def _hashes(numbers: np.ndarray, measured: np.ndarray, width: int) -> np.ndarray:
    """A hash of each window of `width` rows in which measurements change at least every other row."""
    count = len(numbers) - width + 1
    if count < 1:
        return np.empty(0, np.uint64)
    total: np.ndarray = np.zeros(count, np.uint64)
    for offset in range(width):
        total = total * FACTOR + (numbers[offset : offset + count] + np.uint64(1))
    changes = np.append(0, np.cumsum((np.diff(measured, axis=0) != 0).any(axis=1)))
    return np.unique(total[changes[width - 1 :] - changes[:count] >= width // 2])


class AnyStepModel(StateSpaceModel):
    """A model whose last input is the step ratio; see `in_any_steps`.

    Attributes:
        plain: the model of a step of dt, which is what tuned files are for.
    """

    plain: StateSpaceModel

    def replace(self, **changes) -> AnyStepModel:
        """A copy with some fields of the plain model changed; ValueError as for a new model."""
        return in_any_steps(self.plain.replace(**changes))

    @property
    def any_shape(self) -> Shape:
        """Sizes, with the flag that pages multiply Q by the last input."""
        return super().any_shape._replace(step_ratio=True)


def in_any_steps(model: StateSpaceModel, dt: float | None = None) -> AnyStepModel:
    """The model with the step ratio r as one more input, for filters with a page and their likelihood.

    Args:
        model: whose sample time is one of its constants, `dt`, or `substep` for a part of it.
        dt: that of the logs [s], which must be the model's; None if it is known to be.

    Raises:
        ValueError: for a model of one sample time, or of another one than the logs.
    """
    index, _ = sample_time_place(model, "a filter on a log's own stamps")
    model_dt = sample_time_of(model, "")
    if dt is not None and not same_dt(model_dt, dt):
        raise ValueError(f"the dt of logs on their own stamps must be the model's {model_dt:g} s, but is {dt:g} s")
    fields: dict[str, Any] = {name: getattr(model, name) for name in StateSpaceModel.__dataclass_fields__}
    form, count, inputs = type(model.constants), len(model.constants), model.inputs
    fields["transition"] = with_ratio(model.transition, form, count, index, inputs)
    slopes = model.transition_jacobian
    if slopes is not None:
        exact = by_complex_step(slopes)  # which is found anew
        fields["transition_jacobian"] = None if exact else with_ratio(slopes, form, count, index, inputs)
    for name in ("observe", "observe_jacobian") if model.feeds else ():
        function = getattr(model, name)
        if function is not None:
            fields[name] = None if by_complex_step(function) else without_ratio(function, inputs)
    if model.operating_input is not None:
        fields["operating_input"] = np.append(model.operating_input, 1.0)
    fields |= {
        "inputs": inputs + 1,
        "input_quantities": (*model.input_quantities, RATIO),
        "operating_points": None,
    }
    any_step = AnyStepModel(**fields)
    object.__setattr__(any_step, "plain", model)
    return any_step


def sample_time_of(model: StateSpaceModel, what: str) -> float:
    """The sample time of a model in which it is a constant [s]; ValueError, with `what` needs it, for others."""
    index, parts = sample_time_place(model, what)
    return float(model.constants[index]) * parts


def in_steps_of(model: StateSpaceModel, length: float) -> StateSpaceModel:
    """The model for steps of another length [s], with Q in proportion to it.

    Raises:
        ValueError: for a model whose sample time is no constant.
    """
    index, parts = sample_time_place(model, "a step of another length")
    ratio = length / (float(model.constants[index]) * parts)
    if same_dt(ratio, 1.0):
        return model
    of_model: Any = model.constants
    constants = of_model._replace(**{of_model._fields[index]: length / parts})
    return model.replace(constants=constants, process_noise_cov=ratio * model.process_noise_cov)


def of_one_step(model: StateSpaceModel) -> StateSpaceModel:
    """The plain model of one of any steps; any other model itself."""
    return model.plain if isinstance(model, AnyStepModel) else model


@makes_functions
def with_ratio(function: Callable, form: type, count: int, index: int, inputs: int) -> Callable:
    """`function(x, u, c)` with constant `index` multiplied by the last input, u[inputs]."""
    constants = (f"c[{i}] * u[{inputs}]" if i == index else f"c[{i}]" for i in range(count))
    names: dict[str, Any] = {"function": function, "form": form}
    return written_out("stepped", "x, u, c", f"function(x, u[:{inputs}], form{tuple_of(constants)})", **names)


@makes_functions
def without_ratio(function: Callable, inputs: int) -> Callable:
    """`function(x, u, c)` of the inputs before the last one."""
    return written_out("seen", "x, u, c", f"function(x, u[:{inputs}], c)", function=function)


def in_steps(log: Log) -> tuple[np.ndarray, np.ndarray]:
    """Inputs (K', p + 1) with step ratios, and measurements (K' + 1, m), of a log on its own stamps.

    A longer step than dt is divided into equal ones that are at most as long, as `filters.live` does it; there
    is no measurement between them.
    """
    lengths = np.diff(log.times)
    counts = np.array([count_steps(length, log.dt, log.resolution) for length in lengths.tolist()], dtype=int)
    ratios = np.repeat(lengths / counts / log.dt, counts)
    measurements = np.full((len(ratios) + 1, log.measurements.shape[1]), np.nan)
    measurements[np.concatenate([[0], np.cumsum(counts)])] = log.measurements
    return np.column_stack([np.repeat(log.inputs, counts, axis=0), ratios]), measurements


def sample_time_place(model: StateSpaceModel, what: str) -> tuple[int, int]:
    """Index of the constant that is the sample time, and the number of substeps in a step.

    Args:
        model: any.
        what: needs it, for the message.

    Raises:
        ValueError: for a model without one, or with both of them, or whose other constants follow from it.
    """
    names = getattr(model.constants, "_fields", ())
    called = "needs" if what == "set_dt" else "must be of"
    if "of_one_dt" in names:
        rule = f"{what} {called} a model whose other constants do not follow from dt"
        raise ValueError(f"{rule}, but got those of lagging sensors")
    if "dt" in names and "substep" in names:
        raise ValueError(f"{what} {called} a model with one of the constants dt and substep, but got both")
    for name, parts in (("dt", 1), ("substep", model.substeps)):
        if name in names:
            return names.index(name), parts
    raise ValueError(
        f"{what} {called} a model with a constant dt, but got {', '.join(names) or 'none'}: write f(x, u, c) "
        "with c.dt, for a filter such as 'ekf'"
    )
