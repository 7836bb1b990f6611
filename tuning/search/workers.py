"""Several processes on one host that run trials of one study.

Each runs `tuning.search.workers`. When it is asked to end (`tuning.search.processes`), it does so after its trial.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
import warnings
import zlib
from collections.abc import Callable, Sequence

import optuna

from thruster_env.core.threads import cores
from tuning.problems.data import Data
from tuning.search.interruption import stop_on_interrupt
from tuning.search.plan import Plan
from tuning.search.processes import close_input, end, orders_of, parent_says_stop, plan_of, read_orders, start
from tuning.search.storage import drop_waiting, open_storage, retry_orphans, this_process
from tuning.search.study import OnTrial, finished_trials, open_study, quiet_optuna, run_trials

MODULE = "tuning.search.workers"
POLL_SECONDS = 0.2


def run_in_workers(
    study: optuna.Study,
    plan: Plan,
    data: Sequence[Data],
    trials: int,
    on_trial: OnTrial,
    *,
    storage: str,
    workers: int,
) -> bool:
    """Run trials in several processes until the study has `trials` finished ones; return whether Ctrl-C ended it.

    Ctrl-C ends each worker after its running trial, a second one ends them at once. If a worker dies,
    another one repeats its running trial; if all die, this process continues alone.

    Args:
        study: from `open_study`, in `storage`.
        plan: what the study is for; its scenarios are found again by their names.
        data: the plan's training data.
        trials: finished trials that the study shall have in total; there may be up to workers - 1 more.
        on_trial: called with the study and the number of finished trials when there are more.
        storage: journal file or URL, as for `open_storage`.
        workers: number of processes.
    """
    orders = {
        "study": study.study_name,
        "storage": storage,
        "trials": trials,
        "workers": workers,
        **orders_of(plan),
    }
    # Indices that no other host has, so that no two workers propose the same trials.
    first = zlib.crc32(this_process().encode())
    processes: dict[int, subprocess.Popen] = {}
    try:
        with stop_on_interrupt() as interrupted:
            for worker in range(workers):
                processes[worker] = start(MODULE, {**orders, "worker": worker, "place": first + worker})
            _watch(study, processes, on_trial, interrupted)
        return interrupted() or run_trials(study, plan, data, trials, on_trial)
    except KeyboardInterrupt:
        return True
    finally:
        for process in processes.values():
            end(process)
        retry_orphans(study)
        if finished_trials(study) >= trials:
            drop_waiting(study)


def _watch(
    study: optuna.Study, processes: dict[int, subprocess.Popen], on_trial: OnTrial, interrupted: Callable[[], bool]
) -> None:
    living, shown = dict(processes), finished_trials(study)
    while living:
        time.sleep(POLL_SECONDS)
        if interrupted():
            for process in living.values():
                close_input(process)
        for worker, process in list(living.items()):
            if process.poll() is not None:
                del living[worker]
                if process.returncode:
                    warnings.warn(
                        f"worker {worker} has died ({_cause(process)}), {len(living)} go on", stacklevel=4
                    )
                    retry_orphans(study)
        finished = finished_trials(study)
        if finished > shown:
            shown = finished
            on_trial(study, finished)


def _cause(process: subprocess.Popen) -> str:
    code = process.returncode
    return f"signal {-code}" if code < 0 else f"exit code {code}"


def take_share(workers: int) -> None:
    """Let this process use the number of threads that is its share of the cores; it may run on any core."""
    if hasattr(os, "sched_setaffinity"):
        allowed = os.sched_getaffinity(0)
        os.sched_setaffinity(0, sorted(allowed)[: max(1, len(allowed) // workers)])
        cores()  # is cached
        os.sched_setaffinity(0, allowed)


def main() -> None:
    """Run the trials that standard input describes, until the study is finished or standard input is closed."""
    orders = read_orders()
    take_share(orders["workers"])
    quiet_optuna()
    try:
        plan = plan_of(orders)
        study = open_study(orders["study"], plan, open_storage(orders["storage"]), worker=orders["place"])
        run_trials(study, plan, plan.training_data(), orders["trials"], stop=parent_says_stop, drops_waiting=False)
    except (ValueError, OSError) as error:
        sys.exit(f"thruster: worker {orders['worker']}: {error}")


if __name__ == "__main__":
    main()
