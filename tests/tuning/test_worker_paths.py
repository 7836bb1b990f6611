"""Files beside the data that are named like modules do not run; a named module is found with what it imports."""

import os
import subprocess
import sys

import pytest

from thruster_env.core.modules import object_named, safe_paths
from tuning.search.workers import as_module

TRAPS = "struct tuning numerics optuna filters json pickle selectors cmaes multiprocessing".split()
PROBLEM = """
from tuning.cli.templates.env import SpringEnv, model
from tuning.problems.env_problem import EnvProblem
import my_helper

def made():
    return my_helper.late(SpringEnv)()

problem = EnvProblem(made, {"name": "steps", "amplitude": 4.0, "hold": 25}, model(), steps=60)
"""
HELPER = "def late(x):\n    import my_other\n    return my_other.same(x)\n"
OTHER = "def same(x):\n    return x\n"


@pytest.fixture
def folder(tmp_path):
    """A folder with a problem of the user's, what it imports, and files that must not run."""
    for name in TRAPS:
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'a').write('{name} ')\n")
    for name, text in (("my_problem", PROBLEM), ("my_helper", HELPER), ("my_other", OTHER)):
        (tmp_path / f"{name}.py").write_text(text)
    return tmp_path


def started(folder, *command):
    """What a process of this Python that works in the folder returned."""
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=300)
    ran = folder / "ran"
    assert not ran.exists(), (command, ran.read_text())
    return done


@pytest.mark.slow
def test_workers_run_no_file_beside_the_data(folder):
    options = (
        "--problem my_problem:problem --filter ekf --trials 4 --workers 2 --no-pruning --storage j --out t.json"
    )
    done = started(folder, os.path.join(os.path.dirname(sys.executable), "thruster"), "tune", *options.split())
    assert done.returncode in (0, 3) and "died" not in done.stderr, done.stderr
    assert (folder / "t.json").exists()


@pytest.mark.slow
def test_the_command_as_a_module_runs_no_file_beside_the_data_either(folder):
    (folder / "tuning.py").unlink()  # which is what Python itself would run
    done = started(folder, sys.executable, "-m", "tuning.cli", "evaluate", "--filter", "ekf", "--seeds", "2",
                   "--problem", "my_problem:problem")  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_our_main_programs_and_processes_that_are_spawned_do_not_look_there_first(folder):
    done = started(folder, *as_module("tuning.search.workers"))
    assert "JSONDecodeError" in done.stderr, "it is the worker, which was told nothing"
    spawn = """
import multiprocessing, sys
from thruster_env.core.modules import safe_paths
sys.path[:] = [one for one in sys.path if one]
if __name__ == "__main__":
    context = multiprocessing.get_context("spawn")
    with safe_paths():
        shared = context.Value("i", 0)
        process = context.Process(target=print, args=("spawned",))
        process.start()
    process.join()
"""
    done = started(folder, sys.executable, "-P", "-c", spawn)
    assert done.stdout == "spawned\n" and done.returncode == 0, done.stderr


def test_the_environment_is_as_before_after_a_safe_start(monkeypatch):
    for before in (None, "", "1"):
        monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
        if before is not None:
            monkeypatch.setenv("PYTHONSAFEPATH", before)
        with safe_paths():
            assert os.environ["PYTHONSAFEPATH"] == "1"
        assert os.environ.get("PYTHONSAFEPATH") == before


def test_a_named_module_finds_those_beside_it_when_it_is_called_and_nobody_else_does(folder, monkeypatch):
    for name in ("my_problem", "my_helper", "my_other"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.chdir(folder)
    monkeypatch.setattr(sys, "path", [one for one in sys.path if one not in ("", str(folder))])
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    found = object_named("my_problem:made", "problem")
    assert found().action_space.shape == (1,) and not (folder / "ran").exists()
    with pytest.raises(ImportError):
        import my_third  # noqa: F401
    (folder / "my_fourth.py").write_text("")
    with pytest.raises(ImportError):
        import my_fourth  # noqa: F401
    for name in ("my_problem", "my_helper", "my_other"):
        monkeypatch.delitem(sys.modules, name, raising=False)
