"""A second run of a command compiles nothing, and computes no bound that a first one has computed."""

import json
import subprocess
import sys

import pytest

from tuning.problems.find import find_problem

REACTOR = '''
import math
from typing import NamedTuple

from filters import StateSpaceModel
from rates import ACTIVATION
from tuning.problems.model_problem import ModelProblem


class Constants(NamedTuple):
    dt: float
    exchange: float


def move(x, u, p):
    k = 7.2e10 * math.exp(-ACTIVATION / x[1])
    return (
        x[0] + p.dt * (1.0 - x[0] - k * x[0]),
        x[1] + p.dt * (350.0 - x[1] + 209.2 * k * x[0] + p.exchange * (u[0] - x[1])),
    )


def look(x, p):
    return (x[1],)


def model(exchange):
    return StateSpaceModel(
        transition=move, observe=look, constants=Constants(0.02, exchange), process_noise_cov=[1e-6, 0.04],
        measurement_noise_cov=[0.25], prior_mean=[0.9, 320.0], prior_cov=[0.01, 25.0], inputs=1,
    )


problem = ModelProblem(model(2.092), model(2.0), inputs=[[290.0]] * 120, dt=0.02)
'''  # fmt: skip
COUNTING = """
import json, sys
import tuning.problems.model_problem as bound
from thruster_env.graphs import machine_code

found = {"compiled": 0, "bounds": 0}
of_llvm = machine_code._compiled
def compiled(*given):
    found["compiled"] += 1
    return of_llvm(*given)
machine_code._compiled = compiled
computed = bound.posterior_variances
def posterior_variances(*given, **named):
    found["bounds"] += 1
    return computed(*given, **named)
bound.posterior_variances = posterior_variances
import tuning.reporting.page as sketchbook
from tuning.cli.main import main
sketchbook.figure_svg = lambda *_: ("<svg></svg>", "")  # to draw takes most of a report's time
for words in json.loads(sys.argv[1]):
    sys.argv[:] = ["thruster", *words, "--problem", "reactor:problem"]
    try:
        main()
    except SystemExit as stop:
        assert not stop.code, (words, stop.code)
print(json.dumps(found))
"""


@pytest.fixture
def reactor(tmp_path):
    """A user's folder, and a process that runs commands in it and tells what was compiled and computed."""
    (tmp_path / "reactor.py").write_text(REACTOR)
    (tmp_path / "rates.py").write_text("ACTIVATION = 8750.0\n")

    def run(*lines):
        command = [sys.executable, "-c", COUNTING, json.dumps([line.split() for line in lines])]
        done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        return json.loads(done.stdout.splitlines()[-1])

    return run


@pytest.mark.slow
def test_a_second_run_compiles_nothing_and_computes_no_bound_anew(reactor):
    compare = "compare --filter ekf tuned.json"
    reactor("tune --filter ekf --trials 2 --out tuned.json --seed 1", compare)
    assert reactor("report tuned.json", compare) == {"compiled": 0, "bounds": 0}


@pytest.mark.slow
def test_a_number_that_the_model_imports_changes_the_bound(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "reactor.py").write_text(REACTOR)
    scales = []
    for activation in (8750.0, 8900.25):  # of other lengths: Python tells files of one second apart by these
        (tmp_path / "rates.py").write_text(f"ACTIVATION = {activation}\n")
        for name in ("reactor", "rates"):
            sys.modules.pop(name, None)
        scales.append(find_problem("reactor:problem").scale)
    for name in ("reactor", "rates"):
        sys.modules.pop(name, None)
    assert abs(scales[1][0] / scales[0][0] - 1) > 0.01
