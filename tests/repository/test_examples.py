"""The scripts in examples/, which are the tutorials, each run with small numbers in place of its own."""

import re
import sys
import types
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from pages.site.gallery import SHOWN_ONLY

EXAMPLES = Path(__file__).parents[2] / "examples"
QUICK = {
    "first_steps": {"STEPS": 30},
    "choose_a_filter": {"SEEDS": 4},
    "tune": {"TRIALS": 2},
    "own_model": {"TRIALS": 2, "SEEDS": 4},
    "own_env": {"TRIALS": 2},
    "own_log": {"TRIALS": 2, "ROWS": 400},
    "policies": {"COPIES": 4, "TRAINING_STEPS": 256, "EPISODES": 2},
    "vehicle": {"STEPS": 20},
}
DRAWING = set(QUICK) - {"policies"}


def quick(name):
    """The source of an example with smaller numbers, on the same lines."""
    source = (EXAMPLES / f"{name}.py").read_text()
    for constant, number in QUICK[name].items():
        source, found = re.subn(rf"^{constant} = [\d_]+$", f"{constant} = {number}", source, flags=re.MULTILINE)
        assert found == 1, constant
    return source


def test_every_example_is_run():
    assert sorted([*QUICK, *SHOWN_ONLY]) == sorted(path.stem for path in EXAMPLES.glob("*.py"))


@pytest.mark.slow
@pytest.mark.parametrize("name", QUICK)
def test_an_example_runs(name, capsys, monkeypatch):
    """Under its own file's name, so that what it compiles is kept from run to run."""
    if name == "policies":
        pytest.importorskip("stable_baselines3")
    pytest.importorskip("pandas")
    module = types.ModuleType(f"examples_{name}")
    module.__file__ = str(EXAMPLES / f"{name}.py")
    monkeypatch.setitem(sys.modules, module.__name__, module)
    exec(compile(quick(name), module.__file__, "exec"), vars(module))
    plt.close("all")
    printed = capsys.readouterr().out
    assert "nan" not in printed
    assert printed
    if name in DRAWING:
        assert "figure" in vars(module)
