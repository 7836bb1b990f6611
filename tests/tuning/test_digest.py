"""A problem's digest is another for other numbers, the same for the same ones however they are written."""

import functools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from tests import pendulum_problem
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from tests.small_problems import pair
from tests.tuned_files import rewrite, write_untuned
from tuning.cli.templates import env as template
from tuning.evaluation.tuned import read_tuned
from tuning.problems.check import digest_of, is_older
from tuning.problems.model_problem import ModelProblem, RunsProblem
from tuning.problems.problem import Parameter
from tuning.search.plan import Plan
from tuning.search.storage import open_storage
from tuning.search.study import open_study

pytestmark = pytest.mark.usefixtures("as_python")

SOURCE = Path(template.__file__).read_text(encoding="utf-8").partition("\n\nif __name__")[0]
SINES = np.sin(np.arange(60.0))[:, None]


def of_text(*changes):
    """The problem of the template's text, changed."""
    text = SOURCE
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    names = {"__name__": "of_text"}
    exec(compile(text, "of_text.py", "exec"), names)
    return names["problem"]


def swing_beyond(x, u, c):
    """Another swing where no run comes and no fixed point lies."""
    if 60.0 < x[1] < 70.0:
        return (0.0, 0.0)
    return pendulum_problem.swing(x, u, c)


def runs(sample=0.0):
    """Recorded runs of the pair's model, of which one has another sample."""
    data = pair().data(range(6))
    measurements = data.measurements.copy()
    measurements[0, 5, 0] += sample
    return RunsProblem([{"inputs": u, "measurements": z} for u, z in zip(data.inputs, measurements, strict=True)],
                       pair().model())  # fmt: skip


one_number = functools.partial(pendulum_problem.of_one_number, steps=60)
model = pendulum_problem.model
pendulums = functools.partial(ModelProblem, model(), inputs=SINES, steps=60)

SAME = {
    "another name": lambda: of_text(
        ("SpringEnv", "OtherEnv"), ("def look", "def unused():\n    pass\n\n\ndef look")
    ),
    "an object": lambda: of_text(("    SpringEnv,\n", "    SpringEnv(),\n")),
}
OTHERS = {
    "the same": of_text,
    "noise of the process": lambda: of_text(("[3e-4, 0.02])  # of", "[3e-4, 0.0201])  # of")),
    "the first state": lambda: of_text(("[0.1, 0.3]", "[0.1, 0.3001]")),
    "a constant of both": lambda: of_text(("MEASUREMENT_STD = 0.01", "MEASUREMENT_STD = 0.0101")),
    "a wrapper": lambda: of_text(
        ("    SpringEnv,\n", "    lambda: gym.wrappers.RescaleAction(SpringEnv(), -4.0, 4.001),\n")
    ),
    "the policy": lambda: of_text(('"hold": 25', '"hold": 26')),
    "the assumed Q": lambda: of_text(("[1e-7, 4e-4]", "[1e-7, 4.001e-4]")),
    "the assumed prior": lambda: of_text(("[0.01, 0.1]", "[0.01, 0.1001]")),
    "the assumed range": lambda: of_text(("[0.2, 1.0]", "[0.2, 1.001]")),
    "a pair": pendulums,
    "f of the assumed model": lambda: pendulums(model(transition=lambda x, u, c: (x[0] + 0.05 * x[1], x[1]))),
    "inputs": lambda: pendulums(inputs=1.0001 * SINES),
    "scale": lambda: pendulums(scale=[1.0, 2.0]),
    "scored steps": lambda: pendulums(first_scored_step=20),
    "dt": lambda: pendulums(dt=0.05),
    "true": lambda: pendulums(true={"process_noise_cov": (0.1, 0.2)}),
    "untuned": lambda: pendulums(untuned={"process_noise_cov": (0.1, 0.2)}),
    "parameters": one_number,
    "their range": lambda: pendulum_problem.problem(model, steps=60, parameters=[Parameter("sigma", 1e-3, 1.01)]),
    "runs": runs,
    "a sample": lambda: runs(1e-4),
}


def test_the_digest_is_of_numbers_and_not_of_how_they_are_written():
    digests = {name: make().digest for name, make in OTHERS.items()}
    assert len(set(digests.values())) == len(digests) and {len(text) for text in digests.values()} == {16}
    for make in (of_text, *SAME.values()):
        assert make().digest == digests["the same"]
    command = "from tuning.cli.templates.env import problem; print(problem.digest)"
    done = subprocess.run([sys.executable, "-c", command], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == digests["the same"], "in another process, and compiled"


def test_rounding_is_no_other_number_and_what_no_run_reaches_is_missed():
    array = np.random.default_rng(1).normal(size=(300, 3)) * [1e-9, 1.0, 1e9]
    array[::7] = np.nan
    assert digest_of(array) == digest_of(array * (1.0 + 1e-13)) != digest_of(array * (1.0 + 1e-5))
    assert digest_of(0.1 + 0.2, -0.0) == digest_of(0.3, -0.0) != digest_of(0.3001, -0.0)
    assert digest_of(np.zeros((2, 3))) != digest_of(np.zeros((3, 2)))
    assert digest_of({"a": 1}) != digest_of({"a": 2})
    assert pendulums(model(transition=swing_beyond)).digest == pendulums(model()).digest
    with pytest.warns(UserWarning, match="transition_jacobian must be the slope of transition"):
        wrong = model(transition_jacobian=lambda x, u, c: ((1.0, 0.0), (0.0, 1.0)))
    assert pendulums(wrong).digest == pendulums(model()).digest


def test_a_digest_of_an_older_version_is_no_other_problem_and_is_said(tmp_path):
    old, new = "0123456789ab", one_number().digest
    assert is_older([old], [new]) and is_older({"a": old}, {"a": new})
    assert not is_older(old, LinearProblem().digest)
    storage, plan = open_storage(str(tmp_path / "studies.journal")), Plan("ekf", (one_number(),))
    study = open_study("mine", plan, storage)
    study.set_user_attr("identity", {**plan.identity, "scenario_digests": [old]})
    refused("but 'mine' has those of an older one, .*: give it another name", open_study, "mine", plan, storage)
    problem = one_number(name="of:mine")
    path = write_untuned(tmp_path / "tuned.json", problem)

    def age(content):
        content["problems"]["of:mine"]["digest"] = old

    with pytest.warns(UserWarning, match="cannot be told from its digest, which is that of an older version"):
        assert read_tuned(rewrite(path, age), [problem])[1] is problem


@pytest.mark.slow
def test_a_policy_of_stable_baselines_gives_the_same_data_and_digest_in_all_processes():
    pytest.importorskip("stable_baselines3")
    script = """
import numpy as np, torch
from stable_baselines3 import PPO
from tests.pendulum_problem import model
from tuning.problems.env_problem import EnvProblem
policy = PPO("MlpPolicy", "Pendulum-v1", seed=3, n_steps=64, device="cpu")
torch.manual_seed(np.random.SeedSequence().entropy % 2**32)
problem = EnvProblem("Pendulum-v1", policy, model(), steps=60, state_of=lambda env: env.state, scale=(1.0, 1.0))
print(problem.digest, problem.data([1, 2]).inputs.tobytes().hex())
"""
    root = str(Path(__file__).parents[2])
    process = {"cwd": root, "capture_output": True, "text": True, "check": True}
    printed = [subprocess.run([sys.executable, "-c", script], **process).stdout for _ in range(2)]
    assert printed[0] == printed[1]
