"""`thruster demo`: its own result first, in 42 lines, and the page that it speaks of."""

import json
import sys
from dataclasses import replace
from pathlib import Path

import gymnasium as gym
import pytest

import thruster_env  # noqa: F401 - registers the env
from filters import EstimateState
from thruster_env.core.text_tables import console
from tuning.api.report import Report
from tuning.cli import demo
from tuning.cli.main import main
from tuning.search.space import AUTO_FILTER_TYPES


@pytest.fixture
def run_demo(tmp_path, monkeypatch, capsys):
    """Run it with three trials in an empty folder; returns exit code and lines of standard output."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(console, "width", 80)
    monkeypatch.setattr(sys, "argv", ["thruster", "demo", "--trials", "3", "--json", "demo.json"])

    def run():
        with pytest.raises(SystemExit) as stop:
            main()
        return stop.value.code or 0, capsys.readouterr().out.splitlines()

    return run


def test_demo_tells_its_result_in_42_lines(run_demo, tmp_path):
    code, lines = run_demo()
    assert code == 0 and len(lines) <= 42 and max(map(len, lines)) <= 80
    data = json.loads((tmp_path / "demo.json").read_text())
    held_out = data["tuning"]["held_out"]["outliers"]
    words = " ".join(" ".join(lines).split())
    assert words.startswith("An extended Kalman filter")
    assert 0 < words.index(data["advice"]) < words.index("rule of thumb")
    (row,) = [line.split() for line in lines if line.startswith(" tuned ")]
    found = [rmse[0] for rmse in held_out["tuned"]["rmse"]]
    assert [float(row[1]), float(row[3])] == pytest.approx(found, rel=0.006)
    told = [tmp_path / line.split()[0] for line in lines if line.startswith("out/")]
    written = data["report"], data["tuning"]["file"], data["best_type"]["file"]
    assert told == [tmp_path / name for name in written]
    best = data["best_type"]["held_out"]["outliers"]["tuned"]["rmse"]
    (row,) = [line.split() for line in lines if line.startswith(" auto: ")]
    assert [float(row[2]), float(row[4])] == pytest.approx([rmse[0] for rmse in best], rel=0.006)
    assert f"also chose the filter type, among {len(AUTO_FILTER_TYPES)}: {row[1]}." in words
    assert "<html" in told[0].read_text()
    sensors = {"thrust": [{"name": "outliers", "std": 10.0, "probability": 0.05}]}
    assert EstimateState(gym.make("BowThruster-v0", sensors=sensors), tuned=str(told[1]))


def test_a_demo_whose_search_was_interrupted_says_so_and_exits_with_130(run_demo, monkeypatch):
    tune, page = demo.run_tuning, Path("out/page.html")

    def interrupted(*arguments, **options):
        tuning = tune(*arguments, **options)
        return replace(tuning, result=tuning.result._replace(interrupted=True))

    monkeypatch.setattr(demo, "run_tuning", interrupted)
    monkeypatch.setattr(demo, "write_report", lambda *_, **options: Report(page, page, "Tuning lowers the score."))
    code, lines = run_demo()
    assert code == 130 and "3 trials, interrupted, on 32 runs" in " ".join(lines)


def test_a_demo_that_is_interrupted_later_exits_with_130(run_demo, monkeypatch):
    monkeypatch.setattr(demo, "run_tuning", failing(KeyboardInterrupt))
    assert run_demo() == (130, [])


def failing(error):
    def function(*arguments, **options):
        raise error

    return function
