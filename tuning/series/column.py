"""One column of numbers with its times, or the columns of a track's axes, read as logs are.

Where steps are equal but for the rounding of times, numbers lie on a grid, NaN where one is missing; otherwise
each has its own time, and a gap is a long step.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from filters.models import Scales, named_model
from thruster_env.core.checks import as_floats, listed, one_of, short_repr
from thruster_env.logs.columns import COUNTERS, DATE_NAMES, TIME, TIME_NAMES, parted
from thruster_env.logs.findings import (
    CLOCK,
    GAP,
    MISSING,
    OUTLIER,
    PLACEHOLDER,
    REPEATED,
    STUCK,
    WRAPPED,
    Remark,
    sentences,
)
from thruster_env.logs.grid import resolution_of_digits
from thruster_env.logs.log import Log
from thruster_env.logs.read import read_log
from thruster_env.logs.recorders.registry import format_of
from thruster_env.logs.table import TIME_HEADER, Table, read_table, refuse_holes, table_of
from thruster_env.model.quantities import Quantity
from thruster_env.model.state_space import StateSpaceModel

LEAST_ROWS = 20  # with a number
SPARSE = 2.0  # rows of a grid a number, from which on numbers have their own times
COARSE = 0.5  # most values of a quantised column in its numbers
DIGITS = 1e-12  # of the largest number: noise that is rounding
MOST_AXES = 6
RANGES = 1e-60, 1e60  # of a column's numbers, of which Q and R are squares
YEAR = 365.25 * 86400.0
LONG_UNITS = (
    ("years", YEAR, 2.0 * YEAR),
    ("days", 86400.0, 172800.0),
    ("h", 3600.0, 3600.0),
    ("min", 60.0, 0.0),
)  # seconds, and from which on
WIDTHS, PEAKS = (1, 5, 21), 2  # by how many points a spectrum is smoothed, and how many of its peaks are tried


@dataclass(frozen=True, eq=False)
class Column:
    """Numbers and their times, NaN where there is none: one column, or one for each axis of a track.

    Attributes:
        values: (K,), or (K, axes).
        dt: sample time [s], of unequal steps the usual one.
        quantities: name, symbol and unit of the numbers of each axis.
        remarks: what was found while they were read, in sentences.
        stamps: times of the rows [s], (K,), 0 at the first, where steps are unequal; otherwise None.
        turns: what was a whole turn of each axis, before turns were added so that its numbers go on; 0 for others.
    """

    values: np.ndarray
    dt: float
    quantities: tuple[Quantity, ...]
    remarks: tuple[str, ...] = ()
    stamps: np.ndarray | None = None
    turns: tuple[float, ...] = ()

    @property
    def times(self) -> np.ndarray:
        """Times of the rows since the first [s], (K,)."""
        return self.dt * np.arange(len(self.values)) if self.stamps is None else self.stamps

    @property
    def table(self) -> np.ndarray:
        """The numbers, (K, axes)."""
        return self.values.reshape(len(self.values), -1)

    @cached_property
    def measured(self) -> np.ndarray:
        """Where there is a number, (K, axes)."""
        return ~np.isnan(self.table)

    def counted(self, model: StateSpaceModel) -> np.ndarray:
        """Numbers that come after those from which a model's filter learns its state, (K, axes)."""
        return self.measured & (np.cumsum(self.measured, axis=0) > model.n // model.m)

    @cached_property
    def first(self) -> np.ndarray:
        """The first number of each axis, (axes,)."""
        return self.table[self.measured.argmax(axis=0), range(len(self.quantities))]

    @cached_property
    def mean(self) -> np.ndarray:
        """The mean of the numbers of each axis, (axes,)."""
        return np.nanmean(self.table, axis=0)

    @cached_property
    def scales(self) -> Scales:
        """The spread of the data, root mean squares of the axes, their times and strongest frequencies."""
        times, spreads = self.times, np.nanstd(self.table, axis=0)
        duration = float(times[-1] - times[0])
        roughness = [_roughness(times, *axis) for axis in zip(self.table.T, spreads.tolist(), strict=True)]
        peaks = _peaks(times, self.table[:, int(spreads.argmax())], self.dt)
        noise = max(_root_mean_square(roughness), self.rounding)
        return Scales(_root_mean_square(spreads), noise, self.dt, duration, peaks)

    @cached_property
    def resolutions(self) -> np.ndarray:
        """The step in which the numbers of each axis are rounded, (axes,), 0 if they are not."""
        axes = zip(self.table.T, self.measured.T, strict=True)
        return np.array([resolution_of_values(axis[measured]) for axis, measured in axes])

    @property
    def rounding(self) -> float:
        """Deviation of noise that may be that of rounding."""
        return DIGITS * float(np.nanmax(np.abs(self.table)))

    def check_noise(self) -> None:
        """Raise ValueError for numbers that lie on a smooth curve, from which no Q and R follow."""
        if self.scales.roughness <= self.rounding:
            name = ", ".join(quantity.name for quantity in self.quantities)
            rule = f"{name} must have noise, from which Q and R follow"
            raise ValueError(f"{rule}, but its numbers lie on a smooth curve to {DIGITS:g} of the largest")

    def without(self, rows: np.ndarray) -> Column:
        """The column without the numbers of which a mask (K, axes) is true."""
        return replace(self, values=np.where(rows, np.nan, self.table).reshape(self.values.shape))

    @property
    def backwards(self) -> Column:
        """The column with its last number first."""
        stamps = None if self.stamps is None else (self.stamps[-1] - self.stamps)[::-1]
        return replace(self, values=self.values[::-1], stamps=stamps)

    def axis(self, index: int) -> Column:
        """One axis alone."""
        alone = slice(index, index + 1)
        return replace(
            self, values=self.table[:, index], quantities=self.quantities[alone], turns=self.turns[alone]
        )

    def middle(self, most: int) -> Column:
        """The column itself, or its middle rows if it has more than `most`."""
        excess = len(self.values) - most
        if excess <= 0:
            return self
        return self.rows(excess // 2, excess // 2 + most)

    def rows(self, begin: int, end: int) -> Column:
        """Some rows of the column."""
        stamps = None if self.stamps is None else self.stamps[begin:end] - self.stamps[begin]
        return replace(self, values=self.values[begin:end], stamps=stamps)


def column_of(z: Any, dt: Any = None, *, times: Any = None, column: str | Sequence[str] | None = None) -> Column:
    """The numbers on a grid if their steps are equal, as the reader of logs puts them there; else at their times.

    Args:
        z: numbers (K,) or (K, axes), a pandas Series or table, a mapping from headers to arrays, or the path of
            a log.
        dt: sample time [s], for numbers without times, or to which F and Q of the answer belong; or the steps
            between numbers, (K - 1,).
        times: of an array's numbers [s], (K,).
        column: header of the numbers in a table with several columns, or one for each axis, also as "x,y".

    Raises:
        ValueError: states the rule and the value.
    """
    if np.ndim(dt) == 1:
        if times is not None:
            raise ValueError("numbers must have times (times=) or the steps between them (dt=), but got both")
        dt, times = None, np.cumsum([0.0, *as_floats(dt)])
    is_table = isinstance(z, str | Path | Mapping) or hasattr(z, "columns")
    if is_table and times is not None:
        rule = "the times of a table or a file must be one of its columns"
        raise ValueError(f"{rule}, but got {short_repr(times)} beside it")
    named = column.split(",") if isinstance(column, str) else column
    log, stamps = log_of_columns(z, named, dt=dt, times=times), None
    if log.offsets:
        text = ", ".join(f"{key.partition(':')[2]} = {seconds:g}" for key, seconds in log.offsets.items())
        raise ValueError(f"columns of a fit must have one clock, but [clock_offset] of {log.name} has {text}")
    has_gaps = len(log.measurements) > SPARSE * (~np.isnan(log.measurements)).any(axis=1).sum()
    if log.irregular or has_gaps or log.recording.jitter > 0.0:
        at_times = log_of_columns(z, named, dt=dt, times=times, grid=False)
        if (
            log.irregular
            or has_gaps
            or log.recording.jitter > resolution_of_digits(at_times.times + at_times.start, log.dt)
        ):
            log, stamps = at_times, at_times.times
    channels = [f"measurement:{quantity.symbol}" for quantity in log.measured]
    of_turns = dict(log.recording.turns)
    turns = tuple(of_turns.get(channel, 0.0) for channel in channels)
    if any(remark.kind == REPEATED for remark in log.recording.remarks):
        return replace(_slower(log), turns=turns)
    table, findings = log.measurements.copy(), []
    for finding in log.findings:
        if finding.kind == STUCK:
            table[finding.first : finding.last + 1, channels.index(finding.channel)] = np.nan
            finding = replace(finding, sentence=f"{finding.sentence}: they are left out")
        if finding.kind not in (GAP, MISSING) * (stamps is None) + (OUTLIER,):  # one sentence tells all
            findings.append(finding)
    for quantity, numbers in zip(log.measured, table.T, strict=True):
        _check_numbers(quantity.symbol, numbers)
    values = table[:, 0] if len(log.measured) == 1 else table
    missing = [] if stamps is not None else _missing(log.measurements, log.dt)
    return Column(values, log.dt, log.measured, (*sentences(findings), *missing), stamps, turns)


def _slower(log: Log) -> Column:
    """The column of a sensor that is slower than its log, at its own rate: of the rows with a measurement."""
    rows = (~np.isnan(log.measurements)).any(axis=1)
    units = [f"[{quantity.unit}]" if quantity.unit else "" for quantity in log.measured]
    headers = [f"{quantity.name}{unit}" for quantity, unit in zip(log.measured, units, strict=True)]
    columns = dict(zip(headers, log.measurements[rows].T, strict=True))
    column = column_of({TIME_HEADER: log.times[rows], **columns}, column=headers)
    kinds = PLACEHOLDER, REPEATED, WRAPPED
    remarks = sentences([finding for finding in log.findings if finding.kind in kinds])
    return replace(column, remarks=(*remarks, *column.remarks))


def _missing(values: np.ndarray, dt: float) -> list[str]:
    """How many rows of a grid have no number, and where; none if all have one."""
    lost = np.isnan(values).all(axis=1)
    ends = np.flatnonzero(np.diff(np.concatenate([[False], lost, [False]])))
    lengths = ends[1::2] - ends[::2]
    if not len(lengths):
        return []
    rows, longest = int(lengths.sum()), int(lengths.max())
    text = f"{rows} of {len(lost)} row{' is' if rows == 1 else 's are'} missing, in {len(lengths)} place"
    more = f", the longest of {longest} rows ({seconds_text(longest * dt)})" if longest > 1 else ""
    return [f"{text}{'s' * (len(lengths) > 1)}{more}."]


def log_of_columns(
    z: Any,
    named: Sequence[str] | None,
    axes: int = 1,
    *,
    dt: float | None = None,
    times: Any = None,
    **options: Any,
) -> Log:
    """Columns of numbers as a log without inputs, whose measurements are named by their headers.

    Args:
        z: as `column_of` takes it.
        named: headers, one for each axis; None where there are as many columns as axes.
        axes: number of columns without names.
        dt: sample time [s], for numbers without times, or of the grid.
        times: as `column_of` takes it.
        **options: others of `thruster_env.logs.read.read_log`.

    Raises:
        ValueError: for another number of columns, an unknown header, or too few numbers.
    """
    is_table = isinstance(z, str | Path | Mapping) or hasattr(z, "columns")
    source: Any = z if is_table else as_columns(z, times)
    is_file = isinstance(source, str | Path)
    recorded, table = is_file and format_of(source) is not None, None
    if recorded:
        if named is None:
            rule = "the column of a recorder's file must be named (column=, --column TOPIC.FIELD)"
            raise ValueError(f"{rule}, but got none for {source}: `thruster log {source}` lists them")
        headers, time = list(named), None
    else:
        table = read_table(source) if is_file else table_of(source, options.get("name") or "a table")
        if named is not None and ",".join(named) in table.names:
            named = [",".join(named)]
        if named is None and source is not z and isinstance(source, Mapping):
            named = [name for name in source if name not in (TIME, TIME_HEADER)]
        headers, time = _headers(table, named, axes)
        for header in headers:
            _check_numbers(header, table.numbers(header))
    quantities = tuple(map(_quantity, headers))
    reader = named_model("constant").model({"drift": 1.0}, 1.0, 1.0, quantities=quantities)
    columns = {quantity.symbol: header for quantity, header in zip(quantities, headers, strict=True)}
    columns |= {} if time is None else {TIME: time}
    if time is None and hasattr(z, "iloc"):
        refuse_holes(z.index)
    options["dt"] = 1.0 if dt is None and time is None and not recorded else dt
    options = {key: value for key, value in options.items() if value is not None}
    log = read_log(source, reader, columns, table=table, unwrap=True, **options)
    if not is_table or recorded or time is not None or dt is not None or table is None:
        return log
    further = [name for name in table.names if name not in headers]
    way = f"give --dt, or --column {headers[0]},{TIME}={further[0]}" if further else "give --dt"
    text = f"no column of times was found (columns {listed(table.names)}): 1 s is assumed, {way}"
    remarks = (*log.recording.remarks, Remark(CLOCK, "", text))
    return replace(log, recording=log.recording._replace(remarks=remarks))


def _quantity(header: str) -> Quantity:
    """Name, symbol and unit that a header states."""
    base, unit = parted(header)
    symbol = re.sub(r"[^A-Za-z0-9_-]+", "_", base).strip("_") or "z"
    return Quantity(base.strip(), symbol, unit or "")  # which the answer has, too


def _check_numbers(header: str, values: np.ndarray) -> None:
    count = int(np.count_nonzero(~np.isnan(values)))
    if count < LEAST_ROWS:
        raise ValueError(f"{header} must have at least {LEAST_ROWS} numbers, but has {count}")
    width = float(np.nanmax(values)) - float(np.nanmin(values))
    if 0.0 < width < math.inf and not RANGES[0] < width < RANGES[1]:
        rule = f"{header} must vary by {RANGES[0]:g} to {RANGES[1]:g}, whose squares are numbers"
        raise ValueError(f"{rule}, but varies by {width:.3g}: use another unit")


def seconds_text(seconds: float) -> str:
    """A time, beyond two minutes also in minutes, hours or days: "86400 s (24 h)"."""
    text = f"{seconds:.4g}" if seconds < 1e4 else f"{seconds:.0f}"
    if not 120.0 < seconds < math.inf:
        return f"{seconds:.3g} s"
    unit, size, _ = next(unit for unit in LONG_UNITS if seconds >= unit[2])
    return f"{text} s ({_short(seconds / size)} {unit})"


def _short(value: float) -> str:
    return f"{value:.3g}" if value < 999.5 else f"{value:.0f}"


def is_numbers(z: Any) -> bool:
    """Whether something is an array, a list of numbers or a pandas Series, and no table."""
    if isinstance(z, np.ndarray) or hasattr(z, "to_frame") and not hasattr(z, "columns"):
        return True
    first = z[0] if isinstance(z, list | tuple) and len(z) else ""
    return (
        first is None
        or isinstance(first, int | float | np.number)
        or isinstance(first, list)
        and is_numbers(first)
    )


def as_columns(z: Any, times: Any = None) -> Mapping[str, Any]:
    """An array, a list or a pandas Series as a table or a mapping from headers to arrays."""
    if hasattr(z, "to_frame") and times is None:
        return z.to_frame(z.name or "z")
    try:
        numbers = (z if isinstance(z, np.ma.MaskedArray) else np.asarray(z)).tolist()  # with None where masked
        values = np.array(numbers, dtype=float)  # NaN for None
    except (TypeError, ValueError):
        raise ValueError(f"z must be numbers, but got {short_repr(z)}") from None
    if values.ndim == 2 and 1 in values.shape:
        values = values.ravel()
    if values.ndim not in (1, 2) or values.ndim == 2 and values.shape[1] > MOST_AXES:
        rule = f"z must be a column of numbers, (K,), or one for each of at most {MOST_AXES} axes, (K, axes)"
        raise ValueError(f"{rule}, but has shape {values.shape}: fit each column alone")
    if times is not None and np.shape(times) != values.shape[:1]:
        rule = "there must be a time for each number, so one step (dt=) fewer"
        raise ValueError(f"{rule}, but got {len(values)} numbers and {np.size(times)} times")
    columns = {"z": values} if values.ndim == 1 else {f"z_{i + 1}": axis for i, axis in enumerate(values.T)}
    if times is None:
        return columns
    stamps = np.asarray(times)
    return {TIME_HEADER if stamps.dtype.kind in "iuf" else TIME: stamps, **columns}


def _headers(table: Table, named: Sequence[str] | None, axes: int = 1) -> tuple[list[str], str | None]:
    """The headers of the numbers and that of the times; ValueError for other columns than axes without names."""
    times = _times(table, named or ())
    numbers = [name for name in table.names if name not in times and not table.is_text(name)]
    time = next((name for name in times if _increases(table, name)), times[0] if times else None)
    unit = COUNTERS.get((time or "").strip().lower())
    time = f"{time}[{unit}]" if unit else time
    if named is not None:
        stated = [text.partition("=")[2] for text in named if _is_time(text, table)]
        named = [text for text in named if not _is_time(text, table)]
        by_name = {parted(name)[0].strip().lower(): name for name in table.names}
        of = {header: header if header in table.names else by_name.get(header.strip().lower()) for header in named}
        headers = [of[each] or one_of(f"a column of {table.file}", each.strip(), table.names) for each in named]
        time = stated[0] if stated else time
        if headers:
            return headers, time
        numbers = [name for name in numbers if name != time]
    if len(numbers) != axes:
        count = "one column" if axes == 1 else f"{axes} columns"
        rule = f"a file must have {count} of numbers beside its times, or columns must be named"
        way = "column=, --column HEADER, or --column X,Y for the axes of a track"
        raise ValueError(f"{rule} ({way}), but {table.file} has {listed(numbers or table.names)}")
    return numbers, time


def _is_time(text: str, table: Table) -> bool:
    return text not in table.names and text.strip().startswith(f"{TIME}=")


def _times(table: Table, named: Sequence[str]) -> list[str]:
    """The columns that may be times, by their names or as they hold dates.

    T is a temperature, unless its values increase and nothing else has a name of times.
    """
    known = {*map(str.lower, TIME_NAMES), *DATE_NAMES, *COUNTERS}
    free = [name for name in table.names if name not in named]
    times = [name for name in free if parted(name)[0].strip().lower() in known and parted(name)[0].strip() != "T"]
    times += [name for name in free if name not in times and table.dates(name) is not None]
    return times or [name for name in free if parted(name)[0].strip() == "T" and _increases(table, name)]


def _increases(table: Table, name: str) -> bool:
    """Whether a column holds times or numbers of which each is larger than the one before."""
    try:
        values = table.dates(name)
        values = table.numbers(name) if values is None else values
    except ValueError:
        return False
    return len(values) > 1 and bool((np.diff(values) > 0.0).all())


def _roughness(times: np.ndarray, values: np.ndarray, spread: float) -> float:
    """The least deviation of divided differences of order 1 to 4, over that of white noise."""
    known = ~np.isnan(values)
    times, values, deviations = times[known], values[known], [spread]
    longest = float(np.quantile(np.diff(times), 0.8))
    for order in range(1, 5):
        points = [np.arange(i, len(times) - order + i) for i in range(order + 1)]
        close = times[points[-1]] - times[points[0]] <= (order + 0.5) * longest
        weights = [
            1.0 / np.prod([(times[i] - times[j]) / longest for j in points if j is not i], axis=0) for i in points
        ]
        scale = np.sqrt(sum(weight**2 for weight in weights))
        differences = sum(weight * values[i] for weight, i in zip(weights, points, strict=True)) / scale
        if np.count_nonzero(close) >= LEAST_ROWS // 2:
            deviations.append(float(np.std(differences[close])))
    return min(deviations)


def _root_mean_square(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _peaks(times: np.ndarray, values: np.ndarray, dt: float) -> tuple[float, ...]:
    """Frequencies of the highest peaks of the spectrum [Hz], as it is for sharp ones, smoothed for wide ones.

    The trend is taken off; numbers are moved to multiples of dt, and missing ones lie on the trend.
    """
    known = ~np.isnan(values)
    trend = np.polynomial.Polynomial.fit(times[known], values[known], 1)(times)
    rows = np.round(times / dt).astype(np.int64)
    filled = np.zeros(rows[-1] + 1)
    filled[rows[known]] = (values - trend)[known]
    power = np.abs(np.fft.rfft(filled * np.hanning(len(filled)))) ** 2
    frequencies, peaks = np.fft.rfftfreq(len(filled), dt)[1:], []
    for width in WIDTHS:
        smooth = np.convolve(power[1:], np.ones(width) / width, "same")[: len(frequencies)]
        for _ in range(PEAKS):
            highest = int(np.argmax(smooth))
            peaks.append(float(frequencies[highest]))
            smooth[max(highest - 2 * width, 0) : highest + 2 * width + 1] = 0.0
    return tuple(dict.fromkeys(peaks))


def resolution_of_values(values: np.ndarray) -> float:
    """The step of which all differences of numbers without NaN are multiples, 0 if there is none."""
    levels = np.unique(values)
    if len(levels) < 2 or len(levels) > COARSE * len(values):
        return 0.0
    steps = np.diff(levels)
    rounding = 1e-12 * float(np.abs(levels).max())
    steps = steps[steps > 2.0 * rounding]  # the same number in other digits
    unit = float(steps.min(initial=math.inf))
    off = np.abs(steps - unit * np.round(steps / unit)) if math.isfinite(unit) else np.ones(1)
    return unit if (off <= 1e-6 * unit + 2.0 * rounding).all() else 0.0
