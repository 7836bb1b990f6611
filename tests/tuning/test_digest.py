"""A problem's digest is another for other code or numbers, and the same in another process, run or imported."""

import functools
import subprocess
import sys
import textwrap
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest

from tuning.cli.templates import env as template
from tuning.problems.digest import digest_of
from tuning.problems.env_problem import EnvProblem

TEMPLATE = Path(template.__file__).read_text(encoding="utf-8")
PRINTED = "\n\nif __name__ == '__main__':\n    print(problem.digest)\n"

WITH_PARTS = """
import functools
from dataclasses import dataclass
from enum import Enum
import gymnasium as gym
import numpy as np
import helpers
from helpers import scaled
from tuning.problems.digest import digest_of
{extra}
FACTORS = {{"b": 2.0, "a": [1.0, {constant}]}}
NAMES = {{"x", "yy", "zzz", "w"}}

class Mode(Enum):
    SLOW = 1
    FAST = 2

@dataclass(frozen=True)
class Gains:
    p: float = 1.0
    i: float = 0.5

def lean(x, gains=Gains()):
    return x * FACTORS["a"][1] + helpers.offset(x) + len(NAMES) + Mode.FAST.value

class Base:
    def move(self, x):
        return scaled(x)

class Policy(Base):
    limits = (-1.0, 1.0)
    __slots__ = ("gain", "memory")

    def __init__(self, gain):
        self.gain, self.memory = gain, {{}}

    @property
    def twice(self):
        return 2.0 * self.gain

    @staticmethod
    def plain(x):
        return {static}

    @classmethod
    def of(cls, gain):
        return cls(gain)

    @functools.cached_property
    def table(self):
        return object()

    @functools.lru_cache
    def kept(self, x):
        return x + {kept}

    def __call__(self, x):
        import helpers as late
        return late.offset(self.twice * lean(x)) + self.plain(x) + self.kept(1.0)

    def __hash__(self):
        return 0

policy = Policy({gain})
found = digest_of(
    policy, policy.move, functools.partial(lean, gains=Gains(p=2.0)), lambda x: x + 1.0, lean, Mode.FAST,
    np.random.default_rng(3), gym.spaces.Box(-1.0, 1.0, (2,)), NAMES, object(), Base, len,
    np.random.default_rng(1).normal,
)
if __name__ == "__main__":
    print(found)
"""
HELPERS = "STEP = {step}\n\ndef offset(x):\n    return x + STEP\n\ndef scaled(x):\n    return {scaled} * x\n"
PARTS = {
    "extra": "",
    "constant": "3.0",
    "static": "x",
    "kept": "1.0",
    "gain": "1.5",
    "step": "0.1",
    "scaled": "4.0",
}


def in_a_process(folder, run=True, seed="0", **changes):
    """The digest of the file with its parts, in a process of its own, by running or by importing it."""
    folder.mkdir(exist_ok=True)
    parts = PARTS | changes
    (folder / "parts.py").write_text(textwrap.dedent(WITH_PARTS).format(**parts))
    (folder / "helpers.py").write_text(HELPERS.format(**parts))
    command = ["parts.py"] if run else ["-c", "import parts; print(parts.found)"]
    done = subprocess.run([sys.executable, *command], cwd=folder, capture_output=True, text=True,
                          env={"PYTHONHASHSEED": seed, "PATH": ""})  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


def test_a_digest_is_the_same_in_all_processes_run_or_imported(tmp_path):
    found = {
        in_a_process(tmp_path / str(k), run, seed) for k, (run, seed) in enumerate([(True, "0"), (False, "7")])
    }
    assert len(found) == 1


@pytest.mark.slow
def test_a_digest_is_another_if_any_part_of_the_code_is(tmp_path):
    changed = {"constant": "3.5", "static": "-x", "kept": "2.0", "gain": "1.6", "step": "0.2", "scaled": "5.0"}
    assert changed.keys() == PARTS.keys() - {"extra"}
    found = [in_a_process(tmp_path / name, **{name: part}) for name, part in changed.items()]
    found.append(in_a_process(tmp_path / "same"))
    assert len(set(found)) == len(found)
    assert in_a_process(tmp_path / "more", extra="UNUSED = 3\n\ndef unused():\n    pass\n") == found[-1]


IMPORTED = """
import importlib, sys
for folder in sys.argv[1:]:
    sys.path.insert(0, folder)
    sys.modules.pop("spring", None)
    print(importlib.import_module("spring").problem.digest)
"""


def written(path, changes):
    """A file with the template's text, changed."""
    text = TEMPLATE.partition("\n\nif __name__")[0]
    for before, after in changes:
        assert before in text
        text = text.replace(before, after)
    path.parent.mkdir()
    path.write_text(text + PRINTED)
    return path


def printed(*command):
    """The lines that a process of Python prints."""
    done = subprocess.run([sys.executable, *command], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


WRAPPED = (
    (
        "    SpringEnv,\n    {",
        "    lambda: Weak(SpringEnv()),\n    {",
    ),
    (
        "# Each run is",
        "class Weak(gym.ActionWrapper):\n    def action(self, action): return 0.5 * action\n\n\n# Each run is",
    ),
)
REGISTERED = (
    ("    SpringEnv,\n    {", '    "Spring-v0",\n    {'),
    (
        "# Each run is",
        'gym.register("Spring-v0", entry_point=SpringEnv)\n\n\n# Each run is',
    ),
)
MADE = (("    SpringEnv,\n    {", "    SpringEnv(),\n    {"),)
CHANGES = {
    "step": [("[3e-4, 0.02])  # of the process", "[3e-4, 0.08])  # of the process")],
    "reset": [("[0.1, 0.3]", "[0.1, 0.4]")],
    "a constant": [("MEASUREMENT_STD = 0.01", "MEASUREMENT_STD = 0.02")],
    "what step calls": [("c.stiffness * position - c", "1.01 * c.stiffness * position - c")],
}


@pytest.mark.slow
@pytest.mark.parametrize(
    "form",
    [
        pytest.param((), id="class"),
        pytest.param(WRAPPED, id="wrapped"),
        pytest.param(REGISTERED, id="id"),
        pytest.param(MADE, id="object"),
    ],
)
def test_another_class_of_an_env_is_another_problem(form, tmp_path):
    changes = [[], *list(CHANGES.values())[: 1 if form else 4]]
    if form is WRAPPED:
        changes.append([("0.5 * action", "0.6 * action")])
    files = [written(tmp_path / str(k) / "spring.py", (*form, *change)) for k, change in enumerate(changes)]
    found = printed("-c", IMPORTED, *(file.parent for file in files))
    assert len(set(found)) == len(files)
    assert printed(written(tmp_path / "run" / "another_name.py", form)) == found[:1]


class Gravity(gym.Env):
    """An env with a number and a state of its own."""

    def __init__(self, g=9.81):
        self.g, self.x, self.episodes = g, 0.0, 0
        self.action_space = self.observation_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.episodes = float(self.np_random.uniform()), self.episodes + 1
        return np.array([self.x]), {"state": np.array([self.x])}

    def step(self, action):
        self.x = 0.9 * self.x + float(self.np_random.normal())
        return np.array([self.x]), 0.0, False, False, {"state": np.array([self.x])}


def of_env(env, policy="random", **given):
    from tests.tuning.test_env_streams import model

    return EnvProblem(env, policy, model(), steps=20, first_scored_step=0, scale=(1.0,), **given)


def test_an_env_that_is_an_object_counts_with_its_numbers_and_not_with_its_state():
    env = Gravity()
    found = of_env(env).digest
    problem = of_env(env)
    problem.data([0, 1])
    env.reset()
    assert found == problem.digest == of_env(env).digest == of_env(Gravity()).digest
    assert len({found, of_env(Gravity(9.8)).digest, of_env(Gravity).digest}) == 3
    pendulums = [gym.make("Pendulum-v1", g=g) for g in (10.0, 9.0, 10.0)]
    pendulums[2].unwrapped.m = 2.0
    assert len({of_env(one, state_of=lambda env: env.state).digest for one in pendulums}) == 3


def test_objects_count_with_what_they_hold_and_functions_with_what_they_stand_for():
    box, calls = gym.spaces.Box(-1.0, 1.0, (1,), np.float64), []
    before = digest_of(box)
    box.sample()
    assert digest_of(box) == before != digest_of(gym.spaces.Box(-1.0, 1.5, (1,), np.float64))

    def first(x):
        return x

    def second(x):
        return 2.0 * x

    different = [
        (first, second, first),
        (first, second, second),
        (first, first),
        (first, None),
        (lambda x: x, lambda x: 2 * x),
        (lambda x: 2 * x, lambda x: x),
        functools.partial(first, x=1),
        functools.partial(first, x=2),
        np.array([first, 1.0], dtype=object),
        np.array([first, 2.0], dtype=object),
        {first: 1.0},
        {first: 2.0},
        [calls, calls],
        [[0], [0]],
        range(3),
        range(4),
        np.random.default_rng(1),
        np.random.default_rng(2),
    ]
    assert len({digest_of(one) for one in different}) == len(different)
    assert digest_of(first, second) == digest_of(first, second)
    around: list = []
    around.append(around)
    assert digest_of(around) == digest_of(around)
    assert digest_of([(1, 2), (1, 2)]) == digest_of([(1, 2)] * 2), "not whether it is one object or two"


def test_a_network_counts_with_its_parameters():
    torch = pytest.importorskip("torch")

    def network(seed, activation):
        torch.manual_seed(seed)
        return torch.nn.Sequential(torch.nn.Linear(2, 3), activation(), torch.nn.Linear(3, 1))

    tanh, relu = torch.nn.Tanh, torch.nn.ReLU
    made = [network(1, tanh), network(1, relu), network(2, tanh)]
    assert len({digest_of(one) for one in made}) == 3
    assert digest_of(made[0]) == digest_of(network(1, tanh)) and digest_of(made[0]) != digest_of(made[0][0].weight)
    assert digest_of(made[0].forward) != digest_of(made[2].forward)


@pytest.mark.slow
def test_a_policy_of_stable_baselines_gives_the_same_data_and_digest_in_all_processes(capsys):
    pytest.importorskip("stable_baselines3")
    script = """
        import numpy as np, torch
        from stable_baselines3 import PPO
        from tests.pendulum_problem import model
        from tuning.problems.env_problem import EnvProblem

        policy = PPO("MlpPolicy", "Pendulum-v1", seed=3, n_steps=64, device="cpu")
        torch.manual_seed(np.random.SeedSequence().entropy % 2**32)
        problem = EnvProblem("Pendulum-v1", policy, model(), steps=60,
                             state_of=lambda env: env.state, scale=(1.0, 1.0))
        data = problem.data([1, 2])
        print(problem.digest, data.inputs.tobytes().hex())
    """
    root = str(Path(__file__).parents[2])
    there = subprocess.run(
        [sys.executable, "-c", textwrap.dedent(script)], cwd=root, capture_output=True, text=True
    )
    assert there.returncode == 0, there.stderr
    exec(compile(textwrap.dedent(script), "here", "exec"), {})
    assert there.stdout == capsys.readouterr().out
