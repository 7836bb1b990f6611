"""The exported program in C and `thruster estimate` on the same damaged CSVs: the same numbers, or a refusal."""

from __future__ import annotations

import csv
import io
import math
import shutil
import subprocess
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np

from filters.c.project import write_project
from filters.logs.estimate import estimate_with
from filters.logs.findings import columns_of
from filters.registry import make_filter
from tests.fuzz.logs import MODEL
from thruster_env.core.compiled import interpreted
from thruster_env.env.model_env import ReplayEnv

ROWS = 25
DT = 0.01
CELLS = (
    *("", " ", '" 2 "', "5.1 N", "5\t", "\u00a05"),
    *"nan NaN NA n/a N/A null None <NA> NaT -- off ? - . e5 1e 5,1 1_0 0x10 1e999 -1e999 1e-400".split(),
    *"""inf -inf infinity +3 .5 5. 1E-3 1e+2 1d5 ٣ １ '3' true # "5.1" "5.1 5"1 "" "1""2" """.split(),
)
HEADERS = {
    "t": ("Time [s]", "t (min)", *"t time time_ms timestamp time_s Timestamp t_V clock #t".split()),
    "force": (
        *("Force [mN]", "force (N)", "force [n]"),
        *'force force_N u_1 u_1_kN FORCE force_V force_xyz U_mN force_N_per_s "force" force_uN'.split(),
    ),
    "speed": (
        *("speed [rad/s]", "speed [1/s]", "speed [deg/min]", "speed"),
        *"speed_rpm speed_rad_per_s z_1 speed_deg_s speed_rad_s speed_Hz speed_mrad_per_s speed_m_s2".split(),
    ),
}


def damaged_logs_in_c(rng: np.random.Generator, seconds: float) -> str:
    """CSVs with text, quotes, other units, gaps, swapped times, doubled headers and other bytes."""
    if shutil.which("gcc") is None:
        return "no gcc"
    counts, end = Counter(), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as name, interpreted():
        folder, filter_ = Path(name), make_filter("kf", MODEL)
        command = ["gcc", "-std=c99", "-O1", "-fsanitize=address,undefined", "-fno-sanitize-recover=all"]
        programs = {None: folder / "any_log", DT: folder / "log_of_dt"}
        for dt, program in programs.items():
            write_project(filter_, folder, "one", dt=dt)
            subprocess.run([*command, "one.c", "main.c", "-lm", "-o", program], cwd=folder, check=True)
        while not counts or time.monotonic() < end:
            content, has_times = _damaged(rng)
            dt = DT if rng.random() < 0.5 else None
            counts[_compare(content, has_times, filter_, programs[dt], dt)] += 1
    return ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))


def _compare(content: bytes, has_times: bool, filter_, program: Path, dt: float | None) -> str:
    """What became of a log; AssertionError unless the numbers are the same, or the program refuses it.

    A program for logs of one dt reads those that lack rows, too, and no others.
    """
    log = program.with_name("log.csv")
    log.write_bytes(content)
    ended = subprocess.run([program], input=content, capture_output=True)
    errors = ended.stderr.decode(errors="replace")
    assert ended.returncode in (0, 2), (content, errors)
    assert (ended.returncode == 2) == bool(errors), (content, errors)
    try:
        recorded = ReplayEnv(log, MODEL, dt=None if has_times else DT).log
        if dt is not None and abs(recorded.dt - dt) > 1e-9 * dt:  # which a tuned file refuses
            return "of another sample time"
        found = columns_of(estimate_with(filter_, recorded))
    except ValueError as error:
        assert ended.returncode == 2, f"only the program in C reads {content!r}: {error}"
        return "refused"
    if ended.returncode == 2:
        return "refused by the program alone"
    headers, *rows = csv.reader(io.StringIO(ended.stdout.decode()))
    for header, column in zip(headers, zip(*rows, strict=True), strict=True):
        numbers = [float(word) if word else math.nan for word in column]
        if header == "time_s":
            if any(column):
                np.testing.assert_allclose(numbers, found[header], rtol=0.1, atol=0.2, err_msg=repr(content))
            continue
        atol = 1e-8 * np.nanmax(abs(found[header]))
        np.testing.assert_allclose(
            numbers, found[header], rtol=1e-8, atol=atol, equal_nan=True, err_msg=f"{header}: {content!r}"
        )
    return "read by both"


def _damaged(rng: np.random.Generator) -> tuple[bytes, bool]:
    """A log and whether it has times."""
    has_times, delimiter = bool(rng.random() < 0.8), str(rng.choice([",", ";", "\t", " "], p=[0.7, 0.1, 0.1, 0.1]))
    rows = int(rng.choice([ROWS, 2, 3], p=[0.9, 0.05, 0.05]))
    headers = {name: str(rng.choice(some)) if rng.random() < 0.3 else name for name, some in HEADERS.items()}
    scale = 1e3 if headers["t"] == "time_ms" else 1.0
    times = scale * (rng.choice([0.0, 5.0, 1.7e9]) + 0.01 * np.arange(rows))
    if rng.random() < 0.2:
        times += rng.normal(size=rows) * scale * rng.choice([1e-5, 2e-4, 2e-3])
    force, speed = np.sign(np.sin(np.arange(rows) / 3.0)), rng.normal(size=rows)
    table = [[repr(float(one)) for one in row] for row in zip(times, force, speed, strict=True)]
    is_time = has_times and headers["t"] != "clock"
    also = "other" if rng.random() < 0.8 else str(rng.choice([*HEADERS["force"], *HEADERS["speed"], "clock"]))
    lines = [[headers["t"], headers["force"], headers["speed"], also], *[[*row, "7"] for row in table]]
    if not has_times:
        lines = [line[1:] for line in lines]
    for _ in range(int(rng.choice([0, 1, 2, 4], p=[0.2, 0.4, 0.2, 0.2]))):
        kind, row = int(rng.integers(9)), int(rng.integers(1, len(lines)))
        line = lines[row]
        if kind < 4 and line:
            line[int(rng.integers(len(line)))] = str(rng.choice(CELLS))
        elif kind == 4:
            lines.insert(int(rng.choice([row, len(lines)])), [])
        elif kind == 5:
            lines[row], lines[-1] = lines[-1], lines[row]
        elif kind == 6 and len(lines) > 12:
            del lines[row : row + int(rng.choice([1, 2, 7, 9]))]
        elif kind == 7:
            lines.insert(row, list(line))
        elif line:
            line[:] = line[: int(rng.integers(len(line)))] if rng.random() < 0.3 else [*line, ""][: len(line) + 1]
    if rng.random() < 0.1:
        lines[0][-1] = lines[0][0]
    ending = str(rng.choice(["\n", "\r\n", "\r"], p=[0.7, 0.2, 0.1]))
    content = bytearray(ending.join(delimiter.join(line) for line in lines).encode())
    if rng.random() < 0.1:
        content[int(rng.integers(len(content)))] = int(rng.integers(256))
    start = b"\xef\xbb\xbf" * int(rng.choice([0, 1, 2], p=[0.85, 0.1, 0.05]))
    return start + bytes(content) + (ending.encode() if rng.random() < 0.7 else b""), is_time
