"""Run a comparison, in parallel on the cores; finished runs are stored, and never repeated."""

from __future__ import annotations

import json
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from pathlib import Path
from typing import NamedTuple

import numpy as np

from thruster_env.core.files import write_whole
from thruster_env.core.modules import safe_paths
from thruster_env.core.threads import cores, one_thread
from tuning.policies.classical import classical_policy
from tuning.policies.comparison.plan import CLASSICAL, Comparison, Run, runs_of
from tuning.policies.environments import make_environments
from tuning.policies.learn import train
from tuning.policies.plants.plant import Part
from tuning.policies.saved import FINAL, load
from tuning.policies.score import Policy, Scores, score
from tuning.problems.seeds import held_out_seeds
from tuning.search.interruption import without_interrupts

RUNS = "runs"
STEPS_APART = 40_000  # training steps between points of a learning curve: an evaluation has 16 000 steps
OnRun = Callable[[Run, int, int], None]  # a finished run, number of finished runs, number of all runs


class Result(NamedTuple):
    """The result of a run."""

    run: Run
    scores: Scores
    curve: list[tuple[int, float]]  # steps and mean return of evaluations during training
    seconds: float


def run_comparison(
    comparison: Comparison,
    folder: str | Path,
    jobs: int | None = None,
    on_run: OnRun = lambda run, done, count: None,
) -> list[Result]:
    """Do all runs that the folder does not contain yet, and return all results.

    Ctrl-C ends it; a later call continues, trainings from their last checkpoints.

    Args:
        comparison: the comparison.
        folder: folder for a file of results and a folder of the training of each run.
        jobs: number of processes; that of the cores if None.
        on_run: called after each run.

    Raises:
        ValueError: if a file of results is damaged, or a process was killed.
        KeyboardInterrupt: on Ctrl-C.
    """
    folder, runs = Path(folder), runs_of(comparison)
    results = {run.name: _read(folder, run, comparison.episodes) for run in runs}
    missing = [run for run in runs if results[run.name] is None]
    done = len(runs) - len(missing)
    context = multiprocessing.get_context("spawn")
    workers = min(jobs or cores(), max(1, len(missing)))
    with safe_paths():  # a process that tracks the shared counter starts here
        pool = ProcessPoolExecutor(workers, context, _prepare, (context.Value("i", 0),))
    try:
        with without_interrupts(), safe_paths():
            futures: dict[Future, Run] = {
                pool.submit(_do, run, folder, comparison.episodes): run for run in missing
            }
        for future in as_completed(futures):
            future.result()
            run, done = futures[future], done + 1
            results[run.name] = _read(folder, run, comparison.episodes)
            on_run(run, done, len(runs))
    except BrokenProcessPool:
        raise ValueError(
            "processes must live until their runs are done, but one was killed: the same call continues"
        ) from None
    except BaseException:
        for process in list((pool._processes or {}).values()):
            process.terminate()
        raise
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    in_order = (results[run.name] for run in runs)
    return [result for result in in_order if result is not None]  # all are there now


def _prepare(counter) -> None:
    """Give a process one core, leave Ctrl-C to its parent, and end it when the parent has ended.

    Otherwise it would continue its run, and the next call would start the same run in the same folder.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    with counter.get_lock():
        core, counter.value = counter.value, counter.value + 1
    if hasattr(os, "sched_setaffinity"):
        available = sorted(os.sched_getaffinity(0))
        os.sched_setaffinity(0, {available[core % len(available)]})


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
    os._exit(1)


def _do(run: Run, folder: Path, episodes: int) -> None:
    """Train and score one policy; write its results."""
    policy: Policy
    curve: list[tuple[int, float]] = []
    seconds = 0.0
    with one_thread():
        if run.kind in CLASSICAL:
            policy = classical_policy(run.kind, run.setup)
        else:
            points = max(1, run.setup.steps // STEPS_APART)
            folder_of_run = folder / RUNS / run.name
            trained = train(run.setup, folder_of_run, evaluations=points, checkpoints=4, tensorboard=False)
            curve, seconds = trained.curve, trained.seconds
            policy = load(trained.folder / FINAL, make_environments(run.setup, range(1)))
        scores = score(policy, run.setup, held_out_seeds(0, episodes))
    content = {
        "setup": json.loads(run.setup.as_json()),
        "episodes": episodes,
        "returns": scores.returns.tolist(),
        "parts": {name: [part.squares.tolist(), part.steps.tolist()] for name, part in scores.parts.items()},
        "curve": curve,
        "seconds": seconds,
    }
    write_whole(_file(folder, run), json.dumps(content))


def _read(folder: Path, run: Run, episodes: int) -> Result | None:
    """The result of a run; None unless there is one with exactly this training configuration."""
    path = _file(folder, run)
    if not path.is_file():
        return None
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        if content["setup"] != json.loads(run.setup.as_json()) or content["episodes"] != episodes:
            return None
        parts = {name: Part(*map(np.array, pair)) for name, pair in content["parts"].items()}
        scores = Scores(np.array(content["returns"]), parts)
        return Result(run, scores, [tuple(point) for point in content["curve"]], content["seconds"])
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} must be a whole file of results, but cannot be read: {error}") from None


def _file(folder: Path, run: Run) -> Path:
    return folder / RUNS / f"{run.name}.json"
