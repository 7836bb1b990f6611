"""Files in `hyperparams/` work in rl_zoo3 as they are, and say what `tuning.policies.algorithms` says."""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

if importlib.util.find_spec("rl_zoo3") is None:  # importing it would change Gymnasium's TimeLimit for all tests
    pytest.skip("rl_zoo3 is not installed", allow_module_level=True)

import yaml

from tuning.policies.algorithms import ALGORITHMS

ROOT = Path(__file__).resolve().parents[3]
NAMES = {"ppo": "ppo", "sac": "sac", "td3": "td3", "ppo_lstm": "recurrent-ppo"}
every_file = pytest.mark.parametrize("name", NAMES)


@every_file
def test_the_numbers_are_those_of_thruster_train(name):
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
