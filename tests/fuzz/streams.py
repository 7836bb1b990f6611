"""Attacks on what a run follows from: the seed alone, digests of numbers, arrays that others write into."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable

import gymnasium as gym
import numpy as np

from filters import StateSpaceModel
from filters.engine.batch import run
from filters.estimators.foreign import Estimator
from filters.registry import make_filter
from tests.fuzz.python_interface import _until
from tests.models import scalar_model
from tuning.problems.env_problem import EnvProblem

STEPS, RUNS = 50, 20
SURE = 6.0  # standard deviations of a correlation: one of some 1e8 pairs is beyond
DRAWS: dict[str, Callable] = {
    "env": lambda env: env.np_random.uniform(-1.0, 1.0),
    "NumPy": lambda env: np.random.uniform(-1.0, 1.0),
    "Python": lambda env: random.uniform(-1.0, 1.0),
}


class Plant(gym.Env):
    """x' = a x + b u + w, w from one of several generators; arrays are new ones or the env's own buffers."""

    def __init__(self, a: float, b: float, source: str, buffered: bool):
        """Take the numbers."""
        self.a, self.b, self.source, self.buffered = a, b, source, buffered
        self.action_space = gym.spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float64)
        self.buffers = {"observation": np.zeros(1), "state": np.zeros(1), "measurement": np.zeros(1)}
        self.info = {"state": self.buffers["state"], "measurement": self.buffers["measurement"]}

    def reset(self, *, seed=None, options=None):
        """Begin at a random state."""
        super().reset(seed=seed)
        self.x = DRAWS[self.source](self)
        return self.shown()

    def step(self, action):
        """One step; the action is spoilt."""
        self.x = self.a * self.x + self.b * float(action[0]) + DRAWS[self.source](self)
        if self.buffered:
            action[:] = np.nan
        observation, info = self.shown()
        return observation, 0.0, False, False, info

    def shown(self):
        """What it shows, copies or buffers."""
        for buffer in self.buffers.values():
            buffer[:] = self.x
        if self.buffered:
            return self.buffers["observation"], self.info
        copies = {name: buffer.copy() for name, buffer in self.buffers.items()}
        return copies.pop("observation"), copies


class Held:
    """A policy that returns its own array, draws from any generator, and remembers until it is reset."""

    def __init__(self, source: str):
        """Take where it draws from."""
        self.source, self.action, self.count = source, np.zeros(1), 0

    def reset(self, seed=None):
        """Forget."""
        self.count, self.generator = 0, np.random.default_rng(seed)

    def __call__(self, observation):
        """An action; the observation is spoilt."""
        self.count += 1
        own = {"NumPy": np.random.uniform, "Python": random.uniform, "env": self.generator.uniform}[self.source]
        self.action[:] = 0.9 * own(-1.0, 1.0) + 0.1 * np.sin(self.count)
        return self.action


def _model() -> StateSpaceModel:
    return scalar_model(a=[[0.5]], b=[[1.0]], c=[[1.0]])


def runs_of_envs(rng: np.random.Generator, seconds: float) -> str:
    """Envs and policies that draw anywhere, return buffers, write into arguments: the seed says all of a run."""
    tried = 0
    for _ in _until(seconds):
        sources, seed = [str(rng.choice(list(DRAWS))) for _ in range(2)], int(rng.integers(2**40))
        numbers = float(rng.uniform(-0.9, 0.9)), float(rng.uniform(0.1, 2.0)), sources[0]
        policies = {
            "random": lambda: "random",
            "held": lambda: Held(sources[1]),  # noqa: B023
            "steps": lambda: {"name": "steps", "amplitude": 1.0, "hold": 3},
        }
        name = str(rng.choice(list(policies)))
        what = f"{numbers}, {name} from {sources[1]}, seed {seed}"
        found = []
        for buffered, seeds in ((False, range(seed, seed + RUNS)), (True, range(seed + RUNS - 1, seed - 1, -1))):
            env = lambda buffered=buffered: Plant(*numbers, buffered)  # noqa: B023, E731
            problem = EnvProblem(env, policies[name](), _model(), steps=STEPS, first_scored_step=0, scale=(1.0,))
            np.random.seed(int(rng.integers(2**32)))
            found.append(problem.data(list(seeds)))
        plain, other = found
        for part in ("inputs", "measurements", "states"):
            assert np.array_equal(getattr(plain, part), getattr(other, part)[::-1]), f"{part} of {what}"
        x, u = plain.states[..., 0], plain.inputs[..., 0]
        w = x[:, 1:] - numbers[0] * x[:, :-1] - numbers[1] * u
        _uncorrelated({"noise": w.ravel(), "inputs": u.ravel()}, what)
        tried += 1
    return f"runs of envs: {tried}, each the same in another order, with buffers and other global generators"


def _uncorrelated(rows: dict[str, np.ndarray], what: str) -> None:
    parts = np.array(list(rows.values()))
    found = np.abs(np.corrcoef(parts))
    for i, j in itertools.combinations(range(len(rows)), 2):
        names = list(rows)
        assert found[i, j] < SURE / np.sqrt(parts.shape[1]), f"{names[i]} and {names[j]} of {what}: {found[i, j]}"


def estimators(rng: np.random.Generator, seconds: float) -> str:
    """Estimators that draw anywhere, remember and spoil their arguments: the key and the data say all of a run."""
    tried, model = 0, _model()
    for _ in _until(seconds):
        source, steps = str(rng.choice(["NumPy", "Python"])), int(rng.integers(1, 20))
        keys = rng.integers(0, 2**32, size=(3, 2)).astype(np.float64)
        u, z = rng.normal(size=(3, steps, 1)), rng.normal(size=(3, steps + 1, 1))
        z[rng.random(z.shape) < 0.2] = np.nan
        filter_ = make_filter(_Spoiling(source), model)
        whole = run(filter_, keys, u, z).means
        order = rng.permutation(3)
        np.random.seed(int(rng.integers(2**32)))
        again = run(filter_, keys[order], u[order], z[order]).means
        assert np.array_equal(again, whole[order]), f"an estimator that draws from {source}, keys {keys.tolist()}"
        tried += 1
    return f"estimators: {tried} batches, each run the same in another order"


class _Spoiling(Estimator):
    has_covariance = False

    def __init__(self, source: str):
        self.draw, self.mean, self.count = DRAWS[source], np.zeros(1), 0

    def reset(self, key, z):
        return self.step(np.zeros(1), z)

    def step(self, u, z):
        self.count += 1
        self.mean[:] = self.draw(None) + self.count + u[0] + np.nan_to_num(z[0])
        u[:], z[:] = np.nan, np.nan
        return self.mean


def digests(rng: np.random.Generator, seconds: float) -> str:
    """Envs of random numbers: one number changed is another digest; the same numbers are none, nor is rounding."""
    tried = 0
    for _ in _until(seconds):
        numbers = rng.uniform(0.1, 0.9, 2)
        changed, rounded = numbers.copy(), numbers * (1.0 + 1e-14)
        changed[int(rng.integers(2))] *= 1.0 + 10.0 ** rng.uniform(-4.0, -1.0)
        found = [_digest(*pair.tolist()) for pair in (numbers, numbers, rounded, changed)]
        assert found[0] == found[1] == found[2] != found[3], f"{numbers} and {changed}: {found}"
        tried += 1
    return f"digests: {tried} envs, each change noticed, and nothing else"


def _digest(a: float, b: float) -> str:
    make = lambda: Plant(a, b, "env", False)  # noqa: E731
    return EnvProblem(make, "random", _model(), steps=STEPS, first_scored_step=0, scale=(1.0,)).digest
