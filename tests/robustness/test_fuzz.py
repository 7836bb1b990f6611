"""The attacks of `make fuzz`: each for a moment here, with a fixed seed; and one that must find what is wrong."""

import json
import pkgutil
import sys

import numpy as np
import pytest

import tests.fuzz
from tests.fuzz import commands, files
from tests.fuzz.__main__ import attacks
from tests.models import TUNED
from tests.slow import slow_but

OF_PROCESSES = "processes.", "checkpoints."  # tests of their own show what these attack
ATTACKS = [name for name in attacks() if not name.startswith(OF_PROCESSES)]
SLOW = {  # wait, compile, start processes
    "files.journals",
    "commands.command_lines",
    "arithmetic.compiled_arithmetic",
    "arithmetic.filtered_arithmetic",
}


def test_every_file_has_attacks():
    files_ = {module.name for module in pkgutil.iter_modules(tests.fuzz.__path__)} - {"__main__"}
    assert {name.partition(".")[0] for name in attacks()} == files_


@pytest.mark.parametrize("name", slow_but(ATTACKS, set(ATTACKS) - SLOW))
def test_an_attack_of_a_moment_is_withstood(name):
    assert attacks()[name](np.random.default_rng(1), 0.2)


def test_a_traceback_is_found():
    ended = commands.Ended(2, False, "", "Traceback (most recent call last):\nValueError: x")
    with pytest.raises(AssertionError, match="Traceback"):
        commands._judge(["tune"], ended)


def test_code_that_a_file_names_is_found(tmp_path):
    def careless(path):
        module, _, name = json.loads(path.read_text())["model"].partition(":")
        getattr(sys.modules[module], name)()

    def write(path):
        path.write_text(json.dumps({**TUNED, "model": f"{files.TRAP}:spring"}))

    with pytest.raises(AssertionError, match="SystemExit"):
        files._attack(np.random.default_rng(0), 0.0, write, careless)
