"""One column of numbers with its times, read as logs are, on a grid."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from filters.models import Scales, named_model
from thruster_env.core.checks import listed, one_of, short_repr
from thruster_env.logs.columns import DATE_NAMES, TIME_NAMES, parted, simple
from thruster_env.logs.findings import sentences
from thruster_env.logs.read import read_log
from thruster_env.logs.recorders.registry import format_of
from thruster_env.logs.table import Table, read_table, table_of
from thruster_env.model.quantities import Quantity

LEAST_ROWS = 20  # with a number


@dataclass(frozen=True, eq=False)
class Column:
    """Numbers on a grid of times, NaN where there is none.

    Attributes:
        values: (K,).
        dt: sample time [s].
        quantity: name, symbol and unit of the numbers.
        remarks: what was found while they were read, in sentences.
    """

    values: np.ndarray
    dt: float
    quantity: Quantity
    remarks: tuple[str, ...] = ()

    @cached_property
    def measured(self) -> np.ndarray:
        """Which rows have a number, (K,)."""
        return ~np.isnan(self.values)

    @cached_property
    def first(self) -> float:
        """The first number."""
        return float(self.values[np.argmax(self.measured)])

    @cached_property
    def mean(self) -> float:
        """The mean of the numbers."""
        return float(np.nanmean(self.values))

    @cached_property
    def scales(self) -> Scales:
        """The data's spread, times and strongest frequency."""
        duration = self.dt * (len(self.values) - 1)
        spread = float(np.nanstd(self.values))
        return Scales(spread, _roughness(self.values, spread), self.dt, duration, _peak(self.values, self.dt))

    def middle(self, most: int) -> Column:
        """The column itself, or its middle rows if it has more than `most`."""
        excess = len(self.values) - most
        return self if excess <= 0 else replace(self, values=self.values[excess // 2 : excess // 2 + most])


def column_of(z: Any, dt: float | None = None, *, times: Any = None, column: str | None = None) -> Column:
    """The numbers on a grid, with NaN where there is none, as the reader of logs puts them there.

    Args:
        z: numbers (K,), a pandas Series or table, a mapping from headers to arrays, or the path of a log.
        dt: sample time [s], for numbers without times, or of the grid.
        times: of an array's numbers [s], (K,).
        column: header of the numbers in a table with several columns.

    Raises:
        ValueError: states the rule and the value.
    """
    source: Any = z if isinstance(z, str | Path | Mapping) or hasattr(z, "columns") else _as_columns(z, times)
    is_file = isinstance(source, str | Path)
    recorded = is_file and format_of(source) is not None
    if recorded:
        if column is None:
            rule = "the column of a recorder's file must be named (column=, --column TOPIC.FIELD)"
            raise ValueError(f"{rule}, but got none for {source}: `thruster log {source}` lists them")
        header, time = column, None
    else:
        table = read_table(source) if is_file else table_of(source, "a table")
        header, time = _headers(table, column)
        _check_numbers(header, table.numbers(header))
    base, unit = parted(header)
    symbol = re.sub(r"[^A-Za-z0-9_-]+", "_", base).strip("_") or "z"
    quantity = Quantity(base.strip(), symbol, simple(unit or "")[0] if unit and unit.isalnum() else unit or "")
    reader = named_model("constant").model({"drift": 1.0}, 1.0, 1.0, quantity=quantity)
    columns = {symbol: header} | ({} if time is None else {"time": time})
    log = read_log(source, reader, columns, dt=1.0 if dt is None and time is None and not recorded else dt)
    values = log.measurements[:, 0]
    _check_numbers(header, values)
    return Column(values, log.dt, quantity, tuple(sentences(log.findings)))


def _check_numbers(header: str, values: np.ndarray) -> None:
    """Raise ValueError unless a column has enough numbers."""
    count = int(np.count_nonzero(~np.isnan(values)))
    if count < LEAST_ROWS:
        raise ValueError(f"{header} must have at least {LEAST_ROWS} numbers, but has {count}")


def column_alone(files: Any, reading: Mapping[str, Any]) -> str | Path | None:
    """The file of a log that has one column of numbers beside its times, if nothing but dt is said of it.

    Args:
        files: of recorded runs.
        reading: options by which they are read.
    """
    several = isinstance(files, list | tuple)
    file = files[0] if several and len(files) == 1 else files
    if not isinstance(file, str | Path) or not set(reading) <= {"dt"} or format_of(file) is not None:
        return None
    try:
        _headers(read_table(file), None)
    except ValueError:  # several columns, or none: whoever reads the log says what is wrong
        return None
    return file


def _as_columns(z: Any, times: Any) -> Mapping[str, Any]:
    """An array, a list or a pandas Series as a table or a mapping from headers to arrays."""
    if hasattr(z, "to_frame") and times is None:
        return z.to_frame(z.name or "z")
    try:
        values = np.asarray(
            [math.nan if value is None else value for value in np.asarray(z).tolist()], dtype=float
        )
    except (TypeError, ValueError):
        raise ValueError(f"z must be numbers, but got {short_repr(z)}") from None
    if values.ndim == 2 and 1 in values.shape:
        values = values.ravel()
    if values.ndim != 1:
        raise ValueError(f"z must be one column of numbers, (K,), but has shape {values.shape}: fit each alone")
    return {"z": values} if times is None else {"time": np.asarray(times), "z": values}


def _headers(table: Table, column: str | None) -> tuple[str, str | None]:
    """The header of the numbers, and that of the times; ValueError for several columns of numbers."""
    times = [name for name in table.names if parted(name)[0].strip().lower() in (*TIME_NAMES, *DATE_NAMES)]
    times += [name for name in table.names if name not in times and table.dates(name) is not None]
    time = next((name for name in times if name != column), None)
    numbers = [name for name in table.names if name not in times]
    if column is not None:
        return one_of(f"a column of {table.file}", column, table.names), time
    if len(numbers) != 1:
        rule = "a file must have one column of numbers beside its times, or the column must be named"
        raise ValueError(f"{rule} (column=, --column HEADER), but {table.file} has {listed(numbers)}")
    return numbers[0], time


def _roughness(values: np.ndarray, spread: float) -> float:
    """The least deviation of differences of order d, over that of white noise, (2d choose d)^1/2."""
    deviations = [spread]
    for order in range(1, 5):
        differences = np.diff(values, order)
        if np.count_nonzero(~np.isnan(differences)) >= LEAST_ROWS // 2:
            deviations.append(float(np.nanstd(differences)) / math.sqrt(math.comb(2 * order, order)))
    return max(min(deviations), 1e-9 * spread)


def _peak(values: np.ndarray, dt: float) -> float:
    """Frequency of the highest peak of the spectrum [Hz], without the trend; missing numbers lie on the trend."""
    rows, known = np.arange(len(values)), ~np.isnan(values)
    trend = np.polynomial.Polynomial.fit(rows[known], values[known], 1)(rows)
    filled = np.where(known, values - trend, 0.0)
    power = np.abs(np.fft.rfft(filled * np.hanning(len(filled)))) ** 2
    return float(np.fft.rfftfreq(len(filled), dt)[1 + int(np.argmax(power[1:]))])
