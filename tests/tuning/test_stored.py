"""What a tuned file and a study keep of long work reads as it was; digests, and numbers that are computed once."""

import json
import math
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import optuna
import pytest

from filters.consistency.nees import Interval
from filters.tuned_file import read_tuned_file, sealed
from tests.filters.checks import refused
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
from tuning.problems import model_problem
from tuning.problems.find import find_problem
from tuning.problems.model_problem import cached_numbers
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
    wrong = (data, other), (data, choice.with_size(7)), (3, choice)
    assert all(stored_sizes(content, of, plan) is None for content, of in wrong)
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
    refused(rule, verify, file({**content, "held_out": held_out}))


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


class Code:
    """What tells a folder, as compiled code does."""

    def __init__(self, folder):
        self.folder = folder and str(folder)


@pytest.fixture
def ask(monkeypatch, tmp_path):
    """Ask for two numbers in a fresh process, so to speak; `ask.computed` counts."""
    monkeypatch.setattr(model_problem, "_known", {})

    def ask(follows_from=b"it", value=(0.1, 1e-300), folder=tmp_path / "cache", fresh=True):
        if fresh:
            model_problem._known.clear()

        def compute():
            ask.computed += 1
            return np.array(value)

        return cached_numbers("bound", 2, follows_from, Code(folder), compute)

    ask.computed = 0
    return ask


def test_another_process_finds_the_same_digits(ask, tmp_path):
    first, second = ask(), ask()
    assert first.tolist() == second.tolist() == [0.1, 1e-300] and ask.computed == 1
    (file,) = (tmp_path / "cache").iterdir()
    assert re.fullmatch(r"bound-[0-9a-f]{32}\.json", file.name)
    first[:] = 0.0  # of the caller alone
    assert ask(fresh=False).tolist() == [0.1, 1e-300]


def test_what_they_follow_from_and_the_processor_tell_them_apart(ask, monkeypatch):
    ask(), ask(b"something else", (3.0, 4.0))
    assert ask().tolist() == [0.1, 1e-300] and ask(b"something else").tolist() == [3.0, 4.0] and ask.computed == 2
    monkeypatch.setattr("thruster_env.graphs.machine_code.host", lambda: "another processor")
    assert ask(value=(5.0, 6.0)).tolist() == [5.0, 6.0]


@pytest.mark.parametrize("content", [b"", b"[1.0]", b"[1.0, NaN]", b'{"a": 1}', b'["x", 1]', b"\xff", b"[1, [2]]"])
def test_a_damaged_file_is_as_none(ask, tmp_path, content):
    ask()
    (file,) = (tmp_path / "cache").iterdir()
    file.write_bytes(content)
    assert ask().tolist() == [0.1, 1e-300] and ask.computed == 2


def test_without_a_folder_or_where_they_are_not_finite_numbers_last_as_long_as_the_process(ask, tmp_path):
    ask(folder=None), ask(folder=None, fresh=False)
    assert ask.computed == 1
    blocked = tmp_path / "file"
    blocked.write_text("")
    assert ask(folder=blocked / "below").tolist() == [0.1, 1e-300] and os.path.isfile(blocked)
    assert np.isnan(ask(value=(np.nan, 1.0))).any() and ask().tolist() == [0.1, 1e-300]


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
