"""How a command ends: Ctrl-C at any moment, outputs that take nothing, characters that a terminal lacks."""

import errno
import fcntl
import io
import os
import signal
import struct
import subprocess
import sys
import termios
import time

import pytest

import tuning.cli.app
from tests.slow import slow_but
from thruster_env.core.text_tables import showable
from tuning.cli.main import main

INTERRUPTED = "thruster: interrupted\n"
AT_IMPORT = """
class Moment:
    def find_spec(self, name, path=None, target=None):
        if name == sys.argv[0]:
            os.kill(os.getpid(), signal.SIGINT)
import os, signal, sys
sys.meta_path.insert(0, Moment())
"""
AT_COMPILATION = """
import os, signal
from thruster_env.graphs import machine_code
compiled = machine_code._compiled
def interrupted(*arguments):
    os.kill(os.getpid(), signal.SIGINT)
    return compiled(*arguments)
machine_code._compiled = interrupted
"""
AT_THE_END = """
import atexit, os, signal
atexit.register(lambda: os.kill(os.getpid(), signal.SIGINT))
"""
AT_FIRST_OUTPUT = """
import os, signal, sys
class Moment(type(sys.stdout)):
    sent = False
    def write(self, text):
        half = len(text) // 2
        count = super().write(text[:half])
        self.flush()
        if not self.sent:
            self.sent = True
            os.kill(os.getpid(), signal.SIGINT)
        return count + super().write(text[half:])
sys.stdout = Moment(sys.stdout.buffer, encoding="utf-8", write_through=True)
"""
AFTER_HANDLERS = """
import os, signal, sys, types
class Moment:
    def __del__(self, kill=os.kill, process=os.getpid(), number=signal.SIGINT): kill(process, number)
sys.modules["moment"] = types.ModuleType("moment")
sys.modules["moment"].last = Moment()
"""
TWICE = """
import os, tuning.cli.app, tuning.cli.main
def slow_to_end(standalone_mode):
    try:
        os.kill(os.getpid(), 2)
    finally:
        os.kill(os.getpid(), 2)
        print("not reached")
tuning.cli.app.app = slow_to_end
tuning.cli.main.run()
"""


def process(before, name, arguments="filters", **options):
    """Run a command in a process of its own, after some lines of Python."""
    code = f"{before}\nimport sys\nfrom tuning.cli.main import run\nsys.argv[0] = {name!r}\nrun()"
    arguments = [sys.executable, "-c", code, *arguments.split()]
    return subprocess.run(arguments, stderr=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True, **options)


@pytest.mark.parametrize(
    ("module", "arguments"),
    slow_but(
        [
            *((name, "simulate --steps 3 --out run.csv") for name in ("typer", "numpy.linalg", "llvmlite")),
            ("optuna.samplers", "tune --trials 1"),
        ],
        [("optuna.samplers", "tune --trials 1")],
    ),
    ids=lambda name: name,
)
def test_ctrl_c_while_a_package_loads_is_one_line(module, arguments, tmp_path):
    done = process(AT_IMPORT, module, arguments, cwd=tmp_path, stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr, done.stdout) == (130, INTERRUPTED, "")
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_ctrl_c_while_code_is_compiled_is_one_line(tmp_path):
    cold = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path / "cold")}
    done = process(AT_COMPILATION, "thruster", f"simulate --steps 3 --out {tmp_path}/run.csv", env=cold)
    assert done.returncode == 130 and done.stderr.splitlines()[-1] == INTERRUPTED.strip()
    assert "Traceback" not in done.stderr and "Exception" not in done.stderr
    assert not (tmp_path / "run.csv").exists()


def test_ctrl_c_at_the_end_is_one_line_or_changes_nothing():
    done = process(AT_THE_END, "thruster", stdout=subprocess.DEVNULL)
    assert (done.returncode, done.stderr) == (130, INTERRUPTED)
    done = process(AFTER_HANDLERS, "thruster", "--version", stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr, done.stdout.split()[0]) == (0, "", "thruster-env")


@pytest.mark.parametrize("arguments", slow_but(["filters kf", "filters kf --json -", "--help"], ["filters kf"]))
def test_ctrl_c_while_results_are_printed_leaves_them_whole(arguments):
    whole = process("", "thruster", arguments, stdout=subprocess.PIPE)
    done = process(AT_FIRST_OUTPUT, "thruster", arguments, stdout=subprocess.PIPE)
    assert (done.returncode, done.stderr, done.stdout.rstrip()) == (130, INTERRUPTED, whole.stdout.rstrip())
    assert whole.returncode == 0 and len(whole.stdout) > 200


def test_a_second_ctrl_c_ends_a_command_whose_output_nobody_reads():
    command = [sys.executable, "-m", "tuning.cli", "filters"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, pipesize=4096) as running:
        readable = struct.pack("i", 0)
        while struct.unpack("i", fcntl.ioctl(running.stdout, termios.FIONREAD, readable))[0] < 4096:
            time.sleep(0.02)
        running.send_signal(signal.SIGINT)
        with pytest.raises(subprocess.TimeoutExpired):
            running.wait(0.5)
        running.send_signal(signal.SIGINT)
        assert running.wait(10) == 130 and running.stderr.read().decode() == INTERRUPTED


@pytest.fixture
def ends(monkeypatch, capsys):
    """How a command ends that does what a function does: its exit code and what it says."""

    def end(function):
        monkeypatch.setattr(tuning.cli.app, "app", lambda standalone_mode: function())
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code, capsys.readouterr().err

    return end


def interrupt():
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(30)


class InterruptedAtItsEnd:
    def __del__(self):
        interrupt()


def interrupted_where_python_cannot_say_so():
    InterruptedAtItsEnd()
    time.sleep(30)


def interrupted_in_a_package_that_makes_something_else_of_it():
    try:
        interrupt()
    except KeyboardInterrupt:
        raise ImportError("numpy._core.multiarray failed to import") from None


@pytest.mark.parametrize(
    "function",
    [interrupt, interrupted_where_python_cannot_say_so, interrupted_in_a_package_that_makes_something_else_of_it],
)
def test_no_ctrl_c_is_lost(ends, function):
    assert ends(function) == (130, INTERRUPTED)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_second_ctrl_c_ends_the_process_at_once():
    done = subprocess.run([sys.executable, "-c", TWICE], capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", INTERRUPTED)


def failing(error):
    def function():
        raise error

    return function


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (OSError(errno.ENOSPC, "No space left on device"), 2, "the system says: No space left on device"),
        (OSError(errno.EFBIG, "File too large", "j"), 2, "can be read and written, but got j: File too large"),
        (BrokenPipeError(errno.EPIPE, "Broken pipe"), 141, None),
        (SystemExit(130), 130, None),
        (SystemExit(), 0, None),
        (ValueError("dt must be positive"), 2, "thruster: dt must be positive"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_the_system_refuses_is_one_line(ends, error, code, line):
    found, said = ends(failing(error))
    assert found == code
    assert said.endswith(f"{line}\n") and said.count("\n") == 1 if line else said == ""


def test_a_standard_output_that_is_full_is_said_and_json_is_written_first(monkeypatch, capsys, tmp_path):
    with open("/dev/full", "w") as full:
        monkeypatch.setattr(sys, "stdout", full)
        monkeypatch.setattr(sys, "argv", ["thruster", "filters", "kf", "--json", str(tmp_path / "kf.json")])
        with pytest.raises(SystemExit) as stop:
            main()
    assert stop.value.code == 2
    said = capsys.readouterr().err
    begins = "thruster: files and standard output must take what is written, but the system says: "
    assert said == f"{begins}No space left on device\n"
    assert (tmp_path / "kf.json").stat().st_size > 100


def test_a_standard_output_that_is_closed_is_said():
    command = [sys.executable, "-m", "tuning.cli", "filters", "kf"]
    done = subprocess.run(["sh", "-c", '"$@" >&-', "sh", *command], stderr=subprocess.PIPE, text=True)
    assert done.returncode == 2
    assert done.stderr.startswith("thruster: files and standard output must") and done.stderr.count("\n") == 1


@pytest.mark.parametrize("encoding", ["ascii", "latin-1", "cp1252"])
def test_a_table_is_whole_in_every_encoding(monkeypatch, encoding):
    bare = io.TextIOWrapper(raw := io.BytesIO(), encoding=encoding)
    monkeypatch.setattr(sys, "stdout", bare)
    monkeypatch.setattr(sys, "argv", ["thruster", "inspect", "--preset", "open_bladed", "--help"])
    with pytest.raises(SystemExit) as stop:
        main()
    shown = raw.getvalue().decode(encoding)
    assert stop.value.code == 0 and "--preset" in shown and "?" not in shown
    options = shown.splitlines()[shown[: shown.index("- Options -")].count("\n") :]
    assert {line[0] + line[-1] for line in options if line.strip()} == {"++", "||"}


def test_what_an_encoding_lacks_is_written_in_other_characters():
    assert showable("5.2 ±0.1 µs, ω_m, Cramér, … ┏━┓┃", "ascii") == "5.2 +-0.1 us, w_m, Cramer, ... +-+|"
    assert showable("5.2 ±0.1", "iso8859-1") == showable("5.2 ±0.1", "utf-8") == "5.2 ±0.1"
    assert showable("船", "ascii") == "?"
