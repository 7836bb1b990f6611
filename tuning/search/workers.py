"""Several processes on one host that run trials of one study.

Each runs this module, in its own session, so that Ctrl-C reaches only its parent. It reads its task from its
standard input and ends when that is closed: by its parent, or because its parent has ended. When it is asked to
end, it does so after its trial.
"""

from __future__ import annotations

import base64
import json
import os
import pickle
import subprocess
import sys
import threading
import time
import warnings
import zlib
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any

import optuna

from thruster_env.core.modules import working_folder_last
from thruster_env.core.parallel import take_share, without_interrupts
from tuning.problems.assumed import within
from tuning.problems.data import Data
from tuning.problems.find import find_problem
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Problem
from tuning.search.plan import Plan
from tuning.search.storage import drop_waiting, open_storage, quiet_optuna, retry_orphans, this_process
from tuning.search.study import OnTrial, finished_trials, open_study, run_trials, stop_on_interrupt

MODULE = "tuning.search.workers"
POLL_SECONDS = 0.2
# Of a process that Ctrl-C shall not reach: POSIX has sessions, Windows has groups.
OWN_SESSION: dict[str, Any] = {
    "start_new_session": True,
    "creationflags": getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0),
}
_input_ended = threading.Event()


def orders_of(plan: Plan) -> dict[str, Any]:
    """A plan as JSON holds it; its problems are found again by their names, and logs are sent."""
    return {
        "plan": {**plan._asdict(), "scenarios": [scenario.name for scenario in plan.scenarios]},
        "digests": [scenario.digest for scenario in plan.scenarios],
        "logs": {
            problem.name: _packed(problem) for problem in plan.scenarios if isinstance(within(problem), LogProblem)
        },
    }


def find_same(name: str, digest: str) -> Problem:
    """A problem by its name, which must be the same as in another process: ValueError for another digest."""
    problem = find_problem(name)
    if problem.digest != digest:
        raise ValueError(
            f"problem {name} must be the same in all processes, of digest {digest}, but here it has "
            f"{problem.digest}"
        )
    return problem


def plan_of(orders: dict[str, Any]) -> Plan:
    """The plan in such orders; ValueError if a problem is not found, or is another one."""
    arguments = orders["plan"]
    logs = {name: _unpacked(text) for name, text in orders["logs"].items()}
    pairs = zip(arguments["scenarios"], orders["digests"], strict=True)
    scenarios = tuple(logs.get(name) or find_same(name, digest) for name, digest in pairs)
    several = {name: tuple(arguments[name]) for name in ("objectives", "where")}
    return Plan(**{**arguments, **several, "scenarios": scenarios})


def _packed(problem: Problem) -> str:
    """A problem of logs as text, since it cannot be found by a name. Only the parent of a process sends it."""
    try:
        return base64.b64encode(pickle.dumps(problem)).decode()
    except Exception as error:  # functions within functions, say
        raise ValueError(
            f"several workers need logs whose model can be pickled, but that of {problem.name} cannot: {error}"
        ) from None


def _unpacked(text: str) -> Problem:
    with working_folder_last():  # where the model's module may lie
        return pickle.loads(base64.b64decode(text))


def as_module(name: str) -> list[str]:
    """The command that runs one of our modules as a program; no file in the working folder can replace it.

    Where our packages are not installed, the folder that holds them comes last on the path.
    """
    home = os.path.dirname(os.path.dirname(os.path.dirname(os.path.abspath(__file__))))
    run = f"import runpy, sys; sys.path.append({home!r}); runpy.run_module({name!r}, run_name='__main__')"
    return [sys.executable, "-P", "-c", run]


def start(module: str, orders: dict[str, Any], **options: Any) -> subprocess.Popen:
    """Start the main program of a module of ours with its orders; options are those of `Popen`."""
    with without_interrupts():
        command = as_module(module)
        process = subprocess.Popen(command, stdin=subprocess.PIPE, text=True, **OWN_SESSION, **options)
    assert process.stdin is not None  # a pipe
    with suppress(OSError):  # of a pipe that is broken, on Windows EINVAL: it has died, which its exit code shows
        process.stdin.write(json.dumps(orders) + "\n")
        process.stdin.flush()
    return process


def close_input(process: subprocess.Popen) -> None:
    """Close a process's standard input, which asks it to end."""
    if process.stdin is not None:
        with suppress(OSError):
            process.stdin.close()


def end(process: subprocess.Popen) -> None:
    """End a process at once."""
    process.kill()
    process.wait()
    close_input(process)


def read_orders() -> dict[str, Any]:
    """The orders of this process, which its parent wrote; from then on `parent_says_stop`."""
    orders = json.loads(sys.stdin.readline())
    threading.Thread(target=_wait_for_end, daemon=True).start()
    return orders


def _wait_for_end() -> None:
    while os.read(sys.stdin.fileno(), 4096):  # past Python's buffer, whose lock a waiting thread would keep
        pass
    _input_ended.set()


def parent_says_stop() -> bool:
    """Whether the parent of this process has closed its standard input, or has ended."""
    return _input_ended.is_set()


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
    living, reported = dict(processes), finished_trials(study)
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
        if finished > reported:
            reported = finished
            on_trial(study, finished)


def _cause(process: subprocess.Popen) -> str:
    code = process.returncode
    return f"signal {-code}" if code < 0 else f"exit code {code}"


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
