"""Trainings and comparisons of policies that are killed, again and again, and go on until they are done."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from tuning.plants.thruster import find_scenario
from tuning.policies.saved import configuration_from_json
from tuning.policies.setup import TrainingConfiguration, make_configuration

KILLS = 20
COPIES, STEPS = 4, 8192
SMALL = {"n_steps": 32, "batch_size": 64, "n_epochs": 1, "policy_kwargs": {"net_arch": [8]}}
CHECKPOINTS, EVALUATIONS = 64, 32
BETWEEN = STEPS // CHECKPOINTS  # steps between two checkpoints
PATIENCE = 120.0  # seconds after which a process that does nothing is taken to hang
LAST_KILL = 0.7  # of the time, after which the work may end in peace


def trainings_killed(rng: np.random.Generator, seconds: float) -> str:
    """A small training, killed at moments that steps and chance set."""
    return kill_training(rng, KILLS, seconds)


def comparisons_killed(rng: np.random.Generator, seconds: float) -> str:
    """`thruster reproduce policies`, killed with its processes left to themselves."""
    return kill_comparison(rng, KILLS, seconds)


def kill_training(rng: np.random.Generator, kills: int, seconds: float) -> str:
    """Kill a training so often or so long, then let it end; what it has must never be less than it was.

    Raises:
        AssertionError: if it does not go on, loses more than the steps since its last checkpoint, or is not whole
            in the end.
    """
    scenario, deadline = find_scenario("medium_noise"), time.monotonic() + LAST_KILL * seconds
    setup = make_configuration("tracking", scenario, "ekf", steps=STEPS, num_envs=COPIES, hyperparameters=SMALL)
    with tempfile.TemporaryDirectory() as scratch:
        folder, lost, done, steps = Path(scratch) / "policy", [], 0, 0
        while done < kills and time.monotonic() < deadline:
            # Half of the moments are where a checkpoint is about to be written, which takes some milliseconds.
            aim = int(rng.integers(1, 2 * BETWEEN // COPIES))
            if rng.random() < 0.5:
                aim = BETWEEN // COPIES - 1
            delay = float(rng.uniform(0.0, 0.02))
            seen = _train(folder, setup, stop_after=aim, delay=delay)
            if len(seen) < aim:
                break  # it has come to its end
            done += 1
            moment = f"kill {done}, {aim} steps and {delay:.4f} s after a start at {seen[0]}"
            assert seen[0] == steps + COPIES, f"must go on at {steps + COPIES}: {moment}"
            steps = _saved_steps(folder)
            lost.append(seen[-1] - steps)
            # One more step may have been made, and saved, that the pipe did not tell of.
            assert -COPIES <= lost[-1] <= BETWEEN, f"{lost[-1]} steps are lost: {moment}"
        _train(folder, setup)
        _check_training(folder, setup)
    most = max(lost, default=0)
    return f"{done} kills, at most {most} of {BETWEEN} steps between checkpoints lost; {STEPS} learnt"


def kill_comparison(rng: np.random.Generator, kills: int, seconds: float) -> str:
    """Kill `thruster reproduce policies` so often or so long, then let it end; no finished run is done again.

    Raises:
        AssertionError: if a result or a checkpoint gets lost, a process outlives its parent, or the end is not
            what an undisturbed run gives.
    """
    deadline, done, progress = time.monotonic() + LAST_KILL * seconds, 0, (0, 0)
    with tempfile.TemporaryDirectory() as scratch:
        found, kept = Path(scratch) / "found", {}
        command = [sys.executable, "-m", "tuning.cli.main", "reproduce", "policies", "--quick", "--seeds", "1"]
        command += f"--steps 4096 --executor processes:2 --out {found} --json {found / 'result.json'}".split()
        while done < kills and time.monotonic() < deadline:
            news, delay = int(rng.integers(0, 5)), float(rng.uniform(0.0, 1.0))
            process = _start(command)
            _wait_for_news(process, found, news)
            time.sleep(delay)
            process.kill()
            code, moment = process.wait(), f"kill {done + 1}, {delay:.4f} s after {news} new files"
            _wait_for_end_of(process.pid, moment)
            if code == 0:
                break
            assert code == -signal.SIGKILL, f"exit code {code} before {moment}"
            done += 1
            results = {path.name: path.read_bytes() for path in found.glob("runs/*.json")}
            changed = [name for name, content in kept.items() if results.get(name) != content]
            assert not changed, f"{changed} changed: {moment}"
            steps = sum(_saved_steps(path) for path in found.glob("runs/*/"))
            assert (len(results), steps) >= progress, f"{(len(results), steps)} after {progress}: {moment}"
            kept, progress = results, (len(results), steps)
        process = _start(command)
        assert process.wait(10 * PATIENCE) == 0, "it must end in peace"
        results = {path.name: json.loads(path.read_text()) for path in found.glob("runs/*.json")}
        assert all(json.dumps(json.loads(kept[name])) == json.dumps(results[name]) for name in kept)
        rows = json.loads((found / "result.json").read_text())["policies"]["medium"]
        assert len(rows) == len(results), f"{len(rows)} rows of {len(results)} results"
        for name, result in results.items():
            points = [steps for steps, _ in result["curve"]]
            assert points == sorted(set(points)) and np.isfinite(result["returns"]).all(), name
            if points:
                _check_training(found / "runs" / name.removesuffix(".json"))
    return f"{done} kills, {len(results)} runs whole, {len(kept)} of them before the last kill"


def _start(command: list[str]) -> subprocess.Popen:
    """A process in a session of its own."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(command, start_new_session=True, **quiet)


def _wait_for_news(process: subprocess.Popen, folder: Path, count: int) -> None:
    """Wait until there are so many results and checkpoints more, or a process has ended."""

    def there() -> set[Path]:
        return {*folder.glob("runs/*.json"), *folder.glob("runs/*/checkpoints/[0-9]*")}

    before = there()
    while len(there() - before) < count and process.poll() is None:
        time.sleep(0.01)


def _wait_for_end_of(session: int, moment: str) -> None:
    """Wait for the processes that a killed one has left behind; they must end by themselves."""
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline:
        try:
            os.killpg(session, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    os.killpg(session, signal.SIGKILL)
    raise AssertionError(f"processes must end with their parent: {moment}")


def _train(
    folder: Path, setup: TrainingConfiguration, stop_after: int | None = None, delay: float = 0.0
) -> list[int]:
    """Train in a process of its own, killed after so many steps and seconds; return the steps that it told."""
    command = [sys.executable, "-m", "tests.fuzz.checkpoints", str(folder)]
    seen: list[int] = []
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        process.stdin.write(setup.as_json())
        process.stdin.close()
        for line in process.stdout:
            seen.append(int(line))
            if len(seen) == stop_after:
                time.sleep(delay)
                process.kill()
        code = process.wait(PATIENCE)
    assert code in (0, -signal.SIGKILL), f"exit code {code} of a training that goes on from {folder}"
    return seen


def _saved_steps(folder: Path) -> int:
    """Steps from which a training goes on."""
    from tuning.policies.saved import FINAL, latest_checkpoint

    latest = latest_checkpoint(folder)
    if (folder / FINAL).is_dir():
        return _learnt(folder / FINAL)
    return 0 if latest is None else int(latest.name)


def _learnt(saved: Path) -> int:
    from tuning.policies.environments import make_environments
    from tuning.policies.saved import load, read_configuration

    return load(saved, make_environments(read_configuration(saved), [0])).model.num_timesteps


def _check_training(folder: Path, setup: TrainingConfiguration | None = None) -> None:
    """What is in the folder of a training that has ended is whole, and nothing is left aside."""
    from tuning.policies.saved import BEST, FINAL, read_configuration

    setup = setup or read_configuration(folder)
    assert _learnt(folder / FINAL) >= setup.steps and _learnt(folder / BEST) > 0
    with np.load(folder / "evaluations.npz") as file:
        steps = file["timesteps"].tolist()
    assert steps == sorted(set(steps)) and steps, f"evaluations at {steps}"
    aside = [path.name for path in folder.rglob(".*")]
    assert not aside, f"left aside: {aside}"


def _learn(folder: str) -> None:
    """What the process does: learn as standard input says, and tell each step."""
    from tuning.policies.learn import train

    def tell(steps: int, mean_return: float) -> None:
        print(steps, flush=True)

    setup = configuration_from_json(sys.stdin.read(), "standard input")
    train(setup, folder, evaluations=EVALUATIONS, checkpoints=CHECKPOINTS, tensorboard=False, on_progress=tell)


if __name__ == "__main__":
    _learn(sys.argv[1])
