"""Damaged and malicious files: each is read as what it says, or refused in one line; none runs code."""

from __future__ import annotations

import copy
import json
import sys
import tempfile
import time
import types
from collections import Counter
from collections.abc import Callable
from pathlib import Path

import gymnasium as gym
import numpy as np
import optuna

import thruster_env  # noqa: F401 - registers the envs
from filters import EstimateState
from filters.tuned_file import sealed
from tests.tuned_files import write_untuned
from tuning.evaluation.tuned import read_tuned
from tuning.plants.thruster import find_scenario
from tuning.policies.environments import make_environments
from tuning.policies.saved import configuration_from_json
from tuning.policies.setup import make_configuration
from tuning.search.plan import Plan
from tuning.search.storage import open_storage
from tuning.search.study import open_study

TRAP = "tests_fuzz_trap"  # a module that nothing may import, with a function that nothing may call
VALUES = (
    None, True, -1, 0, 3, 1e300, -1e-300, 10**40, "", "ekf", f"{TRAP}:spring", f"{TRAP}:Env-v0", "\x00", "é",
    [], [[]], [1.0, 2.0], [[1.0, 0.5], [0.5, 1.0]], [1e300, -1.0], {}, {"name": f"{TRAP}:spring"}, "NaN",
    float("nan"), float("inf"), "__import__('os').abort()", {"__reduce__": ["os.abort", []]},
)  # fmt: skip
SCENARIO = """
base = "outliers"
about = "with gusts"
scale = [1.0, 0.05]
steps = 60
excitation = {name = "prbs", amplitude = 8, hold = 40}
flow = [{name = "gusts", std = 0.5}]
[parameter_factors]
lift_coefficient = 1.1
"""


class Trap(types.ModuleType):
    """A module that remembers whether anything was asked of it."""

    def __getattr__(self, name):
        """Spring, whatever is asked for but what the import system itself looks at."""
        if not name.startswith("__"):
            raise SystemExit(f"code named in a file was run: {TRAP}.{name}")
        raise AttributeError(name)


def tuned_files(rng: np.random.Generator, seconds: float) -> str:
    """Tuned files with values changed, keys added and removed, and a right hash; half are damaged as text, too."""
    env = gym.make("BowThruster-v0")
    with tempfile.TemporaryDirectory() as folder:
        right = json.loads(write_untuned(Path(folder) / "right.json").read_text(encoding="utf-8"))

    def read(path: Path) -> None:
        read_tuned(path)

    def wrap(path: Path) -> None:
        wrapped = EstimateState(env, tuned=path)
        wrapped.reset(seed=0)
        info = wrapped.step(np.ones(1, np.float32))[4]
        assert np.isfinite(info["estimate"]).all() and np.isfinite(info["estimate_cov"]).all()

    def train(path: Path) -> None:
        setup = make_configuration("manoeuvre", find_scenario("nominal"), "ekf", tuned=path)
        assert TRAP not in setup.as_json()

    def write(path: Path) -> None:
        content = _changed(rng, right)
        if rng.random() < 0.9 and isinstance(content, dict):
            content = sealed(content)
        text = json.dumps(content)
        path.write_bytes(_damaged(rng, text.encode()) if rng.random() < 0.2 else text.encode())

    return _attack(rng, seconds, write, read, wrap, train)


def setups(rng: np.random.Generator, seconds: float) -> str:
    """Setups of policies, changed: read as data, or refused."""
    right = json.loads(make_configuration("manoeuvre", find_scenario("mismatch"), "ekf").as_json())

    def use(path: Path) -> None:
        setup = configuration_from_json(path.read_text(errors="replace"), path.name)
        make_environments(setup, [0], native=bool(rng.integers(2))).reset()

    def write(path: Path) -> None:
        text = json.dumps(_changed(rng, right)).encode()
        path.write_bytes(_damaged(rng, text) if rng.random() < 0.2 else text)

    return _attack(rng, seconds, write, use)


def scenario_files(rng: np.random.Generator, seconds: float) -> str:
    """TOML of scenarios, damaged byte by byte, with values in the place of others."""
    values = f'nan inf -1 1e300 [] [[]] {{}} "" true 1979-05-27 "nominal" 0x7{"f" * 40}'.split()

    def write(path: Path) -> None:
        lines = SCENARIO.strip().splitlines()
        for _ in range(rng.integers(1, 4)):
            place = rng.integers(len(lines))
            name, equals, _ = lines[place].partition("=")
            if equals:
                lines[place] = f"{name}= {rng.choice(values)}"
        text = "\n".join(lines).encode()
        path.with_suffix(".toml").write_bytes(_damaged(rng, text) if rng.random() < 0.5 else text)

    def use(path: Path) -> None:
        scenario = find_scenario(str(path.with_suffix(".toml")))
        if scenario.steps <= 1000:
            data = scenario.data([1])
            assert np.isfinite(data.states).all(), f"states that are not finite: {scenario}"

    return _attack(rng, seconds, write, use)


def journals(rng: np.random.Generator, seconds: float) -> str:
    """Journals of studies, damaged anywhere: a study goes on, or says in one line what is wrong."""
    optuna.logging.set_verbosity(optuna.logging.ERROR)
    plan = Plan("ekf", (find_scenario("nominal"),))
    with tempfile.TemporaryDirectory() as folder:
        first = Path(folder) / "whole.journal"
        study = open_study("s", plan, open_storage(str(first)))
        for value in (2.0, 1.5):
            trial = study.ask(plan.space())
            trial.set_user_attr("note", "x")
            study.tell(trial, value)
        whole = first.read_bytes()

    def write(path: Path) -> None:
        path.write_bytes(_damaged(rng, whole))

    def use(path: Path) -> None:
        study = open_study("s", plan, open_storage(str(path)))
        trial = study.ask(plan.space())
        study.tell(trial, 1.0)
        assert study.get_trials()[trial.number].value == 1.0

    return _attack(rng, seconds, write, use)


def _attack(rng, seconds: float, write: Callable[[Path], None], *uses: Callable[[Path], None]) -> str:
    """Write and use files until the time is over; a refusal is one line that states a rule."""
    counts, end = Counter(), time.monotonic() + seconds
    sys.modules[TRAP] = Trap(TRAP)
    try:
        with tempfile.TemporaryDirectory() as folder:
            while not counts or time.monotonic() < end:
                path = Path(folder) / f"{counts.total()}"
                write(path)
                for use in uses:
                    counts[_outcome(use, path)] += 1
                path.unlink(missing_ok=True)
    finally:
        del sys.modules[TRAP]
    return ", ".join(f"{count} {what}" for what, count in sorted(counts.items()))


def _outcome(use: Callable[[Path], None], path: Path) -> str:
    written = next(p for p in (path.with_suffix(".toml"), path) if p.exists())
    try:
        use(path)
        return "accepted"
    except ValueError as error:
        if "\n" in str(error) or not str(error):
            raise AssertionError(
                f"a refusal must be one line, but is {str(error)!r}: {_start(written)}"
            ) from error
        return "refused"
    except (Exception, SystemExit) as error:
        raise AssertionError(f"{type(error).__name__} from {_start(written)}") from error


def _start(path: Path) -> bytes:
    return path.read_bytes()[:4000]


def _changed(rng: np.random.Generator, content):
    """JSON content with one to three places changed, removed or added."""
    content = copy.deepcopy(content)
    for _ in range(rng.integers(1, 4)):
        places = list(_places(content))
        parent, key = places[rng.integers(len(places))]
        kind = rng.integers(4)
        value = copy.deepcopy(VALUES[rng.integers(len(VALUES))])
        if kind == 0:
            del parent[key]
        elif kind == 1 and isinstance(parent, dict):
            name = ("model", "transition", "preset", "seed", "env_id", "policy_kwargs", "é")[rng.integers(7)]
            parent[name] = value
        else:
            parent[key] = value
        if not content:
            return content
    return content


def _places(value):
    entries = value.items() if isinstance(value, dict) else enumerate(value)
    for key, part in entries:
        yield value, key
        if isinstance(part, (dict, list)) and part:
            yield from _places(part)


def _damaged(rng: np.random.Generator, data: bytes) -> bytes:
    """Bytes cut off, flipped, doubled, zeroed or nested deeply."""
    at = int(rng.integers(len(data)))
    length = int(rng.integers(1, 40))
    kind = rng.integers(6)
    if kind == 0:
        return data[:at]
    if kind == 1:
        return data[:at] + bytes([data[at] ^ (1 << rng.integers(8))]) + data[at + 1 :]
    if kind == 2:
        return data[:at] + data[at : at + length] + data[at:]
    if kind == 3:
        return data[:at] + bytes(length) + data[at + length :]
    if kind == 4:
        return data[:at] + b"[" * 100_000 + data[at:]
    return data[:at] + rng.bytes(length) + data[at:]
