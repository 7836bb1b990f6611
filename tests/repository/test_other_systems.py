"""What Windows lacks is nowhere taken for granted: its absence is simulated, and sources are read for it."""

import ast
import ctypes
import os
import platform
import re
import signal

import pytest

from tests.repository.test_house import FLOORS, ROOT, nodes_of
from thruster_env.core import files, parallel
from thruster_env.graphs import machine_code
from tuning.api import explore
from tuning.search import storage

# Of the modules os and signal, what our code uses or might; each must be asked for by hasattr.
LACKING = {
    os: ("chown", "fork", "getuid", "register_at_fork", "sched_getaffinity", "sched_setaffinity", "uname"),
    signal: ("SIGALRM", "SIGHUP", "SIGKILL", "pthread_sigmask"),
}
MODULES = "fcntl|grp|pwd|resource|select|termios"
SAME = {"sched_getaffinity": "sched_setaffinity"}  # systems have both or none


@pytest.fixture
def windows(monkeypatch, tmp_path):  # which asks for the user
    for module, names in LACKING.items():
        for name in names:
            monkeypatch.delattr(module, name, raising=False)


def test_files_are_replaced_and_caches_and_left_overs_known_on_windows(windows, monkeypatch, tmp_path):
    monkeypatch.setattr(files.tempfile, "gettempdir", lambda: str(tmp_path))
    for content in ("old", "new"):
        files.write_whole(tmp_path / "file.txt", content)
    assert (tmp_path / "file.txt").read_text() == "new"
    assert files.is_private(tmp_path) and machine_code.private_folder() == str(tmp_path / "thruster-env-code")
    (tmp_path / f"thruster-explore-{2**22 + 1}-x").mkdir()
    explore._remove_left_over()
    assert [path.name for path in tmp_path.glob("thruster-explore*")] == []


def test_processes_share_cores_and_sign_trials_on_windows(windows):
    parallel.take_share(2)
    with parallel.without_interrupts():
        assert parallel.cores.__wrapped__() == os.cpu_count()
    assert storage.this_process() == f"{platform.node()}:{os.getpid()}"


@pytest.mark.parametrize(
    ("handle", "answer", "error", "alive"), [(7, 0x102, 0, 1), (7, 0, 0, 0), (0, 0, 5, 1), (0, 0, 87, 0)]
)
def test_windows_is_asked_for_a_process_and_sends_it_no_signal(monkeypatch, handle, answer, error, alive):
    class Library:
        def __init__(self, *_, **__):
            self.OpenProcess = type("Open", (), {"__call__": lambda self, *_: handle})()  # which has a restype

        WaitForSingleObject = CloseHandle = staticmethod(lambda *_: answer)

    monkeypatch.setattr(storage.sys, "platform", "win32")
    monkeypatch.setattr(storage.os, "kill", None)
    monkeypatch.setattr(ctypes, "WinDLL", Library, raising=False)
    monkeypatch.setattr(ctypes, "get_last_error", lambda: error, raising=False)
    assert storage.is_alive(123) == alive


def test_what_windows_lacks_is_asked_for_before_it_is_used():
    names = {name: module.__name__ for module, names in LACKING.items() for name in names}
    for path in (path for package in FLOORS for path in (ROOT / package).rglob("*.py")):
        source = path.read_text(encoding="utf-8")
        assert not re.search(rf"^(import|from) ({MODULES})\b", source, flags=re.MULTILINE), path
        if not any(f".{name}" in source for name in names):
            continue
        for node in nodes_of(path):
            if isinstance(node, ast.Attribute) and names.get(node.attr, "") == getattr(node.value, "id", None):
                name = SAME.get(node.attr, node.attr)
                pattern = rf"""hasattr\((os|signal), ["']({name}|{node.attr})["']\)"""
                assert re.search(pattern, source), f"{path}: {node.attr}"
