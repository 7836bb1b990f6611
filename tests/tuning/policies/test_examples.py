"""Files for scripts of one's own: examples/ppo.py learns, and hyperparams/ work in rl_zoo3 as they are."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import tuning.policies
from tuning.policies.algorithms import ALGORITHMS

ROOT = Path(__file__).resolve().parents[3]
FILE = ROOT / "examples" / "ppo.py"


@pytest.fixture(scope="module")
def ppo():
    spec = importlib.util.spec_from_file_location("ppo_example", FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_the_vec_env_is_public_and_found_lazily():
    from tuning.policies import NativeVecEnv
    from tuning.policies.environments import NativeVecEnv as Same

    assert NativeVecEnv is Same and "NativeVecEnv" in dir(tuning.policies)
    with pytest.raises(AttributeError, match="module 'tuning.policies' has no attribute 'Native'"):
        tuning.policies.Native  # noqa: B018
    code = "import sys, tuning.policies; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"


def test_without_the_extra_one_line_says_what_to_install(monkeypatch):
    monkeypatch.setattr("tuning.policies.algorithms.NEEDED", ("no_such_package",))
    with pytest.raises(ValueError, match=r"no_such_package, which is not installed: pip install '\.\[rl\]'"):
        tuning.policies.NativeVecEnv  # noqa: B018


def test_the_example_has_the_numbers_that_thruster_train_takes(ppo):
    ours = {**ALGORITHMS["ppo"].hyperparameters}
    assert ours.pop("learning_rate") == 1e-3
    assert ours == ppo.PPO_NUMBERS and ALGORITHMS["ppo"].num_envs == ppo.COPIES


def test_single_and_vector_envs_of_the_example_are_the_same(ppo):
    venv, env = ppo.make_training(copies=2, seed=5), ppo.make_single()
    venv.training = False  # observations as they are, but for a scale of 1
    many = venv.unwrapped.reset() if hasattr(venv.unwrapped, "reset") else venv.reset()
    one, _ = env.reset(seed=5)
    np.testing.assert_array_equal(np.asarray(many)[0], one)
    venv.unwrapped.step_async(np.array([[0.5], [0.5]], dtype=np.float32))
    many = venv.unwrapped.step_wait()[0]
    one = env.step(np.array([0.5], dtype=np.float32))[0]
    np.testing.assert_allclose(many[0], one, rtol=1e-6)


def test_the_example_learns_and_saves_in_quick_form(ppo, tmp_path, capsys):
    out = tmp_path / "policy"
    returns = ppo.main(["--steps", "256", "--copies", "4", "--episodes", "1", "--out", str(out)])
    assert len(returns) == 1 and np.isfinite(returns).all()
    assert "mean return of 1 held-out episodes" in capsys.readouterr().out
    assert out.with_suffix(".zip").is_file() and Path(f"{out}.pkl").is_file()


NAMES = {"ppo": "ppo", "sac": "sac", "td3": "td3", "ppo_lstm": "recurrent-ppo"}
every_file = pytest.mark.parametrize("name", NAMES)
# Importing it would change Gymnasium's TimeLimit for all tests.
with_rl_zoo = pytest.mark.skipif(importlib.util.find_spec("rl_zoo3") is None, reason="rl_zoo3 is not installed")


@with_rl_zoo
@every_file
def test_the_numbers_are_those_of_thruster_train(name):
    yaml = pytest.importorskip("yaml")
    told = yaml.safe_load((ROOT / "hyperparams" / f"{name}.yml").read_text())["default"]
    algorithm = ALGORITHMS[NAMES[name]]
    told.pop("env_wrapper")
    assert told.pop("normalize") is True and told.pop("policy") == algorithm.policy
    assert (told.pop("n_envs"), told.pop("n_timesteps")) == (algorithm.num_envs, algorithm.steps)
    told["learning_rate"] = float(told["learning_rate"].removeprefix("lin_"))
    if "noise_std" in told:
        assert told.pop("noise_type") == "normal"
    assert told == algorithm.hyperparameters


def test_there_is_a_file_for_every_algorithm_and_no_other():
    assert {path.stem for path in (ROOT / "hyperparams").glob("*")} == set(NAMES)
    assert set(NAMES.values()) == set(ALGORITHMS)


@with_rl_zoo
@pytest.mark.slow
def test_rl_zoo_trains_with_them(tmp_path):
    """One process trains with all files, as most of its time goes into imports."""
    lines = []
    for name in NAMES:
        conf = str(ROOT / "hyperparams" / f"{name}.yml")
        words = ["train", "--algo", name, "--env", "BowThrusterTracking-v0", "--gym-packages", "thruster_env"]
        words += ["--conf-file", conf, "--log-folder", str(tmp_path), "--n-timesteps", "300", "--eval-freq", "-1"]
        words += ["--num-threads", "1", "--seed", "1", "--hyperparams", "n_envs:2"]
        lines.append([*words, *(["n_steps:32", "batch_size:64"] if "ppo" in name else [])])
    code = "import json, sys\nfrom rl_zoo3.train import train\nlines = json.loads(sys.argv[1])\n"
    code += "for words in lines:\n    sys.argv[:] = words\n    train()\n"
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-c", code, json.dumps(lines)]
    done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stderr
    for name in NAMES:
        run = tmp_path / name / "BowThrusterTracking-v0_1"
        assert (run / "BowThrusterTracking-v0.zip").is_file()
        assert (run / "BowThrusterTracking-v0" / "vecnormalize.pkl").is_file()
        config = (run / "BowThrusterTracking-v0" / "config.yml").read_text()
        assert "filters.EstimateState" in config and "RescaleAction" in config
