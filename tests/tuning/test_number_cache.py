"""Numbers that took long are computed once, and anew where anything that they follow from changes."""

import os
import re

import numpy as np
import pytest

from tuning.problems import model_problem
from tuning.problems.model_problem import cached_numbers


class Code:
    """What tells a folder, as compiled code does."""

    def __init__(self, folder):
        self.folder = folder and str(folder)


@pytest.fixture
def ask(monkeypatch, tmp_path):
    """Ask for two numbers in a fresh process, so to speak; `ask.computed` counts."""
    monkeypatch.setattr(model_problem, "_known", {})

    def ask(follows_from=b"it", value=(0.1, 1e-300), folder=tmp_path / "cache", fresh=True):
        if fresh:
            model_problem._known.clear()

        def compute():
            ask.computed += 1
            return np.array(value)

        return cached_numbers("bound", 2, follows_from, Code(folder), compute)

    ask.computed = 0
    return ask


def test_another_process_finds_the_same_digits(ask, tmp_path):
    first, second = ask(), ask()
    assert first.tolist() == second.tolist() == [0.1, 1e-300] and ask.computed == 1
    (file,) = (tmp_path / "cache").iterdir()
    assert re.fullmatch(r"bound-[0-9a-f]{32}\.json", file.name)
    first[:] = 0.0  # of the caller alone
    assert ask(fresh=False).tolist() == [0.1, 1e-300]


def test_what_they_follow_from_and_the_processor_tell_them_apart(ask, monkeypatch):
    ask(), ask(b"something else", (3.0, 4.0))
    assert ask().tolist() == [0.1, 1e-300] and ask(b"something else").tolist() == [3.0, 4.0] and ask.computed == 2
    monkeypatch.setattr("thruster_env.graphs.machine_code.host", lambda: "another processor")
    assert ask(value=(5.0, 6.0)).tolist() == [5.0, 6.0]


@pytest.mark.parametrize("content", [b"", b"[1.0]", b"[1.0, NaN]", b'{"a": 1}', b'["x", 1]', b"\xff", b"[1, [2]]"])
def test_a_damaged_file_is_as_none(ask, tmp_path, content):
    ask()
    (file,) = (tmp_path / "cache").iterdir()
    file.write_bytes(content)
    assert ask().tolist() == [0.1, 1e-300] and ask.computed == 2


def test_without_a_folder_they_last_as_long_as_the_process(ask, tmp_path):
    ask(folder=None), ask(folder=None, fresh=False)
    assert ask.computed == 1
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert ask(folder=blocked / "below").tolist() == [0.1, 1e-300] and os.path.isfile(blocked)


def test_numbers_that_are_not_finite_are_not_kept(ask):
    assert np.isnan(ask(value=(np.nan, 1.0))).any() and ask().tolist() == [0.1, 1e-300]
