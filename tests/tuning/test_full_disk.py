"""Disks that are full: a study loses no line and goes on when there is room; the command says so in one."""

import errno
import json
import resource
import signal
import subprocess
import sys
from contextlib import contextmanager

import optuna
import pytest
from optuna.trial import TrialState

from tuning.plants.thruster import find_scenario
from tuning.search.plan import Plan
from tuning.search.storage import open_storage
from tuning.search.study import finished_trials, open_study, run_trials
from tuning.search.workers import orders_of

PLAN = Plan("ekf", (find_scenario("mismatch"),), prune=False)


@contextmanager
def room_for(size):
    """Within this context no file of this process grows beyond a size in bytes."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    handler = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
        signal.signal(signal.SIGXFSZ, handler)


def whole_lines(path):
    content = path.read_bytes()
    return content.endswith(b"\n") and [json.loads(line) for line in content.splitlines()]


@pytest.fixture(scope="module")
def data():
    return PLAN.training_data()


@pytest.mark.parametrize("more", [0, 1, 150, 333, 600])
def test_a_study_on_a_full_disk_keeps_what_is_finished_and_others_go_on(tmp_path, data, more):
    path = tmp_path / "j"
    other = open_study("s", PLAN, open_storage(str(path)))
    study = open_study("s", PLAN, open_storage(str(path)))
    run_trials(study, PLAN, data, 2)
    with room_for(path.stat().st_size + more), pytest.raises(OSError) as error:
        run_trials(study, PLAN, data, 4)
    assert error.value.errno == errno.EFBIG and error.value.filename == str(path)
    assert whole_lines(path)
    run_trials(other, PLAN, data, 3)  # in a process that had no part in it
    assert finished_trials(other) == 3
    assert whole_lines(path)
    resumed = open_study("s", PLAN, open_storage(str(path)))
    assert finished_trials(resumed) == 3 and len(resumed.get_trials(states=(TrialState.COMPLETE,))) == 3


@pytest.mark.slow
def test_a_worker_says_in_a_line_that_the_disk_is_full(tmp_path, data):
    path = tmp_path / "j"
    study = open_study("s", PLAN, open_storage(str(path)))
    orders = {"study": "s", "storage": str(path), "trials": 3, "workers": 1, "worker": 0, "place": 5}
    orders |= orders_of(PLAN)
    with room_for(path.stat().st_size + 10):
        done = subprocess.run(
            [sys.executable, "-m", "tuning.search.workers"],
            input=json.dumps(orders) + "\n",
            capture_output=True,
            text=True,
            restore_signals=False,  # Python ignores SIGXFSZ
        )
    assert done.returncode == 1 and len(study.trials) == 1
    *warned, said = done.stderr.splitlines()  # a first run warns that machine code is not kept either
    assert said == f"thruster: worker 0: [Errno 27] File too large: '{path}'"
    assert not any("Traceback" in line for line in warned)
