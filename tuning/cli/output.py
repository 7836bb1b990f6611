"""Shared output of commands: tables on the terminal, JSON for programs."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from rich.console import Console, RenderableType

from thruster_env.core.files import check_target, write_whole
from thruster_env.core.text_tables import Unfolded, console
from tuning.api.result import plain_data
from tuning.cli.interrupts import PrintedWhole

progress_console = Console(stderr=True, markup=False, highlight=False)


def emit(parts: Sequence[RenderableType], data: dict, json_target: str | None) -> None:
    """Print tables and lines, unless JSON goes to standard output; write JSON where asked."""
    if json_target == "-":
        with PrintedWhole():
            sys.stdout.write(as_text(data))
            sys.stdout.flush()
        return
    _check_json(json_target)
    if json_target is not None:  # first: there may be nobody left who reads what is printed
        write_whole(json_target, as_text(data))
    with PrintedWhole():
        for part in parts:
            if isinstance(part, Unfolded) and not console.is_terminal:
                sys.stdout.write(f"{part}\n")
            else:
                console.print(part, soft_wrap=isinstance(part, Unfolded))


def _check_json(target: str | None) -> None:
    """Raise ValueError for a path that would be a log, or the description of one."""
    if target is None:
        return
    from thruster_env.logs.recorders.registry import ENDINGS
    from thruster_env.logs.table import SUFFIXES

    if Path(target).suffix in (*SUFFIXES, *ENDINGS, ".toml"):
        raise ValueError(f"--json must be no log, nor what is said of one, but got {target!r}")


def check_not_read(path: str | Path, read: Iterable[str | Path]) -> None:
    """Raise ValueError if a file to be written is one of those that are read, links followed."""
    for source in read:
        try:
            same = os.path.samefile(path, source)
        except OSError:  # one of them is not there
            continue
        if same:
            raise ValueError(f"an output file must not replace an input file, but got {path} for both")


def check_targets(targets: Iterable[str | Path | None], json_target: str | None, read: Iterable = ()) -> None:
    """Raise ValueError unless all files can be written, before long work, and none of those read is among them.

    Args:
        targets: paths to be written, None for those not requested.
        json_target: of `--json`.
        read: paths to be read, None for those not given.
    """
    named = [path for path in (*targets, None if json_target == "-" else json_target) if path is not None]
    inputs = [path for path in read if path is not None]
    for target in named:
        check_not_read(target, inputs)
    for target in named:
        if Path(target).suffix == ".toml":
            from thruster_env.logs.write import check_not_among

            check_not_among(target)
        check_target(target)
    _check_json(json_target)


def warn_beyond(preset: str, voltage: float) -> None:
    """Say on standard error that a preset is driven by a larger voltage [V] than it is valid for."""
    from thruster_env.thruster.plant import largest_known_voltage

    known = largest_known_voltage(preset)
    if abs(voltage) > known:
        message = f"{preset} is valid up to {known:g} V, but is driven by {abs(voltage):g} V: this is extrapolated"
        progress_console.print(f"thruster: warning: {message}")


@contextmanager
def progress_of(title: str, out: Path | None = None) -> Iterator[Callable[[str, int, int], None]]:
    """A bar of long work: the callback takes what is running, how much is done, and how much there is.

    Args:
        title: until the callback is called.
        out: a folder or file that keeps what is done, if there is one.
    """
    from rich.progress import TimeElapsedColumn

    from tuning.api.progress import bar  # which takes 20 ms

    try:
        with bar(title, progress_console, TimeElapsedColumn()) as update:
            yield lambda text, done, count: update(description=text or title, completed=done, total=count)
    except KeyboardInterrupt:
        if out is not None:
            progress_console.print(f"Interrupted: finished work is in {out}, and the same command continues.")
        raise


def as_text(data) -> str:
    """JSON of plain data, arrays and NamedTuples; numbers that are not finite become null."""
    return json.dumps(plain_data(data), indent=2, allow_nan=False) + "\n"
