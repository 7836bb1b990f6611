"""Attacks on processes: Ctrl-C at any moment, once or twice, also at the last output."""

import os
import signal
import subprocess
import sys
import tempfile
import time

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
