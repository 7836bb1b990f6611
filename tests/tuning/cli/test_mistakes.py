"""A user's mistake at the command line is one clear line and exit code 2; no file is written or changed."""

import json
from pathlib import Path

import numpy as np
import pytest

LINES = Path(__file__).with_name("mistakes.txt").read_text(encoding="utf-8").splitlines()
MISTAKES = [line.split(" | ") for line in LINES if line and not line.startswith("#")]


@pytest.fixture
def files(tmp_path):
    """Files that commands are given or would write over, and what is in all files by now."""
    times = 0.01 * np.arange(61)
    rows = [f"{t:.2f},{6 * np.sin(t):.4f},{np.cos(9 * t):.4f},{150 * np.sin(t):.3f}" for t in times]
    header = "time_s,voltage_V,measured_thrust_N,measured_speed_rad_per_s"
    (tmp_path / "run.csv").write_text("\n".join([header, *rows]) + "\n")
    (tmp_path / "text.txt").write_text("hello\n")
    (tmp_path / "there.py").write_text("mine\n")
    (tmp_path / "none").write_text("a file\n")
    (tmp_path / "old.json").write_text(json.dumps({"format": "thruster-env tuned filter", "version": 1}))
    return lambda: {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}


@pytest.mark.parametrize(("command", "line"), MISTAKES, ids=[command for command, _ in MISTAKES])
def test_a_users_mistake_is_one_clear_line_and_exit_code_2(command, line, thruster, files):
    before = files()
    done = thruster(*command.split())
    *_, said = done.stderr.splitlines()  # below a warning or the bar of what was begun
    assert done.returncode == 2 and said.startswith("thruster: ") and line in f"{said}$"
    assert "Traceback" not in done.stderr and not done.stdout and files() == before
