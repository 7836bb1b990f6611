"""The scripts in examples/, which are the tutorials, each run with small numbers in place of its own."""

import json
import re
import sys
import types
from pathlib import Path

import matplotlib.pyplot as plt
import pytest

from docs._ext.generated import SHOWN_ONLY
from tests.models import TUNED

EXAMPLES = Path(__file__).parents[2] / "examples"
QUICK = {
    "first_steps": {"STEPS": 30},
    "choose_a_filter": {"SEEDS": 4},
    "tune": {"TRIALS": 2},
    "own_model": {"TRIALS": 2, "SEEDS": 4},
    "own_env": {"TRIALS": 2},
    "own_log": {"TRIALS": 2, "ROWS": 400},
    "own_filter": {"SEEDS": 4},
    "policies": {"COPIES": 4, "TRAINING_STEPS": 256, "EPISODES": 2},
    "vehicle": {"STEPS": 20},
    "networks": {"RUNS": 3, "STEPS": 10, "ROUNDS": 2},
}
NEEDS = {"policies": "stable_baselines3", "networks": "torch"}
DRAWING = set(QUICK) - {"policies"}
LONG = {"own_model", "own_env", "own_log", "vehicle", "networks"}  # they compile models of their own
SLOW = pytest.mark.slow


SHOWN = {  # what a page's code makes
    "export": {"content", "made"},
    "missing": {"belief", "innovation"},
    "noise": {"env"},
    "positive": {"session", "median"},
    "processes": {"rewards"},
    "real_time": {"session", "cart"},
    "stable_baselines": {"model", "normalise", "action"},
    "torch": {"estimates", "gradient", "learned"},
    "unknown_constant": {"problem"},
}
HOW_TO = [
    pytest.param(page.stem, "\n".join(blocks), id=page.stem, marks=SLOW if page.stem == "torch" else ())
    for page in sorted((EXAMPLES.parent / "docs" / "howto").glob("*.md"))
    if (blocks := re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL))
]


def quick(name):
    """The source of an example with smaller numbers, on the same lines."""
    source = (EXAMPLES / f"{name}.py").read_text()
    for constant, number in QUICK[name].items():
        source, found = re.subn(rf"^{constant} = [\d_]+$", f"{constant} = {number}", source, flags=re.MULTILINE)
        assert found == 1, constant
    return source


def test_every_example_is_run():
    assert sorted([*QUICK, *SHOWN_ONLY]) == sorted(path.stem for path in EXAMPLES.glob("*.py"))


@pytest.mark.parametrize("name", [pytest.param(name, marks=SLOW if name in LONG else ()) for name in QUICK])
def test_an_example_runs(name, capsys, monkeypatch):
    """Under its own file's name, so that what it compiles is kept from run to run."""
    if name in NEEDS:
        pytest.importorskip(NEEDS[name])
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


@pytest.mark.parametrize(("page", "code"), HOW_TO)
def test_what_a_how_to_page_shows_runs(page, code, tmp_path, monkeypatch):
    if page == "torch":
        pytest.importorskip("torch")
        code = code.replace("3, 50, 1", "3, 8, 1").replace("3, 51, 1", "3, 9, 1")
    if page == "stable_baselines":
        pytest.importorskip("stable_baselines3")
        code = code.replace("num_envs=64", "num_envs=2").replace("n_steps=64", "n_steps=8")
        code = code.replace("batch_size=256", "batch_size=16").replace("400_000", "16")
    (tmp_path / "tuned.json").write_text(json.dumps(TUNED))
    monkeypatch.chdir(tmp_path)
    names = {}
    exec(compile(code, f"docs/howto/{page}.md", "exec"), names)
    assert names.keys() >= SHOWN[page]
