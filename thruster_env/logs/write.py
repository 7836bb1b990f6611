"""Logs and other columns as files that `read_log` takes, CSV, npz or Parquet, and the picture of a log."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from thruster_env.core.checks import as_floats
from thruster_env.core.files import (
    BLUE,
    DARK,
    MUSTARD,
    PLUM,
    RUST,
    WINE,
    legend_below,
    new_figure,
    thinned,
    tidy,
    write_whole,
)
from thruster_env.core.modules import to_install
from thruster_env.logs.columns import TIME_NAMES, parted, plain, suffix
from thruster_env.logs.findings import GAP, OUTLIER, SATURATED, STUCK, outliers
from thruster_env.logs.log import Log
from thruster_env.logs.recorders.registry import ENDINGS
from thruster_env.logs.table import SUFFIXES, read_table
from thruster_env.logs.times import digits_for
from thruster_env.model.quantities import Quantity

EXACT = "exact"  # every digit of a number
LEAST = 10  # digits
DIGITS = f"%.{LEAST}g"
PICTURES = (".png", ".svg", ".pdf")  # which figures are written as

# Of the picture.
WIDTH, PANEL, ROOM = 9.0, 1.5, 0.7  # [inch]
MOST_PANELS = 12
SPANS = {GAP: ("gap", MUSTARD), STUCK: ("stuck", WINE)}


def check_suffix(path: str | Path, option: str = "--out", suffixes: tuple[str, ...] = SUFFIXES) -> None:
    """Raise ValueError unless a file's ending is known and the package that writes it is installed."""
    ending = Path(path).suffix
    if ending not in suffixes:
        known = f"{', '.join(suffixes[:-1])} or {suffixes[-1]}"
        raise ValueError(f"{option} must end in {known}, but got {str(path)!r}")
    if ending == ".parquet":
        _pyarrow()


def check_picture(path: str | Path, option: str) -> None:
    """Raise ValueError unless the name of a figure's file ends in one of PICTURES."""
    check_suffix(path, option, PICTURES)


def check_not_among(path: str | Path) -> None:
    """Raise ValueError if a file is, or would be, the description of a log, as run.toml is of run.csv."""
    path = Path(path)
    logs = [path.with_suffix(suffix) for suffix in (*SUFFIXES, *ENDINGS) if path.suffix == ".toml"]
    for log in logs:
        if log.is_file():
            rule = "a file must not take the name of the description of a log"
            raise ValueError(
                f"{rule}, but got {path} beside {log.name}; name it {path.stem}_numbers.toml, for instance"
            )


def write_columns(
    path: str | Path, columns: Mapping[str, np.ndarray], digits: str | None = None, *, again: bool = False
) -> None:
    """Write columns of equal length whole or not at all, in the form that the file's name ends in.

    No log is ever overwritten: an existing file is kept, unless it has the same contents, or none.

    Args:
        path: that ends in .csv, .npz or .parquet.
        columns: numbers (rows,) by header.
        digits: of numbers in CSV, as `numpy.savetxt` takes them, or EXACT; by default ten, and more in a column
            whose numbers differ by little: so many that times differ, and others have seven of their range.
        again: whether a file of the same columns is replaced, such as estimates by later ones.

    Raises:
        ValueError: for another ending, if the file cannot be written, or for an existing log.
    """
    check_suffix(path, "a file of columns")
    names, values = list(columns), [as_floats(column) for column in columns.values()]
    content = _content(Path(path).suffix, dict(zip(names, values, strict=True)), digits)
    _check_over(Path(path), content, names if again else None)
    write_whole(path, content)


def _content(suffix: str, columns: dict[str, Any], digits: str | None) -> bytes:
    stream = io.BytesIO()
    if suffix == ".csv":
        text = io.StringIO()
        csv.writer(text, lineterminator="\n").writerow(columns)
        if digits == EXACT:
            rows = zip(*(column.tolist() for column in columns.values()), strict=True)
            text.writelines(",".join(map(repr, row)) + "\n" for row in rows)
        else:
            table = np.column_stack(list(columns.values()))
            kinds = [_digits(*column) for column in columns.items()] if digits is None else digits
            np.savetxt(text, table, delimiter=",", fmt=kinds)
        stream.write(text.getvalue().encode())
    elif suffix == ".npz":
        np.savez(stream, **columns)
    else:
        pyarrow = _pyarrow()
        pyarrow.parquet.write_table(pyarrow.table(columns), stream)
    return stream.getvalue()


def _digits(name: str, values: np.ndarray) -> str:
    """The format of a column's numbers, as `write_columns` has it by default."""
    known = values[np.isfinite(values)]
    if len(known) < 2:
        return DIGITS
    step = 1e-6 * float(np.ptp(known))
    if parted(name)[0] in TIME_NAMES:
        apart = abs(np.diff(known))
        step = 0.1 * float(apart[apart > 0].min(initial=np.inf))
    return f"%.{digits_for(float(abs(known).max()), step, LEAST)}g"


def _check_over(path: Path, content: bytes, names: list[str] | None) -> None:
    """Raise ValueError for a file that is there, unless it is empty, the same, or has columns of these names."""
    if not path.is_file() or path.stat().st_size == 0:
        return
    existing = path.read_bytes() if path.stat().st_size == len(content) else b""
    if existing == content or (names is not None and _names_in(path) == names):
        return
    raise ValueError(f"a log must be written to a new file, because logs are never overwritten, but {path} exists")


def _names_in(path: Path) -> list[str]:
    """The headers of a table that is there; none of what is no table."""
    try:
        return list(read_table(path).names)
    except ValueError:
        return []


def write_log(path: str | Path, log: Log) -> None:
    """Write a log with every digit, such that `read_log` with the same model gives its rows again.

    The last row has no input, as nothing is known of what acts after it. Where inputs act until their rows, the
    first row repeats that of the second one.
    """
    columns, inputs = {"time_s": log.start + log.times}, log.input_rows
    if log.until:
        inputs[0] = inputs[1]
    for quantity, values in zip(log.input_quantities, inputs.T, strict=True):
        columns[header_of(quantity, columns)] = values
    for quantity, values in zip(log.measured, log.measurements.T, strict=True):
        columns[header_of(quantity, columns)] = values
    for key, values in log.references.items():
        columns[header_of(log.referred[key], columns)] = values
    write_columns(path, columns, EXACT)


def header_of(quantity: Quantity, used=()) -> str:
    """The header of a quantity's column, "measured_thrust_N": its name, or symbol if that is taken, and unit."""
    unit = suffix(quantity.unit)
    for text in (quantity.name, quantity.symbol):
        header = f"{plain(text)}_{unit}" if unit else plain(text)
        if header not in used:
            return header
    raise ValueError(f"columns must have different headers, but {header} is that of two")


def _pyarrow():
    try:
        import pyarrow
        import pyarrow.parquet
    except ImportError:
        raise ValueError(
            f"a Parquet file must be written by pyarrow, which is not installed ({to_install('parquet')})"
        ) from None
    return pyarrow


if TYPE_CHECKING:
    from matplotlib.figure import Figure


def draw_findings(log: Log) -> Figure:
    """Inputs, then measurements, one below the other; findings are shaded, outliers have rings."""
    from thruster_env.core.text_tables import TITLE, verbatim  # which imports rich

    times = log.start + log.times
    inputs = log.input_rows
    panels = [("", quantity, inputs[:, column]) for column, quantity in enumerate(log.input_quantities)]
    for column, output in enumerate(log.measured):
        panels.append((f"measurement:{output.symbol}", output, log.measurements[:, column]))
    panels = panels[-MOST_PANELS:]
    figure = new_figure((WIDTH, PANEL * len(panels) + ROOM))
    axes = figure.subplots(len(panels), 1, sharex=True, squeeze=False)[:, 0]
    tidy(axes)
    for axis, (channel, quantity, values) in zip(axes, panels, strict=True):
        if channel:
            present = ~np.isnan(values)
            axis.plot(*thinned(times[present], values[present]), ".", color=BLUE, markersize=2.5, label="sample")
        else:
            axis.step(
                *thinned(times, values),
                where="pre" if log.until else "post",
                color=DARK,
                linewidth=0.9,
                label="input",
            )
        for finding in log.findings:
            if finding.kind in SPANS and finding.channel in ("", channel):
                word, colour = SPANS[finding.kind]
                ends = times[finding.first] - log.dt / 2, times[finding.last] + log.dt / 2
                axis.axvspan(*ends, color=colour, alpha=0.25, linewidth=0, label=word)
            elif finding.kind == SATURATED and finding.channel == channel:
                rows = values == values[finding.first]
                axis.plot(times[rows], values[rows], ".", color=PLUM, markersize=4, label="saturated")
            elif finding.kind == OUTLIER and finding.channel == channel:
                rows = outliers(log, channel)
                style = {"color": RUST, "fillstyle": "none", "markersize": 7, "markeredgewidth": 1.3}
                axis.plot(times[rows], values[rows], "o", label="outlier", **style)
        axis.set_ylabel(quantity.plot_label.replace(" $", "\n$"))
    axes[0].set_title(verbatim(f"{log.name}: {log.steps + 1} rows, dt {log.dt:g} s", most=TITLE), fontsize=11)
    axes[-1].set_xlabel("time [s]")
    figure.align_ylabels(axes)
    legend_below(figure, axes)
    return figure
