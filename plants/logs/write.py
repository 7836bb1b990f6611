"""Logs and other columns of numbers into files that `read_log` takes: CSV, npz or Parquet."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from numerics.extras import to_install
from numerics.files import write_whole
from plants.logs.columns import plain
from plants.logs.log import Log
from plants.logs.table import SUFFIXES
from plants.logs.units import suffix
from plants.quantities import Quantity

EXACT = "exact"  # every digit of a number


def check_suffix(path: str | Path, option: str = "--out", suffixes: tuple[str, ...] = SUFFIXES) -> None:
    """Raise ValueError unless a file's name ends so that it can be written, and what writes it is installed."""
    found = Path(path).suffix
    if found not in suffixes:
        known = f"{', '.join(suffixes[:-1])} or {suffixes[-1]}"
        raise ValueError(f"{option} must end in {known}, but got {str(path)!r}")
    if found == ".parquet":
        _pyarrow()


def write_columns(path: str | Path, columns: Mapping[str, np.ndarray], digits: str = "%.10g") -> None:
    """Write columns of equal length whole or not at all, in the form that the file's name ends in.

    Args:
        path: that ends in .csv, .npz or .parquet.
        columns: numbers (rows,) by header.
        digits: of numbers in CSV, as `numpy.savetxt` takes them, or EXACT.

    Raises:
        ValueError: for another ending, or if the file cannot be written.
    """
    check_suffix(path, "a file of columns")
    names, values = list(columns), [np.asarray(one, dtype=np.float64) for one in columns.values()]
    if Path(path).suffix == ".csv":
        text = io.StringIO()
        if digits == EXACT:
            text.write(",".join(names) + "\n")
            rows = zip(*(one.tolist() for one in values), strict=True)
            text.writelines(",".join(map(repr, row)) + "\n" for row in rows)
        else:
            table = np.column_stack(values)
            np.savetxt(text, table, delimiter=",", header=",".join(names), comments="", fmt=digits)
        write_whole(path, text.getvalue())
    elif Path(path).suffix == ".npz":
        arrays: dict[str, Any] = dict(zip(names, values, strict=True))
        write_whole(path, lambda stream: np.savez(stream, **arrays))
    else:
        pyarrow = _pyarrow()
        table = pyarrow.table(dict(zip(names, values, strict=True)))
        write_whole(path, lambda stream: pyarrow.parquet.write_table(table, stream))


def write_log(path: str | Path, log: Log) -> None:
    """Write a log with every digit, such that `read_log` with the same model gives its rows again.

    The last row has no input, as nothing is known of what acts after it.
    """
    columns = {"time_s": log.start + log.times}
    for one, values in zip(log.input_quantities, log.inputs.T, strict=True):
        columns[header_of(one, columns)] = np.append(values, np.nan)
    for one, values in zip(log.measured, log.measurements.T, strict=True):
        columns[header_of(one, columns)] = values
    for key, values in log.references.items():
        columns[header_of(log.referred[key], columns)] = values
    write_columns(path, columns, EXACT)


def header_of(quantity: Quantity, taken=()) -> str:
    """The header of a quantity's column, "measured_thrust_N": its name, or symbol if that is taken, and unit."""
    unit = suffix(quantity.unit)
    for text in (quantity.name, quantity.symbol):
        header = f"{plain(text)}_{unit}" if unit else plain(text)
        if header not in taken:
            return header
    raise ValueError(f"columns must have different headers, but {header} stands for two")


def _pyarrow():
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise ValueError(
            f"a Parquet file must be written by pyarrow, which is not installed ({to_install('parquet')})"
        ) from None
    return pyarrow
