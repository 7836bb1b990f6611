"""The study of users' problems: significance, what is kept, tables, and the command in its quick form."""

import json

import numpy as np
import pytest
from scipy.stats import kstest, norm

from filters.consistency.nees import Interval
from tests.filters.checks import refused
from tests.linear_problem import LinearProblem
from tuning.evaluation.evaluate import score, score_ratio
from tuning.experiments import users
from tuning.experiments.users import Case, Paired, Panel, chance_if_no_worse, found_problems, holm, run_panel

SAME = Interval(1.0, 1.0, 1.0)
blind = LinearProblem(truth=False)


class Errors:
    """As much of an evaluation as a comparison reads."""

    has_truth = True

    def __init__(self, mean_squares, scale, weights=None):
        self.mean_squares, self.scale, self.weights = np.asarray(mean_squares), np.asarray(scale), weights


def pair(seed, runs=200, factor=1.0, scale=(1.0, 0.5, np.inf)):
    """Mean squares of two filters with an equal distribution but for a factor, and a common part by run."""
    draws = np.random.default_rng(seed)
    common = draws.gamma(4.0, size=(runs, 1))
    both = [common * draws.gamma(5.0, 0.2, size=(runs, 3)) for _ in range(2)]
    return Errors(factor**2 * both[0], scale), Errors(both[1], scale)


def case(problem="a", name="ekf", **baselines):
    paired = {label.replace("_", " "): one for label, one in baselines.items()}
    return Case(problem, name, 1.2, 1.05, 0, "", paired, 3.0)


def test_chances_are_uniform_where_neither_is_worse():
    chances = [chance_if_no_worse(*pair(seed)) for seed in range(400)]
    assert kstest(chances, "uniform").pvalue > 1e-4


@pytest.mark.parametrize("lengths", [None, np.random.default_rng(1).integers(5, 200, 200).astype(float)])
def test_chances_are_those_of_the_bootstrap(lengths):
    worse, base = (Errors(one.mean_squares, one.scale, lengths) for one in pair(7, factor=1.04))
    found = score_ratio(worse, base)
    scores = [score(one.mean_squares, one.scale, lengths) for one in (worse, base)]
    assert found.value == pytest.approx(scores[0] / scores[1])
    # The 95 % interval of log ratio has the half width 1.96 standard errors.
    error = np.log(found.high / found.low) / (2 * 1.96)
    normal = np.log(found.value) / error
    assert norm.isf(chance_if_no_worse(worse, base)) == pytest.approx(normal, rel=0.06)
    assert chance_if_no_worse(base, worse) == pytest.approx(1.0 - chance_if_no_worse(worse, base), rel=1e-9)


def test_ends_of_chances_and_a_state_that_does_not_count():
    a, b = pair(3)
    other = Errors(a.mean_squares * [1.0, 1.0, 50.0], a.scale)
    assert chance_if_no_worse(other, b) == chance_if_no_worse(a, b)
    a, b = pair(5)
    assert chance_if_no_worse(a, a) == 1.0
    assert chance_if_no_worse(Errors(b.mean_squares * 1.21, b.scale), b) == 0.0  # 10 % worse in each run alike
    assert chance_if_no_worse(Errors(b.mean_squares * np.inf, b.scale), b) == 0.0
    refused("a p-value needs at least two runs, but got 1", chance_if_no_worse, *pair(5, runs=1))


def test_holms_procedure_is_that_of_his_paper_and_levels_are_the_pages():
    assert holm([0.015, 0.04, 0.03, 0.005], 0.05) == [True, False, False, True]  # 0.0125, 0.0167, 0.03 > 0.025
    assert holm([0.02, 0.02], 0.05) == [True, True] and holm([0.03, 0.03], 0.05) == [False, False]
    assert holm([]) == []
    assert users.LEVEL == 0.05 and users.TAIL == 0.025


def test_the_verdict_counts_neither_the_oracle_nor_the_same_filter():
    cases = [
        case(given=Paired(Interval(1.1, 1.05, 1.15), 1e-9), oracle=Paired(Interval(2.0, 1.9, 2.1), 1e-30)),
        case("b", given=Paired(SAME, 1.0), rule_of_thumb=Paired(Interval(0.5, 0.4, 0.6), 1.0)),
        case("b", "ukf", given=Paired(Interval(1.01, 1.001, 1.02), 0.03)),
    ]
    found = users.verdict_of(cases)
    assert (found.comparisons, found.above, found.wins) == (3, 2, 1) and found.by_chance == pytest.approx(0.075)
    (loss,) = found.losses
    assert (loss.case.problem, loss.baseline) == ("a", "given")
    assert users.header(cases)[2:5] == ["over given", "over rule of thumb", "over oracle"]
    rows = users.rows_of(cases)
    assert rows[0][2] == "1.100 [1.050, 1.150] !" and rows[1][2] == "1, the same" and rows[2][0] == ""
    said = users.sentences(cases)
    assert "in 1 of 3 comparisons" in said[0]
    assert "1.100 [1.050, 1.150] times the score of what was given." in said[2]


def test_an_error_is_kept_and_the_others_go_on(monkeypatch, tmp_path):
    def failing(problem, **arguments):
        raise ValueError("Matrix is not positive definite")

    monkeypatch.setattr(users.tuning, "tune", failing)
    begun = []
    panel = Panel(users.PANEL[:1], ("ekf",), 2)
    (found,) = run_panel(panel, tmp_path, lambda *told: begun.append(told))
    assert found.error == "Matrix is not positive definite" and begun == [("altitude, ekf", 0, 1)]
    assert users.rows_of([found])[0][-1] == "failed" and "failed: Matrix" in users.sentences([found])[-1]


def test_ctrl_c_keeps_what_is_done(monkeypatch, tmp_path):
    def second_is_interrupted(problem, *arguments):
        if "battery" in problem.name:
            raise KeyboardInterrupt
        return case()

    monkeypatch.setattr(users, "tuned_case", second_is_interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_panel(Panel(users.PANEL[:2], ("ekf",), 2), tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["altitude-ekf-2-seed0.json"]


@pytest.mark.slow
def test_the_quick_study_goes_on_where_it_was(as_json, thruster, tmp_path, monkeypatch):
    arguments = "reproduce", "users", "--quick", "--trials", "3", "--out", str(tmp_path)
    first = as_json(*arguments)
    assert [one["problem"] for one in first["cases"]] == ["altitude", "battery"]
    for one in first["cases"]:
        assert {"given", "noise estimation", "oracle"} <= set(one["baselines"])
        for paired in one["baselines"].values():
            assert paired["low"] <= paired["value"] <= paired["high"] and 0.0 <= paired["chance"] <= 1.0

    def forbidden(*arguments):
        raise AssertionError("a case that is there was done again")

    monkeypatch.setattr(users, "tuned_case", forbidden)
    assert as_json(*arguments) == first
    (file,) = tmp_path.glob("battery-*.json")
    content = json.loads(file.read_text())
    file.write_text(json.dumps(content | {"of": content["of"] | {"problem": "another"}}))
    with pytest.raises(AssertionError, match="done again"):
        run_panel(Panel(users.PANEL[:2], ("ekf",), 3), tmp_path)
    file.write_text("{")
    with pytest.raises(ValueError, match="must be a whole file of results, but cannot be read"):
        run_panel(Panel(users.PANEL[:2], ("ekf",), 3), tmp_path)


def test_problems_that_do_not_fit_are_refused(tmp_path, monkeypatch):
    with pytest.raises(ValueError, match="a problem of the panel must have true states, but tests.tuning"):
        found_problems(["tests.tuning.experiments.test_users:blind"])
    monkeypatch.setattr(users, "PANEL", ("no_such_module:problem",))
    with pytest.raises(ValueError, match="must be found in tests/users of the working folder, a checkout"):
        found_problems(["no_such_module:problem"])
