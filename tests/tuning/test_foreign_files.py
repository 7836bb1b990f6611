"""Files that somebody else wrote run no code: tuned files, setups of policies, modules beside the data."""

import json
import os
import pickle
import subprocess
import sys

import gymnasium as gym
import pytest

import thruster_env  # noqa: F401 - registers the envs
from filters import EstimateState, EstimateStates
from tests.filters.checks import refused
from tests.tuned_files import rewrite, write_untuned
from thruster_env.core.modules import object_named, safe_paths
from tuning.api.report import report
from tuning.api.verify import verify
from tuning.evaluation.tuned import read_tuned
from tuning.plants.thruster import find_scenario
from tuning.policies.saved import configuration_from_json
from tuning.policies.setup import in_scenario, make_configuration
from tuning.search.workers import as_module

TRAP = f"{__name__}:trap"
SPRUNG = []


def trap(*arguments, **named):
    """What an attacker would have run."""
    SPRUNG.append(named)


class Trap:
    """Springs when it is unpickled."""

    def __reduce__(self):
        return trap, ()


@pytest.fixture(autouse=True)
def nothing_sprung():
    SPRUNG.clear()
    yield
    assert not SPRUNG


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return write_untuned(tmp_path_factory.mktemp("whole") / "ekf.json").read_text()


def in_model(content):
    content["filter"]["model"] |= {"model": TRAP}


def in_numbers(content):
    content["filter"]["numbers"] |= {"model": TRAP}


@pytest.fixture(params=[in_model, in_numbers])
def file(request, whole, tmp_path):
    """A tuned file that names a function, its hash in order."""
    path = tmp_path / "ekf.json"
    path.write_text(whole)
    return rewrite(path, request.param)


RULE = r"must be .*but got 'model' \(in the tuned file .*ekf.json\)"


def test_a_tuned_file_that_names_code_is_refused_by_all_that_take_one(file):
    scenario, path = find_scenario("medium_noise"), str(file)
    takers = [
        lambda: EstimateState(gym.make("BowThruster-v0"), tuned=path),
        lambda: EstimateStates(gym.make_vec("BowThruster-v0", num_envs=2), tuned=path),
        lambda: EstimateState(gym.make("Pendulum-v1"), tuned=path, model=f"{__name__}:never"),
        lambda: make_configuration("tracking", scenario, "ekf", tuned=path),
        lambda: read_tuned(path),
        lambda: verify(path),
        lambda: report(path, storage="none.journal", progress=False),
    ]
    for take in takers:
        refused(RULE, take)


@pytest.mark.parametrize(
    "command",
    [("train", "--tuned"), ("evaluate", "--tuned"), ("verify",), ("report",), ("compare",)],
    ids=lambda command: command[0],
)
def test_every_command_refuses_it(command, file, thruster, tmp_path):
    done = thruster(*command, "ekf.json")
    assert done.returncode == 2 and "but got 'model' (in the tuned file ekf.json)" in done.stderr
    assert "Traceback" not in done.stderr and [path.name for path in tmp_path.iterdir()] == ["ekf.json"]


SETUP = make_configuration("tracking", find_scenario("medium_noise"), "ekf", steps=256, num_envs=4)
DOCTORED = {
    "a model": (
        {"filter_arguments": {"model": TRAP}},
        "filter_arguments of observe='ekf' must be among .*'model'",
    ),
    "a tuned file": ({"filter_arguments": {"tuned": "x.json"}}, "filter_arguments of .* must be among .*'tuned'"),
    "arguments of no filter": (
        {"observe": "raw", "filter_arguments": {"alpha": 1.0}},
        "among none, but got 'alpha'",
    ),
    "a module": ({"env_id": f"{__name__}:BowThrusterTracking-v0"}, "env_id must be one of BowThrusterTracking-v0"),
    "another env": (
        {"env_id": "Pendulum-v1"},
        "env_id must be one of BowThrusterTracking-v0, but got 'Pendulum-v1'",
    ),
    "a task": ({"task": TRAP}, "task must be one of tracking"),
    "an algorithm": ({"algo": TRAP}, "algo must be one of ppo"),
    "a window": (
        {"env_arguments": {"render_mode": "human"}},
        "env_arguments must be among preset, .*'render_mode'",
    ),
    "a folder": (
        {"hyperparameters": {"tensorboard_log": "/"}},
        "hyperparameters must be among .*'tensorboard_log'",
    ),
    "a class": (
        {"hyperparameters": {"policy_kwargs": {"features_extractor_class": TRAP}}},
        "policy_kwargs must be among .*'features_extractor_class'",
    ),
    "no number": ({"hyperparameters": {"gamma": float("nan")}}, "hyperparameters, gamma must be data: .* got nan"),
    "no mapping": ({"env_arguments": ["dt"]}, r"env_arguments must be a mapping, but got \['dt'\]"),
    "no steps": ({"steps": "many"}, "steps must be a finite number, but got 'many'"),
    "an assumed plant": ({"assumed_plant": {"dt": 0.01}}, "must hold the configuration of a policy"),
    "an entry": ({"module": TRAP}, "must hold the configuration of a policy"),
}


def doctored(change):
    return json.dumps({**json.loads(SETUP.as_json()), **change})


@pytest.mark.parametrize(("change", "rule"), DOCTORED.values(), ids=list(DOCTORED))
def test_a_setup_holds_nothing_but_what_is_known(change, rule):
    with pytest.raises(ValueError, match=rule) as error:
        configuration_from_json(doctored(change), "setup.json")
    assert "setup.json" in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("command", [("score",), ("play",), ("train", "--task", "tracking", "--out")])
def test_a_policy_s_setup_is_checked_before_any_other_of_its_files_is_opened(command, thruster, tmp_path):
    pytest.importorskip("sb3_contrib")
    pytest.importorskip("pygame")
    folder = tmp_path / "policy" / "final"
    folder.mkdir(parents=True)
    for place in (folder, folder.parent):
        (place / "setup.json").write_text(doctored({"filter_arguments": {"model": TRAP}}))
    for name in ("policy.zip", "normalisation.pkl", "replay.pkl"):
        (folder / name).write_bytes(pickle.dumps(Trap()))
    done = thruster(*command, "policy")
    assert done.returncode == 2 and "filter_arguments of observe='ekf' must be among" in done.stderr
    assert "Traceback" not in done.stderr


def test_a_filter_that_goes_on_assuming_its_plant_is_no_text_in_a_file():
    there = in_scenario(SETUP, find_scenario("ambient"))
    assert "model" not in there.filter_arguments and there.assumed_plant["dt"] == 0.01
    assert "assumed_plant" not in there.as_json() and "filters." not in there.as_json()


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
def traps(tmp_path):
    """A folder with a problem of the user's, what it imports, and files that must not run."""
    for name in TRAPS:
        (tmp_path / f"{name}.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'a').write('{name} ')\n")
    for name, text in (("my_problem", PROBLEM), ("my_helper", HELPER), ("my_other", OTHER)):
        (tmp_path / f"{name}.py").write_text(text)
    return tmp_path


def started(traps, *command):
    """What a process of this Python that works in the folder returned."""
    done = subprocess.run(command, cwd=traps, capture_output=True, text=True, timeout=300)
    ran = traps / "ran"
    assert not ran.exists(), (command, ran.read_text())
    return done


@pytest.mark.slow
def test_workers_run_no_file_beside_the_data(traps):
    options = (
        "--problem my_problem:problem --filter ekf --trials 4 --workers 2 --no-pruning --storage j --out t.json"
    )
    done = started(traps, os.path.join(os.path.dirname(sys.executable), "thruster"), "tune", *options.split())
    assert done.returncode in (0, 3) and "died" not in done.stderr, done.stderr
    assert (traps / "t.json").exists()


@pytest.mark.slow
def test_the_command_as_a_module_runs_no_file_beside_the_data_either(traps):
    (traps / "tuning.py").unlink()  # which is what Python itself would run
    done = started(traps, sys.executable, "-m", "tuning.cli", "evaluate", "--filter", "ekf", "--seeds", "2",
                   "--problem", "my_problem:problem")  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
def test_our_main_programs_and_processes_that_are_spawned_do_not_look_there_first(traps):
    done = started(traps, *as_module("tuning.search.workers"))
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
    done = started(traps, sys.executable, "-P", "-c", spawn)
    assert done.stdout == "spawned\n" and done.returncode == 0, done.stderr


def test_the_environment_is_as_before_after_a_safe_start(monkeypatch):
    for before in (None, "", "1"):
        monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
        if before is not None:
            monkeypatch.setenv("PYTHONSAFEPATH", before)
        with safe_paths():
            assert os.environ["PYTHONSAFEPATH"] == "1"
        assert os.environ.get("PYTHONSAFEPATH") == before


def test_a_named_module_finds_those_beside_it_when_it_is_called_and_nobody_else_does(traps, monkeypatch):
    for name in ("my_problem", "my_helper", "my_other"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    monkeypatch.chdir(traps)
    monkeypatch.setattr(sys, "path", [one for one in sys.path if one not in ("", str(traps))])
    monkeypatch.setattr(sys, "meta_path", [*sys.meta_path])
    found = object_named("my_problem:made", "problem")
    assert found().action_space.shape == (1,) and not (traps / "ran").exists()
    with pytest.raises(ImportError):
        import my_third  # noqa: F401
    (traps / "my_fourth.py").write_text("")
    with pytest.raises(ImportError):
        import my_fourth  # noqa: F401
    for name in ("my_problem", "my_helper", "my_other"):
        monkeypatch.delitem(sys.modules, name, raising=False)
