"""A tuned file's metrics hold, or what differs is told."""

import json
import sys
from concurrent.futures import ThreadPoolExecutor

import optuna
import pytest

from filters.tuned_file import sealed
from tuning.api.verify import Difference, verify
from tuning.cli.main import main
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import write_tuned
from tuning.plants.thruster import find_scenario
from tuning.search.plan import Plan
from tuning.search.study import open_study, run_study

PLAN = Plan("ekf", (find_scenario("mismatch"), find_scenario("nominal")))


@pytest.fixture(scope="module")
def content(tmp_path_factory):
    """What a tuned file of a small study on two scenarios holds."""
    result = run_study(open_study("s", PLAN, optuna.storages.InMemoryStorage()), PLAN, 2)
    comparisons = [evaluate_held_out(result.choice, scenario, PLAN.seed, 4) for scenario in PLAN.scenarios]
    path = tmp_path_factory.mktemp("tuned") / "tuned.json"
    write_tuned(path, PLAN, result, comparisons, "s")
    return json.loads(path.read_text())


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Write a content with its hash into the working folder."""
    monkeypatch.chdir(tmp_path)

    def write(content):
        (tmp_path / "tuned.json").write_text(json.dumps(sealed(content)))
        return "tuned.json"

    return write


def thruster(monkeypatch, capsys, *arguments):
    monkeypatch.setattr(sys, "argv", ["thruster", *arguments])
    with pytest.raises(SystemExit) as stop:
        main()
    return stop.value.code or 0, *capsys.readouterr()


def with_nees(content, value):
    changed = json.loads(json.dumps(content))
    changed["held_out"]["nominal"]["tuned"]["nees"][0] = value
    return changed


def test_what_was_written_holds_in_each_scenario(content, file):
    found = verify(file(content))
    assert found.holds and found.packages == {} and found.checked == 2 * (2 + 2 + 5 * 27 + 5 + 2 + 1)


def test_rounding_is_allowed_and_no_more(content, file):
    stored = content["held_out"]["nominal"]["tuned"]["nees"][0]
    with ThreadPoolExecutor(1) as pool:
        assert verify(file(with_nees(content, stored * (1 + 1e-10))), executor=pool).holds
    found = verify(file(with_nees(content, stored * 1.5)))
    assert not found.holds
    assert found.differences == [Difference("nominal: tuned nees 0", stored * 1.5, stored)]
    assert found.differences[0].relative == pytest.approx(1 / 3)


def test_a_number_that_is_missing_or_none_differs(content, file):
    changed = with_nees(content, None)
    del changed["held_out"]["mismatch"]["true"]["score"]
    found = verify(file(changed))
    assert len(found.differences) == 4 and all(d.relative == float("inf") for d in found.differences)


@pytest.mark.parametrize(
    ("held_out", "rule"),
    [
        (None, "must have held-out metrics to verify, but tuned.json has None"),
        ({}, "must have held-out metrics to verify"),
        ({"nominal": {}}, "must give their first seed and the one after the last"),
        ({"nominal": {"seeds": [3]}}, "must give their first seed and the one after the last"),
        ({"none": {"seeds": [0, 2]}}, "was tuned on 'none', an object of yours"),
        ({"nominal": {"seeds": [2, 2]}}, "held-out seeds must be a whole number of at least 2, but got 0"),
    ],
)
def test_a_file_without_metrics_is_refused_in_one_line(content, file, held_out, rule):
    with pytest.raises(ValueError, match=rule) as error:
        verify(file({**content, "held_out": held_out}))
    assert "\n" not in str(error.value)


def test_the_command_says_whether_they_hold_and_exits_so(content, file, monkeypatch, capsys):
    file(content)
    code, said, _ = thruster(monkeypatch, capsys, "verify", "tuned.json")
    assert code == 0 and "tuned.json holds: 294 numbers are the same within 1e-09 of their size." in said
    file({**with_nees(content, 3.0), "made_with": {**content["made_with"], "numpy": "1.0"}})
    code, said, _ = thruster(monkeypatch, capsys, "verify", "tuned.json")
    assert code == 1 and "does not hold: 1 of 294 numbers differ" in said
    assert "nominal: tuned nees 0" in said and "numpy 1.0 then" in " ".join(said.split())
    code, said, _ = thruster(monkeypatch, capsys, "verify", "tuned.json", "--json", "-")
    data = json.loads(said)
    assert code == 1 and not data["holds"] and data["differences"][0]["stored"] == 3.0
    assert data["packages"]["numpy"]["stored"] == "1.0"


def test_a_file_edited_by_hand_is_exit_code_2(content, file, monkeypatch, capsys):
    path = file(content)
    with open(path, "w") as stream:
        json.dump({**content, "scenario": "nominal"}, stream)
    code, _, said = thruster(monkeypatch, capsys, "verify", "tuned.json")
    assert code == 2 and "a tuned file must be unchanged" in said


def test_a_file_from_before_the_scaled_default_holds(content, file):
    older = json.loads(json.dumps(content))
    for entry in older["held_out"].values():
        del entry["scaled"], entry["scaled_default"]
        del entry["tuned"]["log_score"]
    found = verify(file(older))
    assert found.holds and found.checked == 2 * (2 + 2 + 4 * 27 + 5 - 3 + 1)
    wrong = json.loads(json.dumps(content))
    wrong["held_out"]["mismatch"]["scaled_default"]["factor"] *= 2
    assert [one.place for one in verify(file(wrong)).differences] == ["mismatch: scaled_default factor"]
