"""Random command lines: each does its work, is interrupted, or states one rule in one line; never a traceback."""

from __future__ import annotations

import json
import math
import os
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
import typer

from tuning.cli.app import app
from tuning.cli.main import main

# Small numbers for what would take long, wild ones for everything, words that are right somewhere.
NUMBERS = "0 1 2 5 -1 0.5 12 1e-300 1e12 1e300 nan inf -inf 0x10".split() + ["1" + "0" * 400]
WORDS = (
    "ekf enkf kf auto nominal mismatch outliers tunnel t200 true score ppo a/b -- - . .. /dev/null "
    "no/such/file.json out.csv out.npz out.png out.json tests.models:TUNED [bold] {} é∞ "
    "postgresql://user:secret@127.0.0.1:1/db sqlite:///x.db"
).split() + ["", " ", "\N{PILE OF POO}", "\udcff"]
SMALL = {"--trials": "2", "--seeds": "3", "--steps": "20", "--runs": "2", "--envs": "2", "--workers": "1"}
PATIENCE = 4.0  # seconds of work before a command is interrupted
EXIT_CODES = (0, 1, 2, 3, 130, 141)
FAREWELL = 90.0  # seconds that an interrupted command may take, on a busy machine: it may have code to compile


class Ended(NamedTuple):
    """How a command ended."""

    code: int
    interrupted: bool
    out: str
    errors: str


def command_lines(rng: np.random.Generator, seconds: float) -> str:
    """Commands with options of their own and values right and wrong."""
    commands = dict(_commands(typer.main.get_command(app)))
    counts, end = Counter(), time.monotonic() + seconds
    with tempfile.TemporaryDirectory() as folder:
        while not counts or time.monotonic() < end:
            path = tuple(commands)[rng.integers(len(commands))]
            arguments = [*path, *_arguments(rng, commands[path])]
            ended = run(arguments, Path(folder))
            _judge(arguments, ended)
            counts["interrupted" if ended.interrupted else f"exit code {ended.code}"] += 1
    return ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))


def run(arguments: list[str], folder: Path, patience: float = PATIENCE) -> Ended:
    """Run a command in a fork of this process, which has all packages loaded; interrupt it when patience ends."""
    out, errors = folder / ".out", folder / ".errors"
    child = os.fork()
    if child == 0:
        os.setsid()
        _become(arguments, folder, out, errors)
    started, interrupted = time.monotonic(), False
    while True:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            break
        waited = time.monotonic() - started
        if waited > patience and not interrupted:
            interrupted = True
            os.kill(child, signal.SIGINT)
        if waited > patience + FAREWELL:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            raise AssertionError(f"hangs when it is interrupted: thruster {arguments}")
        time.sleep(0.005)
    texts = [path.read_text(errors="replace") if path.exists() else "" for path in (out, errors)]
    return Ended(os.waitstatus_to_exitcode(status), interrupted, *texts)


def _become(arguments: list[str], folder: Path, out: Path, errors: Path) -> None:
    """Be the command: its folder, its streams, its end."""
    code = 99
    try:
        for number, path in ((0, "/dev/null"), (1, out), (2, errors)):
            os.dup2(os.open(path, os.O_RDWR | os.O_CREAT | os.O_TRUNC), number)
        sys.stdin, sys.stdout = open(0), open(1, "w")
        sys.stderr = open(2, "w", errors="backslashreplace")  # as Python itself has it
        os.chdir(folder)
        sys.argv = ["thruster", *arguments]
        main()
        code = 0
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 0 if stop.code is None else 1
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            try:
                stream.flush()
            except OSError:
                pass
        os._exit(code)


def _judge(arguments: list[str], ended: Ended) -> None:
    said = f"thruster {arguments}: exit code {ended.code}, {ended.out[-1000:]!r}, {ended.errors[-3000:]!r}"
    assert "Traceback" not in ended.errors + ended.out, said
    assert ended.code in EXIT_CODES, said
    if ended.code == 2:
        last = ended.errors.strip().splitlines()[-1:] or [""]
        assert last[0].startswith("thruster: "), said
    if "--json" in arguments and arguments[arguments.index("--json") + 1 :][:1] == ["-"] and ended.code == 0:
        json.loads(ended.out or "null", parse_constant=lambda name: math.nan)
        assert "NaN" not in ended.out, said


def _commands(command, path: tuple[str, ...] = ()):
    """All commands by the words that name them, without those that are many commands in one."""
    if hasattr(command, "commands"):
        for name, part in command.commands.items():
            yield from _commands(part, (*path, name))
    elif path != ("demo",):
        yield path, command


def _arguments(rng: np.random.Generator, command) -> list[str]:
    """Options, most of them right in kind; those that decide how long it takes are small unless they are wild."""
    given: list[str] = []
    for parameter in command.params:
        option = max(parameter.opts, key=len)
        if not option.startswith("-"):
            given += [_value(rng, parameter)] if rng.random() < 0.8 else []
        elif option in SMALL and rng.random() < 0.7:
            given += [option, SMALL[option]]
        elif option != "--help" and rng.random() < 0.25:
            given += [option] if parameter.is_flag else [option, _value(rng, parameter)]
    if rng.random() < 0.05:
        given.insert(int(rng.integers(len(given) + 1)), str(rng.choice(("--help", "--no-such-option", "é"))))
    return given


def _value(rng: np.random.Generator, parameter) -> str:
    numeric = parameter.type_descriptor.annotation in (int, float)
    pool = NUMBERS if (rng.random() < 0.85) == numeric else WORDS
    return str(pool[rng.integers(len(pool))])
