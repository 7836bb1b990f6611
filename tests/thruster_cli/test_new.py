"""`thruster new`: what it writes works as it stands, and it never writes over anything."""

import importlib
import runpy
import sys
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from filters import EstimateState
from numerics.compiled import interpreted
from tests.thruster_cli.test_cli import as_json, thruster  # noqa: F401 - fixtures
from thruster_env.parameters import TUNNEL_PHYSICAL
from thruster_env.preset_file import read_preset
from tuning.problems.find import find_problem


@pytest.fixture
def new(thruster, monkeypatch, tmp_path):  # noqa: F811
    """Write a file and say what its module is called; modules are forgotten afterwards."""
    monkeypatch.syspath_prepend(tmp_path)
    known = set(sys.modules)

    def write(kind, name):
        done = thruster("new", kind, name)
        assert done.returncode == 0 and f"wrote {name}." in done.stdout
        text = next(tmp_path.glob(f"{name}.*")).read_text()
        assert "template" not in text
        return name

    yield write
    for name in set(sys.modules) - known:
        if name.startswith("a_new_"):
            del sys.modules[name]


def test_a_problem_can_be_tuned(new, as_json):  # noqa: F811
    name = new("problem", "a_new_problem")
    found = as_json("tune", "--problem", f"{name}:problem", "--filter", "ekf", "--trials", 2)
    held_out = found["held_out"][f"{name}:problem"]
    assert held_out["tuned"]["score"][0] < 2 and found["trials"] == 2


def test_an_env_is_estimated_and_is_a_problem(new):
    module = importlib.import_module(new("env", "a_new_env"))
    with interpreted():
        env = EstimateState(module.SpringEnv(), filter="ekf")
        env.reset(seed=1)
        errors = []
        for _ in range(100):
            *_, info = env.step(env.action_space.sample())
            errors.append(info["estimate"] - info["state"])
    stds = np.sqrt(np.diag(info["estimate_cov"]))
    assert (np.std(errors, axis=0) < 2 * stds).all()
    problem = find_problem("a_new_env:problem")
    assert problem.name == "a_new_env:problem" and len(problem.data([3, 4]).states[0]) == 301


def test_a_model_estimates_the_log_that_it_writes(new, as_json, monkeypatch, tmp_path):  # noqa: F811
    name = new("model", "a_new_model")
    with interpreted():
        runpy.run_path(str(tmp_path / f"{name}.py"), run_name="__main__")
    whose = f"{name}.csv", "--model", f"{name}:model"
    found = as_json("estimate", *whose, "--filter", "ekf")
    assert found["nis_band"][0] < found["mean_nis"] < found["nis_band"][1]


def test_a_preset_is_a_thruster(new, as_json):  # noqa: F811
    name = new("preset", "a_new_preset")
    found = read_preset(f"{name}.toml").parameters
    for one, other in zip(found, TUNNEL_PHYSICAL, strict=True):
        assert one == (pytest.approx(other, rel=1e-6) if isinstance(other, float) else other)
    assert as_json("inspect", "--preset", f"{name}.toml")["picture"] == str(Path("out", f"inspect-{name}-12V.png"))
    assert gym.make("BowThruster-v0", preset=f"{name}.toml").unwrapped.plant.parameters == found


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("modle", "x"), "what is new must be one of problem, model, env, preset, but got 'modle'; did you mean"),
        (("model", "there"), "a new model must not replace a file, but there.py is there"),
        (("preset", "x.py"), "a new preset must end in .toml, but got 'x.py'"),
        (("env", "my-env"), "a module must have a name of letters, digits and _, but got 'my-env'"),
        (("problem", "numpy"), "a new module must not hide one that is installed, but got 'numpy'"),
        (("problem", "none/x"), "must be where it can be written"),
    ],
)
def test_what_cannot_be_new_is_refused(thruster, tmp_path, arguments, line):  # noqa: F811
    (tmp_path / "there.py").write_text("mine\n")
    (tmp_path / "none").write_text("a file\n")
    done = thruster("new", *arguments)
    assert done.returncode == 2 and line in done.stderr
    assert {path.name for path in tmp_path.iterdir()} == {"there.py", "none"}
    assert (tmp_path / "there.py").read_text() == "mine\n"
