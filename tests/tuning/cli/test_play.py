"""`thruster play` without a policy: PI, voltages, a log, with an estimate beside the truth, and without torch."""

import subprocess
import sys

import numpy as np
import pytest
from PIL import Image

from thruster_env.thruster.model import thruster_model
from thruster_env.thruster.rendering import ChartEntry, Overlay
from tuning.cli import play


@pytest.fixture
def frames(monkeypatch):
    """What would go into the video."""
    kept = []
    monkeypatch.setattr(play, "write_video", lambda path, pictures, rate: kept.append((path, pictures, rate)))
    return kept


def test_pi_follows_a_reference_under_an_estimate(as_json, frames):
    found = as_json("play", "--policy", "PI".lower(), "--steps", 12, "--filter", "EKF", "--out", "x.gif")
    assert found == {"steps": 12, "total_reward": found["total_reward"], "seconds": 0.12, "video": "x.gif"}
    ((path, pictures, rate),) = frames
    assert path.name == "x.gif" and rate == 25 and len(pictures) == 4 and pictures[0].shape[2] == 3
    alone, of_pi = (
        as_json("play", *policy, "--steps", 8, "--out", "x.gif") for policy in ((), ("--policy", "pi"))
    )
    assert alone == of_pi and alone["steps"] == 8


@pytest.mark.parametrize("option", [("--voltage", 8), ("--excitation", "prbs")])
def test_voltages_drive_the_thruster(as_json, frames, monkeypatch, option):
    seen, played = [], play._played
    monkeypatch.setattr(play, "_played", lambda env, *rest: seen.append(env) or played(env, *rest))
    found = as_json("play", *option, "--steps", 8, "--preset", "t200", "--seed", 3, "--out", "x.gif")
    assert found["steps"] == 8
    env = seen[0]
    assert env.unwrapped.plant.parameters.gear_ratio == 1.0  # a T200
    assert env.unwrapped.moment_of([0.0] * 40).reference is None


def test_a_log_is_shown_as_it_was_recorded(thruster, as_json, frames, monkeypatch):
    thruster("simulate", "--out", "run.csv", "--steps", 30, "--voltage", 9)
    shown = []
    monkeypatch.setattr("thruster_env.thruster.rendering.Renderer.add", lambda self, *both: shown.append(both))
    monkeypatch.setattr("thruster_env.thruster.rendering.Renderer.draw", lambda self: np.zeros((2, 2, 3)))
    assert as_json("play", "--log", "run.csv", "--out", "x.gif")["steps"] == 30
    table = np.genfromtxt("run.csv", delimiter=",", names=True)
    moment, overlay = shown[20]
    entries = (table[name][20] for name in table.dtype.names[2:6])
    assert moment == pytest.approx(ChartEntry(0.2, *entries, None, 9.0), nan_ok=True)
    assert isinstance(overlay, Overlay) and abs(overlay.omega_m - moment.omega_m) < 5 * overlay.omega_m_std
    thrust = thruster_model(preset="tunnel").output("T", np.array([[overlay.omega_m, overlay.U_a]]))[0]
    assert overlay.thrust == pytest.approx(thrust, rel=1e-9)


def test_where_a_log_has_no_truth_the_estimate_moves_the_propeller(thruster, tmp_path):
    times = 0.01 * np.arange(40)
    rows = [f"{t:.2f},9,{10 * (1 - np.exp(-20 * t)):.4f}" for t in times]
    (tmp_path / "bare.csv").write_text("time_s,voltage_V,measured_thrust_N\n" + "\n".join(rows) + "\n")
    done = thruster("play", "--log", "bare.csv", "--out", "bare.gif")
    assert done.returncode == 0 and "Video: bare.gif" in done.stdout
    with Image.open("bare.gif") as picture:
        assert picture.n_frames == 10
        first = np.asarray(picture.convert("RGB"), dtype=int)
        picture.seek(9)
        assert np.abs(np.asarray(picture.convert("RGB"), dtype=int) - first).sum() > 1e5


def test_torch_is_not_imported():
    code = "import sys, tuning.cli.play, tuning.cli.play; print('torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout == "False\n", done.stderr
