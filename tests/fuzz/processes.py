"""Attacks on processes: Ctrl-C at any moment, kills, journals in pieces, full disks, outputs that take nothing.

Each takes a random generator and the seconds that it may last, and returns a line for the report; it raises
AssertionError with what brings the fault about.
"""

import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

READY = "import os; from tuning.cli import main; main.signal(2, main.leave); os.write(2, b'ready\\n'); main.run()"
TUNE = "tune --filter ekf --scenario nominal --no-pruning --storage j --study s --out s.json --trials"
COMMANDS = ("filters", "inspect", "simulate --steps 2000 --out run.csv", f"{TUNE} 8")
LIMIT_SECONDS = 120  # after which a command counts as one that hangs


def ctrl_c_at_random_moments(rng: np.random.Generator, seconds: float) -> str:
    """Interrupt short commands once, or twice: one line and 130, unless they are done."""
    deadline, tried, interrupted = time.monotonic() + seconds, 0, 0
    with tempfile.TemporaryDirectory() as folder:
        while time.monotonic() < deadline:
            command, times = str(rng.choice(COMMANDS)), int(rng.integers(1, 3))
            waits = rng.uniform(0.0, 3.0, times)
            process = _start(command, folder, stdin=subprocess.DEVNULL)
            assert process.stderr.readline() == "ready\n"
            for wait in waits:
                time.sleep(wait)
                process.send_signal(signal.SIGINT)
            what = f"{command!r} interrupted after {waits.tolist()} s"
            _, errors = _end(process, what)
            assert process.returncode in (0, 130), f"{what}: exit code {process.returncode}: {errors}"
            _no_traceback(errors, what)
            if process.returncode == 130 and not command.startswith("tune"):
                assert errors.splitlines()[-1] == "thruster: interrupted", f"{what}: {errors}"
            tried, interrupted = tried + 1, interrupted + (process.returncode == 130)
    return f"Ctrl-C: {tried} commands, {interrupted} of them interrupted, 0 tracebacks"


def ctrl_c_in_the_last_moments(rng: np.random.Generator, seconds: float) -> str:
    """Interrupt commands at their output or shortly before: it is whole or missing, the exit code 0 or 130."""
    deadline, tried, interrupted = time.monotonic() + seconds, 0, 0
    outputs: dict[str, list[bytes]] = {}
    while time.monotonic() < deadline or not tried:
        command = str(rng.choice(["filters", "filters --json -", "methods", "filters --help"]))
        at_output, wait = bool(rng.integers(2)), float(rng.uniform(0.0, 0.2))
        what = f"{command!r} interrupted {wait} s after its {'first output' if at_output else 'packages'}"
        line, pipe = [sys.executable, "-c", READY, *command.split()], subprocess.PIPE
        process = subprocess.Popen(line, stdout=pipe, stderr=pipe, bufsize=0)
        assert process.stderr.readline() == b"ready\n"
        first = process.stdout.read(1) if command not in outputs or at_output else b""
        if command in outputs:
            time.sleep(wait if at_output else 5.0 * wait)
            process.send_signal(signal.SIGINT)
        out, errors = process.communicate(timeout=LIMIT_SECONDS)
        output = (first + out).rstrip()  # a help's last, empty line is printed apart
        outputs.setdefault(command, [b"", output])
        _no_traceback(errors.decode(), what)
        assert process.returncode in (0, 130), f"{what}: exit code {process.returncode}"
        assert output in outputs[command][process.returncode == 0 :], f"{what}: its output is cut"
        tried, interrupted = tried + 1, interrupted + (process.returncode == 130)
    return f"last moments: {tried} commands, {interrupted} of them interrupted, no output cut"


def kills_and_damaged_journals(rng: np.random.Generator, seconds: float) -> str:
    """Kill a study, cut its journal anywhere, go on: it finishes, or one line says what is damaged."""
    deadline, tried, resumed = time.monotonic() + seconds, 0, 0
    while time.monotonic() < deadline:
        with tempfile.TemporaryDirectory() as folder:
            wait = float(rng.uniform(0.5, 4.0))
            process = _start(f"{TUNE} 400", folder)
            time.sleep(wait)
            process.kill()
            _end(process, "a killed study")
            journal = Path(folder) / "j"
            content = journal.read_bytes() if journal.exists() else b""
            kind, place = str(rng.choice(["whole", "cut", "flip"])), int(rng.integers(0, len(content) + 1))
            if kind == "cut":
                journal.write_bytes(content[:place])
            elif kind == "flip" and place < len(content):
                flipped = bytes([content[place] ^ int(rng.integers(1, 256))])
                journal.write_bytes(content[:place] + flipped + content[place + 1 :])
            what = f"a study killed after {wait} s, its journal {kind} at byte {place} of {len(content)}"
            process = _start(f"{TUNE} 3", folder)
            _, errors = _end(process, what)
            _no_traceback(errors, what)
            allowed = (0, 2) if kind == "flip" else (0,) if kind == "whole" or place else (0, 2)
            assert process.returncode in allowed, f"{what}: exit code {process.returncode}: {errors}"
            tried, resumed = tried + 1, resumed + (process.returncode == 0)
    return f"kills: {tried} studies, {resumed} went on, the others said in a line why not"


def full_disks(rng: np.random.Generator, seconds: float) -> str:
    """Let no file grow beyond a random size: one line, and what was finished is there afterwards."""
    deadline, tried, refused = time.monotonic() + seconds, 0, 0
    while time.monotonic() < deadline:
        with tempfile.TemporaryDirectory() as folder:
            size, command = int(10 ** rng.uniform(1.0, 5.5)), str(rng.choice(COMMANDS[2:]))
            what = f"{command!r} with files of at most {size} bytes"
            process = _start(command, folder, preexec_fn=lambda size=size: _allow_files_of(size))
            _, errors = _end(process, what)
            _no_traceback(errors, what)
            assert process.returncode in (0, 2), f"{what}: exit code {process.returncode}: {errors}"
            if process.returncode == 2 and command.startswith("tune"):
                process = _start(f"{TUNE} 3", folder)  # there is room again
                _, errors = _end(process, f"{what}, then with room")
                assert process.returncode == 0, f"{what}, then with room: {errors}"
            tried, refused = tried + 1, refused + (process.returncode == 2)
    return f"full disks: {tried} commands, {refused} ended with a line, 0 tracebacks"


def outputs_that_take_nothing(rng: np.random.Generator, seconds: float) -> str:
    """Closed, full and abandoned standard output and error: no traceback, and no code 0 where output is lost."""
    deadline, tried = time.monotonic() + seconds, 0
    redirections = (
        ">&-",
        ">/dev/full",
        "2>&-",
        "2>/dev/full",
        ">&- 2>&-",
        "<&- >&- 2>&-",
        "| head -c 0; exit ${PIPESTATUS[0]}",
    )
    with tempfile.TemporaryDirectory() as folder:
        while time.monotonic() < deadline:
            command = str(rng.choice([*COMMANDS[:3], "filters --json -"]))
            where = str(rng.choice(redirections))
            line = f"{sys.executable} -m tuning.cli {command} {where}"
            done = subprocess.run(
                ["bash", "-c", line], cwd=folder, capture_output=True, text=True, timeout=LIMIT_SECONDS
            )
            _no_traceback(done.stderr, line)
            lost = where.startswith((">", "<"))
            allowed = (2,) if lost else (0, 141) if where.startswith("|") else (0,)
            assert done.returncode in allowed, f"{line!r}: exit code {done.returncode}: {done.stderr}"
            tried += 1
    return f"outputs: {tried} commands, 0 tracebacks"


def _start(command: str, folder: str, **options) -> subprocess.Popen:
    return subprocess.Popen(
        [sys.executable, "-c", READY, *command.split()],
        cwd=folder,
        env={**os.environ, "MPLBACKEND": "Agg"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def _end(process: subprocess.Popen, what: str) -> tuple[str, str]:
    try:
        return process.communicate(timeout=LIMIT_SECONDS)
    except subprocess.TimeoutExpired:
        process.kill()
        raise AssertionError(f"{what}: must end, but lives {LIMIT_SECONDS} s later") from None


def _no_traceback(errors: str, what: str) -> None:
    assert "Traceback" not in errors and "Exception ignored" not in errors, f"{what}: {errors}"


def _allow_files_of(size: int) -> None:
    signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))
