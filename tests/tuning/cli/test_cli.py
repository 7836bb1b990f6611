import csv
import json
import re
import signal
import subprocess
import sys
import time

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the env
from filters import EstimateState
from tests import altitude_problem
from thruster_env.logs.write import write_log
from thruster_env.thruster.parameters import TUNNEL, derive_constants
from tuning.evaluation.baselines import given_noise
from tuning.evaluation.held_out import evaluate_held_out
from tuning.experiments.identification import TRUTH, record


def test_tune_resume_evaluate_and_wrap(thruster, as_json, tmp_path):
    options = ("tune", "--filter", "ekf", "--scenario", "mismatch")
    first = as_json(*options, "--trials", 12)
    assert first["trials"] == 12 and not first["interrupted"]
    again = thruster(*options, "--trials", 15, "--json", "again.json")
    assert again.returncode == 0 and "continues after 12 finished trials" in again.stderr
    words = " ".join(again.stdout.split())
    for word in ("tuned", "that of the scaled default", "rule of thumb with its Q times", "NEES", "held-out"):
        assert word in words
    second = json.loads((tmp_path / "again.json").read_text())
    assert second["trials"] == 15
    assert second["best_training_value"] <= first["best_training_value"]

    evaluated = as_json("evaluate", second["file"])
    held_out = second["held_out"]["mismatch"]
    assert all(evaluated[key] == held_out[key] for key in ("tuned", "scaled", "scaled_default"))
    assert held_out["scaled_default"]["factor"] == 0.03248  # on 1 % of the ranges, which is far too much
    assert held_out["tuned_over_untuned"][0] < held_out["tuned_over_scaled"][0]

    env = EstimateState(gym.make("BowThruster-v0"), tuned=str(tmp_path / second["file"]))
    assert env.filter.name == "ekf"
    q = second["filter"]["model"]["process_noise_cov"]
    np.testing.assert_allclose(np.diag(env.filter.model.process_noise_cov), q)
    scaled = TUNNEL._replace(lift_coefficient=1.15 * 1.75, voltage_gain=0.95 * 1133.2)
    expected = derive_constants(scaled, substep=env.unwrapped.plant.constants.substep)
    np.testing.assert_allclose(env.filter.model.constants, expected, rtol=1e-12)


def test_evaluate_says_and_draws_whether_a_filter_is_consistent(thruster, as_json, tmp_path):
    options = "evaluate", "--filter", "ekf", "--seeds", 30, "--consistency"
    done = thruster(*options, "new/calibrated.png")
    words = " ".join(done.stdout.split())
    for part in ("Underconfident: mean NEES", "Innovations are not white", "To try: lower Q", "over oracle"):
        assert part in words
    assert (tmp_path / "new" / "calibrated.png").read_bytes().startswith(b"\x89PNG")
    found = as_json(*options, "again.png")["consistency"]
    assert found["nees"]["mean"][0] < found["nees"]["right"] == 2.0
    assert found["picture"] == "again.png" and len(found["sentences"]) == 13
    assert thruster("evaluate", "--help").stdout.count("calibrated.png") == 1


def test_simulate_writes_what_the_env_does_with_units_in_the_header(thruster, tmp_path):
    done = thruster("simulate", "--out", "run.csv", "--seed", 4, "--voltage", 9, "--steps", 20)
    assert done.returncode == 0, done.stderr
    with (tmp_path / "run.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == 21
    env = gym.make("BowThruster-v0")
    _, info = env.reset(seed=4)
    for row in rows:
        assert float(row["omega_m_rad_per_s"]) == pytest.approx(info["state"][0], rel=1e-8)
        assert float(row["U_a_m_per_s"]) == pytest.approx(info["state"][1], rel=1e-8)
        assert float(row["measured_thrust_N"]) == pytest.approx(info["measurement"][0], rel=1e-8)
        assert float(row["time_s"]) == pytest.approx(info["time"])
        _, _, _, _, info = env.step(np.array([9.0], dtype=np.float32))
    assert thruster("simulate", "--out", "run.npz", "--seed", 4, "--steps", 20).returncode == 0
    columns = np.load(tmp_path / "run.npz")
    assert set(columns) == set(rows[0]) and len(np.unique(columns["voltage_V"][:-1])) == 1


def test_inspect_prints_units_and_the_number_of_substeps(thruster, as_json):
    done = thruster("inspect", "--preset", "tunnel", "--voltage", 12)
    assert done.returncode == 0 and "[rad/s]" in done.stdout
    assert re.search(r"Runge-Kutta substeps a sample time +2", done.stdout)
    data = as_json("inspect")
    assert data["steady_state"]["omega_m [rad/s]"] == pytest.approx(193.803, abs=1e-3)


def test_inspect_shows_the_published_model_beside_ours(thruster, as_json, tmp_path):
    done = thruster("inspect", "--preset", "open_bladed_corrected")
    words = " ".join(done.stdout.split())
    for text in ("published: open_bladed", "-523.7 -1519.8", "they are not a linearisation", "none: not stable"):
        assert text.lower() in words.lower()
    data = as_json("inspect", "--preset", "open_bladed_corrected")
    assert data["published"]["A"] == [[-523.7, -1519.8], [-1.15, -0.13]]
    assert data["published"]["printed"]["A_d"] == [[0.0116, -2.9445], [-0.0022, 1.0260]]
    assert data["published"]["dc_gain"]["T [N]"] == [None, None]
    assert data["controllability"]["rank"] == data["observability"]["rank"] == 2
    assert np.shape(data["B"]) == np.shape(data["B_d"]) == (2, 2)
    gain = data["bode"]["T/V_s"]["magnitude [N/V]"][0]
    assert gain == pytest.approx(data["dc_gain"]["T [N]"][0], rel=1e-3)
    assert len(data["step"]["V_s"]["T [N]"]) == len(data["step"]["time [s]"])
    assert as_json("inspect", "--preset", "t200")["published"] is None
    assert not [*tmp_path.iterdir()]


@pytest.mark.slow
def test_the_installed_command_interrupted_keeps_its_trials_and_says_so(tmp_path):
    command = [sys.executable, "-m", "tuning.cli.main", "tune", "--filter", "ekf", "--trials", "100000"]
    process = subprocess.Popen(command, cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    journal = tmp_path / "out" / "studies.journal"
    for _ in range(1200):
        time.sleep(0.05)
        if journal.exists() and journal.read_text().count('"op_code":6') > 20:
            break
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 130 and "Traceback" not in stderr
    assert "Interrupted: this is the result of the finished trials" in stdout


ALTITUDE = "tests.altitude_problem:problem"


def test_what_the_model_came_with_is_evaluated_and_is_no_rule_of_thumb(as_json, thruster):
    told = as_json("evaluate", "--given", "--problem", ALTITUDE, "--seeds", 12)
    problem = altitude_problem.problem()
    mine = given_noise("ekf", problem)
    assert told["filter"]["name"] == "ekf" and told["filter"]["model"] == altitude_problem.GIVEN == mine.model
    found = evaluate_held_out(mine, problem, 0, 12).tuned
    assert told["given"]["score"] == pytest.approx(list(found.score), rel=1e-9)
    assert told["noise"]["score"][0] < told["given"]["score"][0]
    done = thruster("evaluate", "--given", "--problem", ALTITUDE, "--filter", "ukf", "--seeds", 3)
    assert done.returncode == 0 and "Parameters of the ukf filter" in done.stdout and "given" in done.stdout


@pytest.mark.slow
def test_a_preset_that_was_identified_is_not_made_worse_by_tuning(as_json, tmp_path):
    for place, log in enumerate(record(0, 3, 300)):
        write_log(tmp_path / f"run{place}.csv", log)
    logs = [f"run{place}.csv" for place in range(3)]
    of_logs = ("--sensor", "thrust", "--sensor", "speed")
    free = ("--free", ",".join(name for name in TRUTH if not name.startswith(("Q", "R"))), "--starts", 1)
    as_json("identify", *logs, "--preset", "tunnel_physical", *of_logs, *free, "--out", "mine.toml")
    options = [part for log in logs for part in ("--log", log)]
    told = as_json("tune", "--filter", "ekf", *options, "--preset", "mine.toml", *of_logs, "--trials", 12)
    (held_out,) = told["held_out"].values()
    assert held_out["tuned"]["log_likelihood"] >= held_out["given"]["log_likelihood"]
    assert {"given"} <= {one["name"] for one in told["choice"]["met"]}
