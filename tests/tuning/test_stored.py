"""What a tuned file and a study keep of long work: it reads as it was, and only where it follows from the same."""

import json
import math

import pytest

from filters.consistency.nees import Interval
from filters.tuned_file import read_tuned_file
from tests.tuned_files import rewrite, write_untuned
from tuning.api import report
from tuning.api.held_out import HeldOut
from tuning.api.report import report as write_report
from tuning.evaluation import held_out as summary
from tuning.evaluation.held_out import evaluate_held_out, sizes_as_data, stored_comparison, stored_sizes
from tuning.evaluation.sizes import SizeRow
from tuning.evaluation.tuned import metrics, read_tuned
from tuning.evaluation.worth import scaling_sentence, tuning_effect
from tuning.plants.thruster import find_scenario
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice

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
