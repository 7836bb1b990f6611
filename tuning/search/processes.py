"""Processes beside this one that work for a study: started, told its plan in a line of JSON, and ended.

Each runs in its own session, so that Ctrl-C reaches only its parent. It reads its task from its standard input,
and ends when that is closed: by its parent, or because its parent has ended.
"""

from __future__ import annotations

import base64
import json
import pickle
import select
import subprocess
import sys
from contextlib import suppress
from typing import Any

from thruster_env.core.modules import as_module, working_folder_last
from tuning.problems.augmented import within
from tuning.problems.find import find_same
from tuning.problems.log_problem import LogProblem
from tuning.problems.problem import Problem
from tuning.search.interruption import without_interrupts
from tuning.search.plan import Plan


def orders_of(plan: Plan) -> dict[str, Any]:
    """A plan as JSON holds it; its problems are found again by their names, and logs are sent."""
    return {
        "plan": {**plan._asdict(), "scenarios": [scenario.name for scenario in plan.scenarios]},
        "digests": [scenario.digest for scenario in plan.scenarios],
        "logs": {one.name: _packed(one) for one in plan.scenarios if isinstance(within(one), LogProblem)},
    }


def plan_of(orders: dict[str, Any]) -> Plan:
    """The plan in such orders; ValueError if a problem is not found, or is another one."""
    given = orders["plan"]
    logs = {name: _unpacked(text) for name, text in orders["logs"].items()}
    pairs = zip(given["scenarios"], orders["digests"], strict=True)
    scenarios = tuple(logs.get(name) or find_same(name, digest) for name, digest in pairs)
    several = {name: tuple(given[name]) for name in ("objectives", "where")}
    return Plan(**{**given, **several, "scenarios": scenarios})


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


def start(module: str, orders: dict[str, Any], **options: Any) -> subprocess.Popen:
    """Start the main program of a module of ours with its orders; options are those of `Popen`."""
    with without_interrupts():
        command = as_module(module)
        process = subprocess.Popen(command, stdin=subprocess.PIPE, text=True, start_new_session=True, **options)
    assert process.stdin is not None  # a pipe
    with suppress(BrokenPipeError):  # it has died already, which its exit code shows
        process.stdin.write(json.dumps(orders) + "\n")
        process.stdin.flush()
    return process


def close_input(process: subprocess.Popen) -> None:
    """Close a process's standard input, which asks it to end."""
    if process.stdin is not None:
        with suppress(BrokenPipeError):
            process.stdin.close()


def end(process: subprocess.Popen) -> None:
    """End a process at once."""
    process.kill()
    process.wait()
    close_input(process)


def read_orders() -> dict[str, Any]:
    """The orders of this process, which its parent wrote."""
    return json.loads(sys.stdin.readline())


def parent_says_stop() -> bool:
    """Whether the parent of this process has closed its standard input, or has ended."""
    return bool(select.select([sys.stdin], [], [], 0)[0])
