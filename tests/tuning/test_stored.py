"""What a tuned file and a study keep of long work reads as it was; `verify` says whether a file's metrics hold."""

import json
import math
from concurrent.futures import ThreadPoolExecutor

import optuna
import pytest

from filters.consistency.nees import Interval
from filters.tuned_file import read_tuned_file, sealed
from tests.tuned_files import rewrite, write_untuned
from tuning.api import report
from tuning.api.held_out import HeldOut
from tuning.api.report import report as write_report
from tuning.api.verify import Difference, verify
from tuning.evaluation import held_out as summary
from tuning.evaluation.held_out import evaluate_held_out, sizes_as_data, stored_comparison, stored_sizes
from tuning.evaluation.sizes import SizeRow
from tuning.evaluation.tuned import metrics, read_tuned, write_tuned
from tuning.evaluation.worth import scaling_sentence, tuning_effect
from tuning.plants.thruster import find_scenario
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice
from tuning.search.study import open_study, run_study

NOMINAL = find_scenario("nominal")


@pytest.mark.parametrize("scenario", ["nominal", "startup"])
def test_a_comparison_reads_as_it_was(tmp_path, scenario):
    path = write_untuned(tmp_path / "ekf.json", scenario, seeds=3)
    choice, problem, _ = read_tuned(path)
    content, fresh = read_tuned_file(path), evaluate_held_out(choice, problem, 0, 3)
    found = stored_comparison(content, choice, problem)
    assert metrics(found) == metrics(fresh) and found.ratios == fresh.ratios
    assert HeldOut(choice, problem, found).tables() == HeldOut(choice, problem, fresh).tables()
    assert tuning_effect(found) == tuning_effect(fresh) and scaling_sentence(found) == scaling_sentence(fresh)
    assert found.default.choice == fresh.default.choice


def test_what_other_packages_made_or_what_is_bent_is_computed_anew(tmp_path):
    path = write_untuned(tmp_path / "ekf.json")
    choice = read_tuned(path)[0]
    for change in (
        lambda content: content["made_with"].update(numpy="0.1"),
        lambda content: content.pop("comparisons"),
        lambda content: content["comparisons"]["nominal"].update(score_ratios=[3]),
        lambda content: content["held_out"]["nominal"]["tuned"].update(rmse=[["a", 1, 2]]),
    ):
        content = json.loads(path.read_text())
        change(content)
        assert stored_comparison(content, choice, NOMINAL) is None


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_a_report_takes_what_the_file_keeps_unless_the_problem_has_changed(tmp_path, monkeypatch):
    path = write_untuned(tmp_path / "ekf.json")
    asked = []
    monkeypatch.setattr(
        report, "evaluate_held_out", lambda *given: asked.append(given) or evaluate_held_out(*given)
    )
    tables = write_report(path, storage="none.journal").markdown.read_text()
    assert not asked
    rewrite(path, lambda content: content.update(digest="another"))
    assert write_report(path, storage="none.journal").markdown.read_text() == tables and len(asked) == 1


def test_ensemble_sizes_read_as_they_were_of_the_same_choice_alone(monkeypatch):
    plan, choice = Plan("enkf", (NOMINAL,)), untuned_choice("enkf", NOMINAL)
    evaluation = evaluate_held_out(choice, NOMINAL, 0, 2).tuned
    rows = [SizeRow(n, evaluation, Interval(1.1, 1.0, 1.2), 0.5, 8) for n in (5, 30)]
    data = json.loads(json.dumps(sizes_as_data(rows, choice, plan), allow_nan=False))
    found = stored_sizes(data, choice.with_size(5), plan)
    assert [row._replace(evaluation=None) for row in found] == [row._replace(evaluation=None) for row in rows]
    assert found[0].evaluation.rmse == evaluation.rmse and found[0].evaluation.scored == evaluation.scored
    assert found[0].evaluation.has_truth and math.isnan(found[0].evaluation.median_nees)
    other = choice._replace(model={**choice.model, "measurement_noise_cov": 0.3})
    assert (
        stored_sizes(data, other, plan)
        is stored_sizes(data, choice.with_size(7), plan)
        is stored_sizes(3, choice, plan)
    )
    monkeypatch.setattr(summary, "versions", lambda: {"numpy": "0.1"})
    assert stored_sizes(data, choice, plan) is None


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


def test_the_command_says_whether_they_hold_and_exits_so(content, file, thruster):
    file(content)
    code, said, _ = thruster("verify", "tuned.json")
    assert code == 0 and "tuned.json holds: 294 numbers are the same within 1e-09 of their size." in said
    file({**with_nees(content, 3.0), "made_with": {**content["made_with"], "numpy": "1.0"}})
    code, said, _ = thruster("verify", "tuned.json")
    assert code == 1 and "does not hold: 1 of 294 numbers differ" in said
    assert "nominal: tuned nees 0" in said and "numpy 1.0 then" in " ".join(said.split())
    code, said, _ = thruster("verify", "tuned.json", "--json", "-")
    data = json.loads(said)
    assert code == 1 and not data["holds"] and data["differences"][0]["stored"] == 3.0
    assert data["packages"]["numpy"]["stored"] == "1.0"


def test_a_file_edited_by_hand_is_exit_code_2(content, file, thruster):
    path = file(content)
    with open(path, "w") as stream:
        json.dump({**content, "scenario": "nominal"}, stream)
    code, _, said = thruster("verify", "tuned.json")
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
