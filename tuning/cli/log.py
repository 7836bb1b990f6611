"""`thruster log`: the contents and the problems of a recorded log."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from itertools import groupby
from pathlib import Path
from typing import Annotated, Any

from rich.console import RenderableType

from thruster_env.core.checks import listed
from thruster_env.core.files import save_figure
from thruster_env.core.text_tables import Table, Unfolded, console, plain_text
from thruster_env.env.model_env import ANY_DT
from thruster_env.logs.columns import find_columns, quantities_of
from thruster_env.logs.findings import sentences
from thruster_env.logs.log import Log
from thruster_env.logs.recorders.bag_counts import METADATA
from thruster_env.logs.recorders.bags import HEADER, RECEIPT
from thruster_env.logs.recorders.registry import ENDINGS, Contents, Field, contents, format_of
from thruster_env.logs.table import SUFFIXES, read_table
from thruster_env.logs.times import time_text
from thruster_env.logs.write import check_picture, check_suffix, draw_findings, write_log
from tuning.api.markers import INPUT, OUTPUT, READ, WRITTEN, LogsArgument, Option
from tuning.api.read_logs import recorded_runs
from tuning.api.result import Printed
from tuning.logs.allan import allan_of, at_rest, draw_allan, rows_of, start_values
from tuning.logs.allan import sentences as sentences_on_noise
from tuning.problems.find import logs_package

BLOCKS = "▁▂▃▄▅▆▇█"
CLOCKS = {HEADER: "stamps of headers", RECEIPT: "when messages were received"}  # in words
WIDE = 400  # characters of a line that goes into a file or another program: no name is folded there


def is_listed(log: Path, only: str | None, is_asked: bool) -> bool:
    """Whether the fields of a log are listed: of a recorder's file, unless options say how to read it.

    Args:
        log: its path.
        only: what is sought among its fields, None for nothing.
        is_asked: whether other options are given.

    Raises:
        ValueError: if something is sought in a file that has no topics.
    """
    form = format_of(log)
    if only is not None and form is None:
        folder = f"a folder with {METADATA} or CSV files"
        rule = f"--only must go with a recorder's file, {', '.join(ENDINGS)} or {folder}"
        raise ValueError(f"{rule}, but got {log}")
    if only is None and (is_asked or log.with_suffix(".toml").is_file()):
        return False
    return form is not None or _is_foreign(log)


def _is_foreign(log: Path) -> bool:
    """Whether a log is a table that has no column of a thruster's."""
    if log.suffix.lower() not in SUFFIXES or not log.is_file():
        return False
    table, room = read_table(log), logs_package()
    for quantity in quantities_of(room.Preset(room.DEFAULT_PRESET, None, ANY_DT).state_space_model()):
        try:
            columns = find_columns([quantity], table.names, {}, {}, table.file)
        except ValueError:  # a missing one
            continue
        if quantity.key in columns:
            return False
    return True


def listed_in(log: Path, only: str | None, stamps: str | None = None) -> Contents:
    """What is in a file, fields whose names contain a text in any case; ValueError if there are none."""
    every = contents(log, stamps)
    matching = [field for field in every.fields if only is None or only.casefold() in field.name.casefold()]
    if not matching:
        what = "some field of numbers" if only is None else f"a field whose name contains {only!r}"
        ignored = f"; not read are {_listed(every.unread)}" if every.unread else ""
        raise ValueError(f"a log must have {what}, but {log} has none among {len(every.fields)} fields{ignored}")
    unread = {
        name: why for name, why in every.unread.items() if only is None or only.casefold() in name.casefold()
    }
    return Contents(matching, unread, every.damage)


def remarks(contents: Contents) -> list[str]:
    """What of a file is damaged or not read, in sentences."""
    sentences = [f"{damage[:1].upper()}{damage[1:]}." for damage in contents.damage]
    return [*sentences, f"Not read: {_listed(contents.unread)}."] if contents.unread else sentences


def _listed(unread: Mapping[str, str]) -> str:
    return listed(f"{name} ({why})" for name, why in unread.items())


def as_table(log: Path, fields: Sequence[Field], is_terminal: bool) -> Table | Unfolded:
    """The table of fields: by topics for a terminal, or lines of plain text whose names nothing folds."""
    of_times = ["rate\n[Hz]", "longest\ngap [s]", "begin\n[s]", "end\n[s]"]
    columns = ["field", "samples", *of_times, "unit", "least", "greatest", "course"]
    rows = (
        _by_topics(fields) if is_terminal else [[field.name, *_counts(field), *_values(field)] for field in fields]
    )
    form = format_of(log)
    title = f"{log}: {form.kind if form else 'table'}, {len(fields)} {'fields' if form else 'columns'}"
    caption = "To read it as a log: --column NAME=FIELD for each input and measurement"
    clocks = dict.fromkeys(CLOCKS[field.clock] for field in fields if field.clock)
    caption += f"; times: {' and '.join(clocks)}" if clocks else ""
    output = Table(title, columns, rows, caption=caption)
    return output if is_terminal else Unfolded(plain_text([output], WIDE))


def as_json(log: Path, contents: Contents) -> dict:
    """The same as data."""
    form = format_of(log)
    names: tuple[str, ...] = ("name", "topic", "samples", "rate_hz", "longest_gap_s", "begin_s", "end_s", "stamps")
    names += ("unit", "least", "greatest", "course")
    rows = [dict(zip(names, field, strict=True)) for field in contents.fields]
    data = {"log": str(log), "format": form.kind if form else "table", "fields": rows}
    return {**data, "not_read": contents.unread, "damage": list(contents.damage)}


def _by_topics(fields: Sequence[Field]) -> list[list[str]]:
    """Rows of fields under one of their topic, which has what they have in common."""
    rows = []
    for (topic, *counts), group in groupby(fields, lambda field: (field.topic, *_counts(field))):
        rows += [[topic, *counts, *[""] * 4]] if topic else []
        for field in group:
            name, cells = (f"  {field.name[len(topic) :]}", [""] * len(counts)) if topic else (field.name, counts)
            rows.append([name, *cells, *_values(field)])
    return rows


def _counts(field: Field) -> list[str]:
    ends = [time_text(end, field.gap, 4) if math.isfinite(end) else "" for end in (field.begin, field.end)]
    return [str(field.samples), _short(field.rate), _short(field.gap), *ends]


def _values(field: Field) -> list[str]:
    return [field.unit, _short(field.least), _short(field.greatest), sparkline(field.course)]


def sparkline(course: Sequence[float]) -> str:
    """Numbers as blocks of eight heights, from least to greatest, a space for NaN; nothing if all are equal."""
    known = [x for x in course if math.isfinite(x)]
    low, high = min(known, default=0.0), max(known, default=0.0)
    if low == high:
        return ""
    heights = [7.0 * ((x / 2 - low / 2) / (high / 2 - low / 2)) for x in course]  # halves do not overflow
    return "".join(BLOCKS[round(height)] if math.isfinite(height) else " " for height in heights)


def _short(number: float) -> str:
    return f"{number:.4g}" if math.isfinite(number) else ""


def command(
    log: Annotated[Any, LogsArgument(INPUT, metavar="LOG", type=Path, file=READ, last="stamps")],
    *,
    only: Annotated[str | None, Option(INPUT, metavar="TEXT")] = None,
    allan: Annotated[bool, Option(INPUT)] = False,
    plot: Annotated[Path | None, Option(OUTPUT, metavar="FILE", file=WRITTEN)] = None,
    out: Annotated[Path | None, Option(OUTPUT, metavar="FILE", file=WRITTEN)] = None,
) -> Printed:
    """Show how a recorded log is read: its channels, and the gaps, stuck sensors, outliers and the like in it.

    Other commands that read logs print the same before their results. docs/logs.md has the rules.

    For a recorder's file (PX4's .ulg, ArduPilot's .bin, ROS bags, MATLAB, HDF5) it lists topics and fields, unless
    options say how to read it; so it does for a table without any column of a thruster's. docs/recorders.md has
    the formats.

    Example: thruster log run.csv --plot run.png

    Example: thruster log run.csv --sensor speed --column speed=motor_rpm --column voltage=u_cmd_V

    Example: thruster log flight.ulg --only actuator

    Example: thruster log at_rest.csv --allan --plot allan.png

    Args:
        log: recorded run.
        only: of a recorder's file, list the fields whose names contain this.
        allan: noise of a gyroscope gyr_x ... gyr_z, and an accelerometer acc_x ..., at rest for some minutes at
            least: the Allan deviation, and start values for `--model attitude` (docs/attitude.md).
        plot: picture of all channels, findings marked: .png, .svg or .pdf.
        out: write the log as it is read, on its grid and in the model's units: .csv, .npz or .parquet.
    """
    runs = recorded_runs(log)
    if allan:
        return _allan(runs.files, runs.reading, only, plot, out)
    file, stamps = runs.files, runs.reading.get("stamps")
    if is_listed(file, only, bool(runs.reading.keys() - {"stamps"}) or plot is not None or out is not None):
        selected = listed_in(file, only, stamps)
        output, notes = as_table(file, selected.fields, console.is_terminal), remarks(selected)
        return Printed([output, *map(Unfolded, notes)], as_json(file, selected))
    if plot is not None:
        check_picture(plot, "--plot")
    if out is not None:
        check_suffix(out)
    recorded, _ = runs.read()
    if out is not None:
        write_log(out, recorded)
    if plot is not None:
        save_figure(draw_findings(recorded), plot)
    files = [str(path) for path in (plot, out) if path is not None]
    return Printed([*_report(recorded), *(f"wrote {path}" for path in files)], _as_json(recorded, files))


def _allan(
    file: Path, reading: Mapping[str, Any], only: str | None, plot: Path | None, out: Path | None
) -> Printed:
    """Noise of an inertial sensor at rest, and the picture of its Allan deviations."""
    if only is not None or out is not None:
        raise ValueError("--allan must come without --only and --out, but got one of them")
    if plot is not None:
        check_picture(plot, "--plot")
    options = {name: value for name, value in reading.items() if name in ("columns", "dt", "grid", "stamps")}
    recorded = at_rest(file, **options)
    channels = allan_of(recorded)
    title = f"{recorded.name}: noise at rest over {recorded.steps * recorded.dt:.4g} s, dt {recorded.dt:g} s"
    if plot is not None:
        save_figure(draw_allan(channels, title), plot)
    columns = [
        "",
        "unit",
        "N, random walk\n[unit/√Hz]",
        "B, instability\n[unit]",
        "K, rate random walk\n[unit/s/√Hz]",
    ]
    files = [str(plot)] if plot is not None else []
    messages = [*sentences_on_noise(channels, recorded), *(f"wrote {path}" for path in files)]
    data = {
        "log": recorded.name,
        "dt": recorded.dt,
        "noise": {c.quantity.symbol: {name: value._asdict() for name, value in c.noise.items()} for c in channels},
        "start": start_values(channels, recorded.dt),
        "files": files,
    }
    return Printed(
        [Table(title, columns, rows_of(channels), caption="95 % intervals in brackets"), *messages], data
    )


def _report(log: Log) -> list[RenderableType]:
    rows = []
    for channel in log.channels:
        values = log.series(channel).values
        kind, _, symbol = channel.partition(":")
        quantities = {"input": log.input_quantities, "measurement": log.measured}.get(
            kind, [*log.referred.values()]
        )
        unit = next((quantity.unit for quantity in quantities if quantity.symbol == symbol), "")
        name = f"{kind} {symbol} [{unit}]" if unit else f"{kind} {symbol}"
        ends = [f"{values.min():.5g}", f"{values.max():.5g}", f"{values.std():.5g}"] if len(values) else [""] * 3
        rows.append([name, str(len(values)), *ends])
    on_grid = ", on its own stamps" if log.stamps is not None else ", put on a grid" if log.irregular else ""
    title = f"{log.name}: {log.steps + 1} rows, dt {log.dt:g} s{on_grid}"
    columns = ["channel", "samples", "smallest", "largest", "standard\ndeviation"]
    messages = sentences(log.findings) or ["Nothing stands out: no gaps, no stuck sensors, no outliers."]
    return [Table(title, columns, rows), *messages]


def _as_json(log: Log, files: list[str]) -> dict:
    return {
        "log": log.name,
        "digest": log.digest,
        "dt": log.dt,
        "rows": log.steps + 1,
        "irregular": log.irregular,
        "samples": {channel: len(log.series(channel).values) for channel in log.channels},
        "pieces": [list(piece) for piece in log.pieces],
        "findings": [asdict(finding) for finding in log.findings],
        "files": files,
    }
