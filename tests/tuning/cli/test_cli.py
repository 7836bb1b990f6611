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
from thruster_env.thruster.parameters import TUNNEL, derive_constants


def test_tune_resume_evaluate_and_wrap(thruster, as_json, tmp_path):
    options = ("tune", "--filter", "ekf", "--scenario", "mismatch")
    first = as_json(*options, "--trials", 12)
    assert first["trials"] == 12 and not first["interrupted"]
    again = thruster(*options, "--trials", 15, "--json", "again.json")
    assert again.returncode == 0 and "continues after 12 finished trials" in again.stderr
    words = " ".join(again.stdout.split())
    for word in (
        "tuned",
        "that of the scaled default",
        "the rule of thumb with its Q times",
        "bound",
        "NEES",
        "held-out",
    ):
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
    np.testing.assert_allclose(
        np.diag(env.filter.model.process_noise_cov), second["filter"]["model"]["process_noise_cov"]
    )
    scaled = TUNNEL._replace(lift_coefficient=1.15 * 1.75, voltage_gain=0.95 * 1133.2)
    expected = derive_constants(scaled, substep=env.unwrapped.plant.constants.substep)
    np.testing.assert_allclose(env.filter.model.constants, expected, rtol=1e-12)


def test_evaluate_says_and_draws_whether_a_filter_is_consistent(thruster, as_json, tmp_path):
    options = "evaluate", "--filter", "ekf", "--seeds", 30, "--consistency"
    done = thruster(*options, "new/calibrated.png")
    words = " ".join(done.stdout.split())
    for part in (
        "Underconfident: mean NEES",
        "Innovations are not white",
        "To try: lower Q",
        "rule of thumb over oracle",
    ):
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


BAD = [
    (("tune", "--filter", "none"), "filter must be one of kf, kf-steady, ekf, "),
    (("tune", "--scenario", "none"), "problem must be one of"),
    (
        ("tune", "--filter", "ekf", "--method", "gradient", "--worst"),
        "method='gradient' (--method) must minimise the mean over problems, but got worst (--worst)",
    ),
    (
        ("tune", "--filter", "enkf", "--method", "gradient"),
        "a filter whose likelihood has a gradient must be one of kf",
    ),
    (("tune", "--trials", "0"), "trials must be a whole number of at least 1, but got 0"),
    (("tune", "--storage", "sqlite:////no/such/folder/x.db"), "storage must be a database that can be reached"),
    (("tune", "--storage", "text.txt"), "storage must be a journal file"),
    (("tune", "--filter", "ekf", "--trials", "1", "--out", "text.txt/x.json"), "must be where it can be written"),
    (("evaluate", "--tuned", "missing.json"), "a tuned file must be readable"),
    (("evaluate", "text.txt"), "a tuned file must be whole JSON"),
    (
        ("evaluate", "--tuned", "old.json"),
        "a tuned file must be of version 2, 3 or 4, but old.json is of version 1: tune again",
    ),
    (("verify", "missing.json"), "a tuned file must be readable"),
    (
        ("report", "missing"),
        "a report must be of a tuned file or of a study in out/studies.journal, but got 'missing'",
    ),
    (("evaluate",), "give either a tuned file or a filter (--filter NAME)"),
    (("evaluate", "a.json", "--tuned", "b.json"), "a tuned file must be one, but got a.json and --tuned b.json"),
    (("evaluate", "--filter", "ekf", "--seeds", "1"), "held-out seeds must be a whole number of at least 2"),
    (
        ("evaluate", "--filter", "ekf", "--consistency", "x.tex"),
        "--consistency must end in .png, .svg or .pdf, but",
    ),
    (("evaluate", "--filter", "ekf", "--consistency", "text.txt/x.png"), "must be where it can be written"),
    (("evaluate", "--filter", "open-loop", "--consistency", "x.png"), "must be of a filter with a covariance"),
    (("inspect", "--preset", "none"), "preset must be one of"),
    (("inspect", "--dt", "-1"), "dt must be positive, but got -1.0"),
    (("inspect", "--voltage", "30"), "voltage must be within plus and minus 24, but got 30.0"),
    (("inspect", "--out", "picture.tex"), "--out must end in .png, .svg or .pdf, but got 'picture.tex'"),
    (("inspect", "--out", "text.txt/x.png"), "must be where it can be written"),
    (("inspect", "--voltage", "0", "--out", "x.png"), "the thrust must move with the voltage"),
    (("simulate", "--out", "run.txt"), "--out must end in .csv, .parquet or .npz, but got 'run.txt'"),
    (("simulate", "--out", "run.csv", "--measurement-noise", "-1"), "no negative variance"),
    (("simulate", "--out", "run.csv", "--voltage", "nan"), "voltage must be a finite number, but got nan"),
    (("reproduce", "none"), "none"),
    (("nothing",), "nothing"),
]


@pytest.mark.parametrize(("arguments", "line"), BAD, ids=[" ".join(arguments) for arguments, _ in BAD])
def test_a_users_mistake_is_one_clear_line_and_exit_code_2(arguments, line, thruster, tmp_path):
    (tmp_path / "text.txt").write_text("hello\n")
    (tmp_path / "old.json").write_text(json.dumps({"format": "thruster-env tuned filter", "version": 1}))
    done = thruster(*arguments)
    assert done.returncode == 2
    assert line in done.stderr and "Traceback" not in done.stderr
    left = {path.name for path in tmp_path.iterdir()} - {"text.txt", "old.json", "out"}
    assert not left, "no half-written file"


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
