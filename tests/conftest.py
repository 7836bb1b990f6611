"""No test opens a window, in CI no test is skipped for want of a package, and compiling can be left out."""

import gc
import json
import os
import re
import sys
from typing import NamedTuple

import pytest

from thruster_env.core.compiled import interpreted

# Before anything imports matplotlib or pygame.
os.environ.setdefault("MPLBACKEND", "Agg")
os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
# Each worker is a core's; threads of torch and of BLAS would wait for one another there.
os.environ.setdefault("OMP_NUM_THREADS", "1")


class MissingPackages:
    """Fails the session when a test was skipped because a package is missing or too old.

    Such a skip is right on a user's machine. CI installs everything, so there it would hide a broken install.
    """

    # What importorskip, a failed import and a hand-written skipif say.
    reason = re.compile(r"could not import|No module named|not installed|required is:", re.IGNORECASE)

    def __init__(self):
        self.skipped = {}

    def note(self, report):
        # A skip carries (file, line, reason); an expected failure is reported as skipped too, and is none.
        if report.skipped and not hasattr(report, "wasxfail"):
            reason = str(report.longrepr[-1])
            if self.reason.search(reason):
                self.skipped[report.nodeid] = reason.removeprefix("Skipped: ")

    pytest_runtest_logreport = note

    def pytest_collectreport(self, report):  # a whole module skipped
        self.note(report)

    def pytest_sessionfinish(self, session, exitstatus):
        if self.skipped and exitstatus in (pytest.ExitCode.OK, pytest.ExitCode.NO_TESTS_COLLECTED):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter):
        for nodeid, reason in self.skipped.items():
            terminalreporter.write_line(f"FAILED, a package is missing: {nodeid}: {reason}", red=True)


@pytest.hookimpl(wrapper=True)
def pytest_collection():
    """What imports make lives to the end, and looking for garbage in it takes a third of their time.

    Later, too, garbage in cycles is looked for seldom: Python's defaults take a tenth of the tests' time.
    """
    gc.disable()
    gc.set_threshold(50_000, 20, 5)
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


def pytest_configure(config):
    if os.environ.get("CI"):
        config.pluginmanager.register(MissingPackages(), "missing-packages")


@pytest.fixture
def undrawn(monkeypatch):
    """Pictures of reports have their caption and text only: to draw them takes most of a page's time."""
    monkeypatch.setattr(
        "tuning.reporting.page.figure_svg", lambda _, name: (f'<svg data-name="{name}"></svg>', "")
    )


@pytest.fixture
def only_new_garbage():
    """The garbage collector visits what the test makes: all else of a worker takes it a second."""
    gc.freeze()


@pytest.fixture
def as_python():
    """Nothing is compiled: exactness needs none, and that both ways agree is for the contract to test."""
    with interpreted():
        yield


class Done(NamedTuple):
    """How a command ended."""

    returncode: int
    stdout: str
    stderr: str


@pytest.fixture
def thruster(tmp_path, monkeypatch, capsys):
    """Run the command in this process, in an empty folder."""
    from tuning.cli.main import main

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "100")

    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["thruster", *map(str, arguments)])
        capsys.readouterr()
        try:
            main()
            code = 0
        except SystemExit as stop:
            code = stop.code or 0
        return Done(code, *capsys.readouterr())

    return run


@pytest.fixture
def as_json(thruster):
    """Run a command that must succeed, and read its JSON."""

    def run(*arguments):
        done = thruster(*arguments, "--json", "-")
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout)

    return run
