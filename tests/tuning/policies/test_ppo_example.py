"""PPO in one's own script: `NativeVecEnv` is public, and examples/ppo.py learns with few steps."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import tuning.policies
from tuning.policies.algorithms import ALGORITHMS

FILE = Path(__file__).resolve().parents[3] / "examples" / "ppo.py"


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
