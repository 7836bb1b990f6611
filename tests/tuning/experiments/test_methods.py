"""The study of methods of tuning: statistics against closed forms, resuming, and the command in its quick form."""

import json
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.stats import ttest_1samp, ttest_rel

from docs.scripts import DOCS
from tuning.evaluation.baselines import with_covariances
from tuning.experiments import lidar
from tuning.experiments import methods_runs as runs
from tuning.experiments.lidar import BEARING, GRADIENT, IN_A_FIFTH, METHODS, NOISE, OKF, RANGE
from tuning.experiments.methods_problems import CASES, FAST, QUICK, REFERENCE, ring
from tuning.experiments.methods_runs import Result, Scored
from tuning.experiments.methods_tables import TABLES, percent, tables
from tuning.search.space import untuned_choice

WALK = QUICK[0]


def result(method, place, score, error="", log_score=-1.0):
    scored = Scored(score, 1.0, 1.0, -10.0, log_score)
    name = WALK.model if method == REFERENCE else WALK.name
    return Result(name, method, place, {"1000": scored}, {"1": scored}, scored, 100.0, 0.1, {}, error)


def test_intervals_and_chances_are_students():
    values = np.random.default_rng(0).normal(0.1, 0.05, 8)
    found = runs.student(values)
    low, high = ttest_1samp(values, 0.0).confidence_interval(0.95)
    assert (found.value, found.low, found.high) == pytest.approx((values.mean(), low, high))
    one, best = dict(enumerate(values)), dict(enumerate(values - np.linspace(0.0, 0.03, 8)))
    expected = ttest_rel(list(one.values()), list(best.values()), alternative="greater").pvalue
    assert runs.chance(one, best) == pytest.approx(expected)
    assert runs.chance(best, best) == 1.0


def test_regrets_are_ratios_to_the_reference_and_the_best_comes_first():
    rng = np.random.default_rng(1)
    good, bad = 1.0 + rng.uniform(0.0, 0.004, 6), 1.2 + rng.uniform(0.0, 0.01, 6)
    results = [result(REFERENCE, 0, 0.8, log_score=-0.9)]
    results += [result("likelihood", k, 0.8 * one) for k, one in enumerate(good)]
    results += [result("random-only", k, 0.8 * one, "broke" if k == 2 else "") for k, one in enumerate(bad)]
    first, second = runs.regrets(results, WALK)
    assert (first.method, second.method) == ("likelihood", "random-only")
    assert first.ratio.value == pytest.approx(math.exp(np.log(good).mean()))
    assert first.equal and not first.worse and second.worse and not second.equal
    assert second.failures == 1 and second.sets == 6 and second.worst == pytest.approx(bad.max())
    assert first.log_score == pytest.approx(0.1)
    assert [percent(one) for one in (1.012, 0.999, 3.0)] == ["+1.2 %", "-0.1 %", "x 3"]


def test_all_methods_have_equal_data_and_starts_and_held_out_runs_are_others():
    first, again, other = (runs.data_set(WALK, place) for place in (0, 0, 1))
    np.testing.assert_array_equal(first.measurements, again.measurements)
    assert len(first.seeds) == WALK.runs and not set(first.seeds) & set(other.seeds)
    held_out = WALK.make().held_out_seeds(0, 200)
    assert not set(held_out) & {seed for place in range(20) for seed in WALK.make().training_seeds(place, 32)}
    assert runs.data_set(QUICK[1], 0).states is None
    q = [runs.start_of(WALK, place).model["process_noise_cov"][0] for place in range(4)]
    assert np.divide(q, q[0]).tolist() == pytest.approx([1.0, 100.0, 0.01, 1.0])
    assert runs.start_of(WALK, 2).model["measurement_noise_cov"] == pytest.approx(400.0)


def test_a_method_that_lacks_something_is_no_failure_and_one_that_breaks_is():
    blind = runs.run_method(QUICK[1], "noise-estimation", 0, FAST)
    assert blind.last is None and "needs true states" in blind.error
    studied = runs.run_method(WALK, "study", 0, FAST)
    assert studied.last is None  # it would draw runs of its own
    em = runs.run_method(WALK, "em", 0, FAST)
    assert em.error == "" and em.by_seconds.keys() == {"1"} and em.taken_runs <= FAST.runs + WALK.runs
    best = runs.reference(WALK, FAST).last
    assert best.score < em.last.score * 1.01


def test_the_reference_of_an_ensemble_is_scored_though_its_search_has_spent_its_passes(monkeypatch):
    monkeypatch.setattr(runs, "SIMPLEX", 2)
    assert runs.reference(WALK._replace(filter="enkf", members=5), FAST._replace(many=4)).last.score > 0


def test_what_is_done_is_not_done_again(tmp_path, monkeypatch):
    few = FAST._replace(methods=("likelihood", "noise-estimation"), sets=2)
    with ThreadPoolExecutor(1) as pool:
        first = runs.run_protocol(few, tmp_path, pool)
    assert len(first) == len(list(runs.jobs_of(few))) == 1 + 2 * 2 * 2
    monkeypatch.setattr(runs, "run_method", None)
    again = runs.run_protocol(few, tmp_path)
    assert json.dumps([one._asdict() for one in again]) == json.dumps([one._asdict() for one in first])
    name = runs.file_of(tmp_path, WALK, "likelihood", 1, few)
    assert name.is_file() and runs.file_of(tmp_path, WALK, "likelihood", 1, few._replace(runs=999)) != name
    made = tables(again, few)
    assert "noise-estimation" in made["what to use"]() and "`walk`" in made["groups A to D"]()


@pytest.mark.slow
def test_two_targets_have_full_blocks_of_q_which_noise_estimation_finds():
    case = next(case for case in CASES if case.name == "targets")._replace(runs=4)
    q = case.make().true["process_noise_cov"]
    blocks = np.array(q).reshape(2, 4, 2, 4)
    assert np.count_nonzero(blocks[0, :, 0]) == np.count_nonzero(blocks[1, :, 1]) == 16
    assert not blocks[0, :, 1].any() and np.linalg.eigvalsh(np.array(q))[0] > 0.0
    # Van Loan's integral of a velocity that wanders, by small steps.
    steps = np.linspace(0.0, 1.0, 2001)
    driven = steps, 1.0 + 0.0 * steps
    moved = np.array([[np.trapezoid(a * b, steps) for b in driven] for a in driven])
    np.testing.assert_allclose(blocks[0, :, 0], np.kron(moved, blocks[0, 2:, 0, 2:]), rtol=1e-6)
    methods = "noise-estimation", "start", "oracle"
    found, start, oracle = (runs.run_method(case, method, 0, FAST).last for method in methods)
    assert found.score < 1.01 * oracle.score < 0.9 * start.score


@pytest.mark.slow
def test_a_ring_is_tuned_by_its_inflation_alone():
    case = next(case for case in CASES if case.make is ring)._replace(make=lambda: ring(100), runs=2)
    starts = [runs.start_of(case, place) for place in range(3)]
    assert starts[0] == starts[1] == starts[2] and starts[0].numbers["ensemble_size"] == 20
    assert set(starts[0].model["measurement_noise_cov"]) == {1.0}
    found = runs.run_method(case, "anderson", 0, FAST)
    assert found.error == "" and 1.005 < found.choice["numbers"]["inflation"] < 1.05
    assert runs.run_method(case, "likelihood", 0, FAST).last is None


def test_the_command_prints_its_tables_and_the_pages_have_them(as_json, thruster, tmp_path):
    told = as_json("reproduce", "methods", "--quick", "--method", "likelihood", "--method", "start")
    assert (tmp_path / told["files"][0]).read_bytes().startswith(b"\x89PNG")
    pages = "".join((DOCS / name).read_text(encoding="utf-8") for name in ("methods.md", "appendix/methods.md"))
    assert all(f"<!-- table {name} -->" in pages for name in TABLES)
    assert {one["method"] for one in told["results"]} == {"likelihood", "start", "reference"}


with_okf = pytest.mark.skipif(
    not lidar.is_installed(), reason="the package Optimized-Kalman-Filter is not installed"
)


def test_targets_turn_and_are_seen_in_range_and_bearing():
    runs = lidar.drawn(300, seed=3)
    assert {len(one.states) for one in runs} <= set(range(1 + 4 * 5, 2 + 6 * 8))
    noise = []
    for states, seen in runs:
        velocity, moved = states[:-1, 2:], np.diff(states, axis=0)
        np.testing.assert_allclose(moved[:, :2], velocity + 0.5 * moved[:, 2:], atol=1e-9)
        ranges = np.hypot(*states[:, :2].T) - np.hypot(*seen.T)
        turned = np.arctan2(*seen.T[::-1]) - np.arctan2(*states[:, 1::-1].T)
        noise.append(np.column_stack([ranges, (turned + np.pi) % (2 * np.pi) - np.pi]))
    deviations = np.median(abs(np.concatenate(noise)), axis=0) / 0.6745
    np.testing.assert_allclose(deviations, [RANGE, BEARING], rtol=0.05)
    np.testing.assert_array_equal(lidar.drawn(5, seed=1)[4].states, lidar.drawn(5, seed=1)[4].states)


@pytest.mark.slow
@with_okf
def test_our_filter_is_the_packages():
    from okf import OKF as OptimizedFilter
    from okf import test_model as mean_loss
    from okf.example.simple_lidar_model import model_args

    runs = lidar.drawn(24)
    problem = lidar.lidar_problem(runs, 8)
    model = OptimizedFilter(**model_args(), optimize=True)
    states, seen = [one.states for one in runs], [one.measurements for one in runs]
    model.estimate_noise(states[:16], seen[:16])
    choice = with_covariances(untuned_choice("kf", problem), model.get_Q(), model.get_R())
    ours = lidar.row_of("", choice, 0.0, problem, problem.data(range(16, 24)))
    assert ours.mse == pytest.approx(mean_loss(model, seen[16:], states[16:]), rel=1e-9)


@with_okf
def test_the_package_begins_at_noise_estimation_and_leaves_it():
    q, r = lidar.okf_itself(lidar.drawn(40))
    for one in (q, r):
        assert (np.linalg.eigvalsh(one) > 0).all()


@pytest.mark.slow
def test_the_table_in_its_quick_form():
    rows = lidar.compared(24, 12, 1, methods={name: one for name, one in METHODS.items() if name != "EM"})
    names = [row.name for row in rows]
    assert names[0] == (OKF if lidar.is_installed() else NOISE) and len(set(names)) == len(names)
    found = {row.name: row for row in rows}
    assert found[GRADIENT].over(found[NOISE]).value < 1.05
    text = lidar.markdown(rows)
    assert text.count("\n") == len(rows) + 1 and (IN_A_FIFTH in text) == lidar.is_installed()
