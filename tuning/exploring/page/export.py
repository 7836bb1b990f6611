"""What the page exports: a tuned file, Python lines, the command, or the picture of what is seen."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from typing import NamedTuple

from tuning.exploring.bench import Bench
from tuning.exploring.figure import figure_of
from tuning.exploring.view import View

KINDS = {
    "tuned": "tuned file",
    "python": "Python lines",
    "command": "command",
    "png": "PNG picture",
    "svg": "SVG picture",
}


class File(NamedTuple):
    """A file for the browser to keep: text, or if it is none, bytes in base 64."""

    name: str
    type: str
    text: str | None
    base64: str | None = None


def exported(bench: Bench, values: Mapping[str, float], view: View, run: int, kind: str) -> File:
    """A file of what is seen.

    Raises:
        ValueError: for another kind than those of `KINDS`.
    """
    if kind == "tuned":
        return File("tuned.json", "application/json", bench.tuned_file(values))
    if kind == "python":
        return File("explored.py", "text/x-python", bench.python_lines(values))
    if kind == "command":
        return File("command.txt", "text/plain", bench.command(values))
    if kind not in KINDS:
        raise ValueError(f"kind must be one of {', '.join(KINDS)}, but got {kind}")
    drawn = io.BytesIO()
    figure_of(bench, view, run).savefig(drawn, format=kind, dpi=150)
    if kind == "svg":
        return File("explored.svg", "image/svg+xml", drawn.getvalue().decode())
    return File("explored.png", "image/png", None, base64.b64encode(drawn.getvalue()).decode())
