"""Logs from tables and recorders' files, and an optional TOML file beside one that describes its columns."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from os import PathLike
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from thruster_env.core.angles import difference
from thruster_env.core.checks import finite, listed, one_of, positive, short_repr
from thruster_env.core.files import read_toml
from thruster_env.logs import quaternions
from thruster_env.logs.columns import (
    INPUT,
    MEASUREMENT,
    TIME,
    Column,
    Wanted,
    converted,
    find_columns,
    find_wanted,
    quantities_of,
)
from thruster_env.logs.findings import CLOCK, STALE, Recording, Remark, turn_of, unmeasured
from thruster_env.logs.grid import (
    CLOSE_TO_GRID,
    MOST_HELD,
    TOLERANCE,
    Grid,
    Series,
    closeness,
    grid_of,
    mean_held,
    resolution_of,
    sampled,
)
from thruster_env.logs.log import FEWEST_STEPS, Log
from thruster_env.logs.recorders.registry import Recorded, check_stamps, format_of
from thruster_env.logs.table import Table, read_table, table_of
from thruster_env.logs.times import follows, in_seconds, time_text
from thruster_env.model.state_space import StateSpaceModel

INPUTS_ACT = ("from", "until", "between")  # when the input of a row acts
MOST_STEPS = 10_000_000
MOST_DOUBLED = 0.1  # of the rows, with the time of the row before; of more the times are wrong


class Description(NamedTuple):
    """A description of the columns of a file, in addition to its header."""

    columns: Mapping[str, str] = {}  # headers by quantity: {"thrust": "loadcell[kgf]"}
    units: Mapping[str, str] = {}  # by header
    clock_offset: Mapping[str, float] = {}  # by quantity [s]: how far its clock is ahead
    dt: float | None = None  # sample time [s]: of rows without a time, or of the grid to put irregular ones on
    stamps: str | None = None  # of a bag: "header" or "receipt"
    inputs_act: str | None = None  # "from" their rows on, "until" these, or in the mean "between" two

    def updated(self, other: Description) -> Description:
        """This one, overridden by the other."""
        return Description(
            columns={**self.columns, **other.columns},
            units={**self.units, **other.units},
            clock_offset={**self.clock_offset, **other.clock_offset},
            dt=self.dt if other.dt is None else other.dt,
            stamps=self.stamps if other.stamps is None else other.stamps,
            inputs_act=self.inputs_act if other.inputs_act is None else other.inputs_act,
        )


def at_own_stamps(
    series: Mapping[str, Series],
    inputs: Collection[str],
    offsets: Mapping[str, float],
    dt: float,
    end: float,
    start: float = 0.0,
) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """The times (K + 1,) [s] of a log's rows, and each channel at them: inputs (K,), others (K + 1,) with NaN.

    A row is a time at which any channel has a sample; a channel's clock offset is subtracted from its stamps
    first. The first row has the first stamp of the file, and what was sampled before it or after the last one is
    left out. Inputs are held from sample to sample, before the first at its value. Nothing is moved, averaged or
    interpolated.

    Args:
        series: samples by channel, at times since the first stamp.
        inputs: channels that are inputs.
        offsets: clock offsets by channel [s].
        dt: sample time [s]: stamps that are within a billionth of it, or their rounding, are one.
        end: the last stamp [s].
        start: the first stamp [s], as the file has it.
    """
    near = closeness(dt, resolution_of(abs(start) + end))
    shifted = {key: samples.times - offsets.get(key, 0.0) for key, samples in series.items()}
    stamps = np.sort(np.concatenate([np.zeros(1), *shifted.values()]))
    stamps = stamps[(stamps >= -near) & (stamps <= end + near)]
    times = stamps[np.append(True, np.diff(stamps) > near)]
    times[0] = 0.0
    columns = {}
    for key, samples in series.items():
        if key in inputs:
            row = np.searchsorted(shifted[key], times[:-1] + near, side="right") - 1
            columns[key] = samples.values[np.maximum(row, 0)]
            continue
        within = (shifted[key] >= -near) & (shifted[key] <= end + near)
        row = np.searchsorted(times, shifted[key][within] + near, side="right") - 1
        columns[key] = np.full(len(times), np.nan)
        columns[key][row] = samples.values[within]  # of two of one time the last
    return times, columns


# Of inputs without samples.
LONG = 0.1  # of the log at its end
LONGER = 10.0  # than the longest time between two samples of the input


def stale_inputs(inputs: Mapping[str, Series], end: float, dt: float, start: float) -> list[Remark]:
    """Inputs without a sample after the first row, or in the last part of the log.

    An input whose clock is not that of the measurements looks like this, but so does a constant one that is sent
    once.

    Args:
        inputs: samples by channel, at times since row 0 [s].
        end: time of the last row since row 0 [s].
        dt: sample time [s].
        start: time stamp of row 0 [s].
    """
    remarks = []
    for key, samples in inputs.items():
        name, last = key.partition(":")[2], float(samples.times[-1])
        if last <= CLOSE_TO_GRID * dt:
            text = f"{name} has no sample after the first row: it is held at {samples.values[-1]:.6g} in all rows"
            remarks.append(Remark(STALE, key, text))
        elif end - last > max(LONG * end, LONGER * float(np.diff(samples.times).max(initial=dt))):
            begun = time_text(start + last, dt)
            text = f"{name} has no sample after {begun} s: it is held at {samples.values[-1]:.6g} for the last "
            remarks.append(Remark(STALE, key, f"{text}{end - last:.4g} s"))
    return remarks


def read_log(
    path: Any,
    model: StateSpaceModel,
    columns: Mapping[str, str] | None = None,
    *,
    clock_offset: Mapping[str, float] | None = None,
    dt: float | None = None,
    grid: bool = True,
    stamps: str | None = None,
    inputs_act: str | None = None,
    name: str = "a table",
    table: Table | None = None,
    unwrap: bool = False,
) -> Log:
    """Read a log of a model's inputs and measurements from a file; columns of states and outputs are references.

    Columns are found by their headers (`thruster_env.logs.columns.find_columns`), converted to the model's
    units (`thruster_env.logs.columns`) and put on a grid (`thruster_env.logs.grid`). Times are
    numbers, or ISO 8601 dates, the first of which is time 0. A file beside it, run.toml for run.csv, may say

        dt = 0.01
        stamps = "receipt"
        inputs_act = "until"
        [columns]
        thrust = "loadcell[kgf]"
        [units]
        "motor" = "rpm"
        [clock_offset]
        thrust = -0.06

    and the arguments take precedence over it.

    Args:
        path: a file that ends in .csv, .parquet or .npz, or a recorder's
            (`thruster_env.logs.recorders.registry`); or a table itself: a mapping from headers to arrays
            (rows,), or a pandas.DataFrame.
        model: its inputs and measurements must be in the file.
        columns: headers by the symbol or name of a quantity, or "kind:symbol"; "HEADER[UNIT]" with another unit.
        clock_offset: how far a channel's clock is ahead [s].
        dt: sample time [s], for files without a time column, or whose time stamps lie on no grid.
        grid: whether samples are put on a grid; else rows are the times of samples
            (`thruster_env.logs.grid`), and `dt` is the sample time to which covariances belong.
        stamps: of a bag, the clock of all topics: "header" or "receipt"; by default that of the headers if all
            topics have stamps of one clock (`thruster_env.logs.recorders.bags`).
        inputs_act: whether the input of a row acts "from" it on, as a command that is sent then, or "until" it, as
            a current that is sampled with the voltage; "between" takes the mean of two rows, as for a rate of the
            instant. By default "until" for a model whose measurements have
            feed-through, h(x, u, c), or whose states have rotations, as a gyroscope is sampled with them, and
            "from" for others.
        name: of a log that is not a file.
        table: of the file, if it was read before.
        unwrap: whether whole turns are added to measured angles that wrap, for a linear model.

    Raises:
        ValueError: if a column is missing, or a value is wrong; it names file, line and column.
    """
    is_file = isinstance(path, (str, PathLike))
    for what, mapping in (("columns", columns), ("clock offsets", clock_offset)):
        if not isinstance(mapping, Mapping | None):
            raise ValueError(f"{what} must be a mapping from quantities, but got {short_repr(mapping)}")
    description_file = _described(Path(path)) if is_file else Description()
    description = description_file.updated(
        Description(columns or {}, {}, clock_offset or {}, dt, stamps, inputs_act)
    )
    act = description.inputs_act or ("until" if model.feeds or model.turns else "from")
    until = one_of("inputs_act", act, INPUTS_ACT) != "from"
    wanted = quantities_of(model)
    form = format_of(path) if is_file else None
    if form is not None:
        asked = [text for text in description.columns.values() if isinstance(text, str)]
        recorded = Recorded(path, form, asked, description.stamps)
        by_key = recorded.columns(wanted, description.columns, description.units, description.dt is None)
        if model.turns and not form.has_stamps:
            by_key |= quaternions.named_columns(model, [*recorded.samples], by_key)
        table, column_of = recorded.table(by_key)
    else:
        check_stamps(description.stamps, None, path if is_file else name)
        if table is None:
            table = read_table(path) if is_file else table_of(path, name)
        column_of = find_columns(
            wanted, table.names, description.columns, description.units, table.file, description.dt is None
        )
        if model.turns:
            column_of = column_of | quaternions.named_columns(model, table.names, column_of)
    file = table.file
    of_file, start, assumption = _grid(table, column_of.get(TIME), description.dt, file, grid)
    dt = of_file.dt
    offsets = _offsets(description.clock_offset, wanted, column_of, of_file, file)
    common = {offsets.get(channel.key, 0.0) for channel in wanted if channel.key in column_of}
    if len(common) == 1 and any(common) and not model.input_quantities:
        start, offsets = start - common.pop(), {}  # one clock for all: times move, and no sample is interpolated
    source, parts, channel_remarks, unwrapped = {}, {}, list[Remark](), dict[str, float]()
    rows, dropped = np.zeros(len(of_file.times), bool), []
    in_file = [channel for channel in wanted if channel.key in column_of]
    read = {channel.key: _series(table, column_of[channel.key], channel, of_file) for channel in in_file}
    samples = {key: series for key, (series, _) in read.items()}
    if model.turns or model.measured_turns:
        samples, channel_remarks = quaternions.repaired(model, samples)
        channel_remarks += quaternions.remark_on_numbers(model, table.names, column_of)
    for channel in in_file:
        series, present = samples[channel.key], read[channel.key][1]
        if channel.kind == MEASUREMENT and not model.measured_turns:
            series, left_out = _measured(series, channel)
            channel_remarks += left_out
            turn = turn_of(series.values, channel.quantity.unit) if unwrap else 0.0
            if turn:
                unwrapped[channel.key] = turn
                series = Series(series.times, np.unwrap(series.values, period=turn))
        if until and channel.kind == INPUT:  # a sample acts since the one before
            values = series.values[-len(series.values) + 1 :]
            if act == "between" and len(series.values) > 1:
                rows_before, of_angles = series.values[:-1, None], (channel.quantity.angle,)
                values = values - difference(values[:, None], rows_before, of_angles)[:, 0] / 2.0
            series = Series(series.times[: max(len(series.times) - 1, 1)], values)
        samples[channel.key] = series
        rows |= present
        if len(series.values) < len(of_file.times) or of_file.irregular or channel.key in offsets:
            source[channel.key] = series  # elsewhere the rows tell the same
        offset = offsets.get(channel.key, 0.0)
        if not grid:
            continue
        if channel.kind == INPUT:
            parts[channel.key] = mean_held(series, dt, of_file.rows - 1, offset, channel.quantity.angle)
        else:
            parts[channel.key] = sampled(series, dt, of_file.rows, offset, channel.quantity.angle)
            lost = len(series.values) - int((~np.isnan(sampled(series, dt, of_file.rows))).sum())
            dropped += [(channel.key, lost)] if lost else []
    marks, last = None, of_file.rows - 1
    if not grid:
        driving = [channel.key for channel in wanted if channel.kind == INPUT]
        marks, parts = at_own_stamps(samples, driving, offsets, dt, float(of_file.times[-1]), start)
        last = len(marks) - 1

    def those(kind: str, rows: int) -> np.ndarray:
        columns = [parts[channel.key] for channel in wanted if channel.kind == kind]
        return np.column_stack(columns) if columns else np.empty((rows, 0))

    driven = {}
    for key in (channel.key for channel in wanted if channel.kind == INPUT):
        driven[key] = samples[key]._replace(times=samples[key].times - offsets.get(key, 0.0))
    end = float(of_file.times[-1]) if marks is not None else of_file.dt * (of_file.rows - 1)
    remarks = (
        *([Remark(CLOCK, "", assumption)] if assumption else []),
        *table.remarks,
        *channel_remarks,
        *stale_inputs(driven, end, dt, start),
    )
    referring = [channel for channel in wanted if channel.kind not in (INPUT, MEASUREMENT)]
    referred = {channel.key: channel.quantity for channel in referring if channel.key in parts}
    recording = _recording(of_file, rows, tuple(dropped)) if grid else Recording(doubled=_doubled(of_file))
    if last < FEWEST_STEPS:
        raise ValueError(f"a log must have at least {FEWEST_STEPS + 1} rows, but {file} has {last + 1}")
    return Log(
        name=file,
        dt=dt,
        inputs=those(INPUT, last),
        measurements=those(MEASUREMENT, last + 1),
        input_quantities=model.input_quantities,
        measured=model.measurements,
        references={key: parts[key] for key in referred},
        referred=referred,
        start=start,
        source=source,
        offsets=offsets,
        irregular=of_file.irregular,
        recording=recording._replace(damage=table.damage, remarks=remarks, turns=tuple(unwrapped.items())),
        stamps=marks,
        until=until,
    )


def _measured(series: Series, channel: Wanted) -> tuple[Series, list[Remark]]:
    """The samples of a channel that are measurements, and what of the others is to be said."""
    left_out, texts = unmeasured(series.values)
    if not texts:
        return series, []
    name = channel.key.partition(":")[2]
    remarks = [Remark(kind, channel.key, f"{name} {text}") for kind, text in texts]
    return Series(series.times[~left_out], series.values[~left_out]), remarks


def _doubled(grid: Grid) -> int:
    """The number of rows with the stamp of the row before."""
    return int((np.diff(grid.times) == 0).sum())


def _recording(grid: Grid, rows: np.ndarray, dropped: tuple[tuple[str, int], ...]) -> Recording:
    """Count the gaps and holes between rows with samples (rows,), the shifts onto the grid and dropped samples."""
    numbers = np.unique(np.floor(grid.times[rows] / grid.dt + 0.5).astype(int))
    apart = np.diff(numbers)
    usual = max(float(np.median(apart)), 1.0) if len(apart) else 1.0
    is_gap = apart > (MOST_HELD + 1) * usual
    gaps = tuple((int(numbers[i]) + 1, int(apart[i]) - 1) for i in np.flatnonzero(is_gap))
    holes = np.maximum(np.round(apart[~is_gap] / usual).astype(int) - 1, 0)
    shifts = grid.shifts[grid.shifts > TOLERANCE * grid.dt]
    farthest = float(shifts.max()) if len(shifts) else 0.0
    count = int((holes > 0).sum())
    jitter = float(grid.shifts.max(initial=0.0))
    return Recording(gaps, int(holes.sum()), count, len(shifts), farthest, jitter, _doubled(grid), dropped)


def _described(path: Path) -> Description:
    """The description in the TOML file beside a log, empty if there is none."""
    description = path.with_suffix(".toml")
    if not description.is_file():
        return Description()
    content = read_toml(description, "what is said of a log")
    unknown = sorted(set(content) - set(Description._fields))
    if unknown:
        rule = f"keys beside a log must be among {', '.join(Description._fields)}"
        raise ValueError(f"{rule}, but {description} has {unknown}")
    for key, kind in (("columns", str), ("units", str), ("clock_offset", float | int)):
        part = content.get(key, {})
        if not isinstance(part, dict) or not all(isinstance(value, kind) for value in part.values()):
            what = "texts" if kind is str else "seconds"
            rule = f"{key} beside a log must map names to {what}"
            raise ValueError(f"{rule}, but {description} has {short_repr(part)}")
    return Description(**content)


def _grid(table: Table, column: Column | None, dt: float | None, file: str, grid: bool) -> tuple[Grid, float, str]:
    """The grid of a file's rows, or its sample time and their own times; the first stamp [s]; the assumed unit."""
    count = len(table.lines)
    if dt is not None:
        dt = positive("dt", dt)
    apart = np.flatnonzero(np.diff(table.lines) != 1)
    if column is None and len(apart):
        line = table.lines[int(apart[0])] + 1
        rule = "rows of a log without times must follow one another"
        raise ValueError(f"{rule}, but line {line} of {file} is empty")
    if column is None:
        if dt is None:
            raise ValueError(
                f"a log must have a column of times (use --column time=HEADER, in Python "
                f"columns={{'time': 'HEADER'}}) or a sample time (--dt, dt=), but "
                f"{file} has {listed(table.names)}"
            )
        return Grid(dt, count, dt * np.arange(count), False), 0.0, ""
    stamps, assumption = table.dates(column.header), ""
    if stamps is None:
        where = f"column {column.header!r} of {file}"
        stamps, assumption = in_seconds(table.numbers(column.header), column.unit, column.header, where)
    if np.isnan(stamps).any():
        row = int(np.argmax(np.isnan(stamps)))
        raise ValueError(f"every row must have a time, but there is none in {table.location(row, column.header)}")
    if count <= FEWEST_STEPS:
        raise ValueError(f"a log must have at least {FEWEST_STEPS + 1} rows, but {file} has {count}")
    clocked = stamps if table.clock is None else stamps[table.clock]
    steps = np.diff(clocked)
    doubled = (steps == 0).sum() > MOST_DOUBLED * len(steps) or len(steps) - (steps == 0).sum() < FEWEST_STEPS
    back = np.flatnonzero(steps <= 0 if doubled else steps < 0)
    if len(back):
        row = int(back[0]) + 1
        order, where = follows(clocked[row - 1], clocked[row]), table.location(row, column.header)
        way = ""
        if (steps < 0).all():
            way = ": the newest row is the first one, reverse the rows"
        elif doubled and (steps >= 0).all():
            about = (clocked[-1] - clocked[0]) / len(steps)
            way = f": {int((steps == 0).sum())} rows have the time of the row before, delete the column and give "
            way += f"--dt (about {about:.3g})" if about > 0.0 else "--dt"
        raise ValueError(f"times must increase from row to row, but {order} in {where}{way}")
    count = (clocked[-1] - clocked[0]) / (float(np.median(steps[steps > 0])) if dt is None else dt)
    if count > MOST_STEPS:
        rule = f"a log must be at most {MOST_STEPS} steps long"
        raise ValueError(f"{rule}, but {file} has {count:.3g} from first to last time")
    fitted = grid_of(stamps, dt, table.clock)
    if not grid:
        fitted = Grid(fitted.dt, fitted.rows, stamps - stamps[0], True)
    return fitted, float(stamps[0]), assumption


def _offsets(
    offset_of: Mapping[str, float], wanted: list[Wanted], column_of: Mapping, grid: Grid, file: str
) -> dict[str, float]:
    offsets, length = {}, grid.dt * (grid.rows - 1)
    for name, seconds in offset_of.items():
        channel = find_wanted(name, wanted)
        if channel is None or channel.key not in column_of:
            known = ", ".join(channel.quantity.symbol for channel in wanted if channel.key in column_of)
            raise ValueError(f"clock offsets must be of channels {known}, but got {short_repr(name)} ({file})")
        offsets[channel.key] = finite(f"the clock offset of {name}", seconds)
        if abs(offsets[channel.key]) >= length:  # nothing of the channel would be left
            rule = f"the clock offset of {name} must be shorter than the log, {length:g} s"
            raise ValueError(f"{rule}, but got {seconds:g} ({file})")
    return offsets


def _series(table: Table, column: Column, wanted: Wanted, grid: Grid) -> tuple[Series, np.ndarray]:
    """The samples of a column in the model's unit, and the mask of their rows.

    Raises:
        ValueError: for a late input, or a sensor that never changes.
    """
    where = f"column {column.header!r} of {table.file}"
    values = converted(table.numbers(column.header), column.unit, wanted.quantity.unit, where)
    present = ~np.isnan(values)
    if not present.any() and wanted.kind in (INPUT, MEASUREMENT):
        raise ValueError(f"a column must hold numbers, but {where} has none")
    if wanted.kind == INPUT and not present[0]:
        rule = "an input must be known from the first row on"
        raise ValueError(f"{rule}, but it is missing in {table.location(0, column.header)}")
    if wanted.kind == MEASUREMENT and present.sum() > 1 and np.ptp(values[present]) == 0.0:
        raise ValueError(f"a measurement must vary, but {where} is {values[present][0]:.10g} in all rows")
    return Series(grid.times[present], values[present]), present
