"""How the command line presents itself: version, panels, names, filters, tables at any width, colour, progress."""

import io
import json
import os
import signal
from types import SimpleNamespace

import pytest
from rich.console import Console

from filters.consistency.nees import Interval
from filters.registry import FILTERS, filter_type
from tests.linear_problem import LinearProblem
from thruster_env.core.checks import any_case, listening, meant, one_of
from thruster_env.core.text_tables import Table, console
from tuning.api.tune import file_name
from tuning.cli import output
from tuning.cli.app import COMMANDS
from tuning.cli.filters import entry
from tuning.evaluation.baselines import ORACLE, RULE, rule_of_thumb
from tuning.experiments import EXPERIMENTS
from tuning.reporting.tuning_report import way_out
from tuning.search.plan import Plan
from tuning.search.study import STOPPING, stop_on_interrupt

WITHOUT_JSON = ("explore",)  # what it finds is exported from its page


def test_what_is_random_has_a_seed_and_all_write_json(thruster):
    commands = set(COMMANDS) - {"reproduce"}
    without = {name for name in commands if "--seed " not in thruster(name, "--help").stdout}
    rest = {"inspect", "filters", "fit", "new", "methods", "report", "verify", "export", "log", "bollard"}
    assert without == rest
    for name in (*(commands - {*WITHOUT_JSON}), *(f"reproduce {experiment}" for experiment in EXPERIMENTS)):
        assert "--json " in thruster(*name.split(), "--help").stdout


def test_names_are_taken_in_any_case_and_in_python_told_apart_by_it(as_json):
    found = as_json("inspect", "--preset", "T200")
    assert found["preset"] == "t200"
    assert as_json("filters", "EnKF")["filters"][0]["name"] == "enkf"
    assert as_json("filters", "ekf", "--problem", "MisMatch")["problem"] == "mismatch"
    with pytest.raises(ValueError, match="filter must be one of kf, ekf, but got 'EKF'; did you mean 'ekf'?"):
        one_of("filter", "EKF", iter(["kf", "ekf"]))
    assert meant(3, ["ekf"]) == meant("", ["ekf"]) == ""
    assert any_case("EKF", ["kf", "ekf"]) == "ekf" and any_case("module:EKF", ["ekf"]) == "module:EKF"


ROWS = [["rule of thumb", "5.887 ±0.069", "0.1229 ±0.0018", "7.0", "0.21"]] * 2
HEADS = ["filter", "omega_m\n[rad/s]", "U_a\n[m/s]", "NEES", "NIS"]


def drawn(made, width, terminal=False, **environment):
    stream = io.StringIO()
    environment = {"TERM": "xterm-256color", **environment}
    Console(file=stream, width=width, force_terminal=terminal or None, _environ=environment).print(made)
    return stream.getvalue()


@pytest.mark.parametrize("width", [40, 60, 80, 140])
def test_a_table_has_the_same_columns_at_any_width(monkeypatch, width):
    monkeypatch.setattr(output.console, "width", width)
    made = Table("a title that is longer than the table", HEADS, ROWS, caption="of nothing")
    said = drawn(made, width)
    assert max(map(len, said.splitlines())) <= width and "…" not in said
    lines = said.splitlines()
    below = lines[next(i for i, line in enumerate(lines) if "──" in line) + 1]
    assert len(below.split()) >= 5 and below.rstrip().endswith("0.21")
    for word in "rule thumb 5.887 ±0.069 0.1229 7.0 omega_m NEES NIS".split():
        assert word in said


def test_the_first_ctrl_c_is_acknowledged_at_once():
    told = []
    with listening(told.append), stop_on_interrupt() as stopped:
        os.kill(os.getpid(), signal.SIGINT)
        assert stopped() and told == [STOPPING]


def test_a_preset_beyond_its_range_is_warned_about(thruster):
    done = thruster("inspect", "--preset", "t200", "--voltage", 20)
    assert done.returncode == 0 and "t200 is valid up to 13.3 V, but is driven by 20 V" in done.stderr
    assert "warning" not in thruster("inspect", "--preset", "t200", "--voltage", 13).stderr
    done = thruster("inspect", "--voltage", 60, "--max-voltage", 60)
    assert "tunnel is valid up to 24 V, but is driven by 60 V" in done.stderr


@pytest.mark.parametrize(
    ("name", "file"),
    [
        ("auv:motion", "auv-motion"),
        ("my folder/mine.toml", "mine"),
        ("nominal (presets/mine.toml)", "nominal-mine"),
        ("nominal (t200)", "nominal-t200"),
        ("run1.csv and 2 more", "run1.csv-and-2-more"),
    ],
)
def test_names_of_files_need_no_quotes(name, file):
    assert file_name(name) == file


def test_a_tuning_that_made_it_worse_says_what_to_do_next():
    ratios = {"scaled default": Interval(1.2, 1.1, 1.3)}
    comparison = SimpleNamespace(tuned=SimpleNamespace(has_truth=True), ratios=ratios)
    tuning = SimpleNamespace(
        answer=None,
        method="tpe",
        comparisons=[comparison],
        gradient=None,
        plan=SimpleNamespace(prune=True, filter="enkf", forget=None),
        result=SimpleNamespace(finished=6),
    )
    (said,) = way_out(tuning)
    assert "(--trials 12), or without pruning (--no-pruning)" in said and "Q and R of the scaled default" in said
    problem = LinearProblem()
    result, plan = SimpleNamespace(choice=rule_of_thumb("kf", problem)), Plan("kf", (problem,))
    alone = {"answer": ..., "method": "likelihood", "plan": plan, "result": result}
    by_method = SimpleNamespace(**{**vars(tuning), **alone})
    (said,) = way_out(by_method)
    assert said.startswith("What to take: the scaled default (Q11 = ")
    assert "without --method likelihood runs a study" in said
    logs = SimpleNamespace(tuned=SimpleNamespace(has_truth=False))
    logs.likelihood_gains = {"given": Interval(-20, -30, -10), RULE: Interval(-50, -60, -40)}
    logs.likelihood_gains[ORACLE] = Interval(-99, -99, -99)
    (said,) = way_out(SimpleNamespace(**{**vars(by_method), "comparisons": [logs]}))
    assert said.startswith("What to take: the rule of thumb (Q11 = ")
    comparison.ratios["scaled default"] = Interval(0.9, 0.8, 0.95)
    assert way_out(tuning) == way_out(by_method) == []


@pytest.mark.parametrize("width", [80, 120])
def test_the_list_names_every_filter_and_number_and_fits_the_terminal(thruster, monkeypatch, width):
    monkeypatch.setattr(console, "width", width)
    code, out, _ = thruster("filters")
    assert code == 0 and "…" not in out
    assert max(map(len, out.splitlines())) <= width
    first_words = [line.split()[0] for line in out.splitlines() if line.split()]
    for name in FILTERS:
        assert name in first_words
        assert set(filter_type(name).numbers) <= set(first_words)
    assert out.split().count("ensemble_size") == 3  # of members, particles, and few: shared lines are told once


@pytest.mark.parametrize("name", FILTERS)
@pytest.mark.parametrize("width", [80, 120])
def test_one_filter_is_shown_in_full(thruster, monkeypatch, name, width):
    monkeypatch.setattr(console, "width", width)
    code, out, _ = thruster("filters", name)
    assert code == 0
    assert max(map(len, out.splitlines())) <= width
    words = out.split()
    documentation = entry(name).documentation
    told = documentation.split("Attributes:")[0].split() + documentation.partition("Source:")[2].split()
    assert set(told) <= set(words)
    for number in entry(name).numbers:
        assert {number.name, str(number.default), *number.meaning.split()} <= set(words)


@pytest.mark.slow
def test_it_tells_which_filters_fit_a_problem_and_what_a_belief_takes(thruster):
    code, out, _ = thruster("filters", "--problem", "tuning.experiments.lorenz96:problem", "--json", "-")
    found = {one["name"]: one for one in json.loads(out)["filters"]}
    assert code == 0 and list(found) == list(FILTERS)
    assert "affine model" in found["kf"]["reason"] and found["kf"]["kilobytes"] is None
    assert found["etkf"]["reason"] == "" and found["etkf"]["ensemble_size"] == 30
    assert found["ekf"]["kilobytes"] > 8e-3 * 3 * 40**2 and found["pf"]["kilobytes"] > 8e-3 * 1000 * 40
    code, out, _ = thruster("filters", "ukf", "--problem", "nominal")
    assert code == 0 and "nominal: 2 states, 1 measurement, 1 input" in " ".join(out.split()) and "ekf" not in out
    code, _, err = thruster("filters", "--problem", "nowhere:problem")
    assert code == 2 and "must be 'module:object' that can be imported" in err
