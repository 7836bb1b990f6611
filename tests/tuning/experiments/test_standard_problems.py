"""Lorenz-63, Lorenz-96, range and bearing, the pendulum: models against solve_ivp, published scores."""

import json
import math
import re
from pathlib import Path

import gymnasium as gym
import numpy as np
import optuna
import pytest
from scipy.integrate import solve_ivp

from filters import EstimateState, make_filter, run
from tests.filters.checks import refused
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import write_tuned
from tuning.experiments import benchmark, lorenz63, lorenz96, pendulum, range_bearing
from tuning.experiments.benchmark import BENCHMARKS, Published
from tuning.problems.check import checked_problem
from tuning.problems.data import held_out_seeds
from tuning.problems.find import find_problem
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice
from tuning.search.study import open_study, run_study


def lorenz_63(t, x):
    return [10.0 * (x[1] - x[0]), x[0] * (28.0 - x[2]) - x[1], x[0] * x[1] - 8.0 / 3.0 * x[2]]


def lorenz_96(t, x):
    return (np.roll(x, -1) - np.roll(x, 2)) * np.roll(x, 1) - x + 8.0


def moved(model, x):
    for _ in range(model.substeps):
        x = model.transition(x, (), model.constants)
    return np.array(x)


MODELS = {  # rates, a state, length of a step, accuracy of Runge-Kutta's steps
    "lorenz63": (lorenz63.model, lorenz_63, (1.5, -1.5, 25.5), 0.25, 1e-4),
    "lorenz96": (lorenz96.model, lorenz_96, 4.0 * np.sin(np.arange(40.0) ** 2), 0.05, 2e-4),
}


@pytest.mark.parametrize(("model", "rates", "x", "dt", "tolerance"), MODELS.values(), ids=MODELS)
class TestModels:
    def test_a_step_is_the_solution_of_the_equations(self, model, rates, x, dt, tolerance):
        solution = solve_ivp(rates, (0.0, dt), x, rtol=1e-11, atol=1e-11).y[:, -1]
        assert np.abs(moved(model(), x) - solution).max() < tolerance * np.abs(solution).max()
        assert np.abs(solution - x).max() > 100 * tolerance * np.abs(solution).max()

    def test_the_jacobian_is_that_of_a_part_of_the_step_and_grows_with_inflation(
        self, model, rates, x, dt, tolerance
    ):
        plain, grown = model(), model(inflation=7.0)
        x, eps, count = np.array(x), 1e-6, len(x)
        columns = []
        for i in range(count):
            ends = [plain.transition(x + s * eps * np.eye(count)[i], (), plain.constants) for s in (1, -1)]
            columns.append((np.array(ends[0]) - np.array(ends[1])) / (2 * eps))
        found = np.array(plain.transition_jacobian(x, (), plain.constants))
        np.testing.assert_allclose(found, np.transpose(columns), atol=1e-7)
        more = np.array(grown.transition_jacobian(x, (), grown.constants))
        np.testing.assert_allclose(more, 7.0 ** (dt / plain.substeps / 2) * found, rtol=1e-12)


def test_the_score_is_the_mean_over_time_of_roots_over_states():
    errors = np.array([[[3.0, 4.0], [0.0, 0.0]], [[1.0, 1.0], [-1.0, 1.0]]])
    np.testing.assert_allclose(benchmark.mean_of_roots(errors), [math.sqrt(12.5) / 2, 1.0])


# Mean and standard deviation over runs of 1000 analyses, from 16 runs each by `thruster reproduce`: the band is
# three standard errors of four runs about what is published.
QUICK = {
    "lorenz63": (lorenz63, Published("enkf", {"ensemble_size": 100, "inflation": 1.01}, 0.56), 0.02),
    "lorenz63, rotations": (
        lorenz63,
        Published("etkf", {"ensemble_size": 10, "inflation": 1.02, "rotations": 1}, 0.60),
        0.06,
    ),
    "lorenz63, regularised particles": (lorenz63, Published("pf", lorenz63.particles(800, 0.9, 0.2), 0.28), 0.018),
    "lorenz96": (lorenz96, Published("enkf", {"ensemble_size": 40, "inflation": 1.06}, 0.22), 0.008),
    "lorenz96, finite size": (
        lorenz96,
        Published("enkf-n", {"ensemble_size": 24, "rotations": 1, "certainty": 2.0}, 0.18),
        0.01,
    ),
}


@pytest.mark.parametrize(
    ("study", "published", "deviation"),
    [
        pytest.param(*one, id=name, marks=[] if name == "lorenz63" else pytest.mark.slow)
        for name, one in QUICK.items()
    ],
)
def test_a_published_score_comes_out(study, published, deviation):
    (row,) = benchmark.against_published(study.problem, study.model, [published])(range(4), lambda row: None)
    assert abs(row.ours.value - published.value) < 3 * deviation / 2 and row.divergences == 0
    assert row.pooled > row.ours.value


@pytest.mark.slow
def test_inflation_that_adapts_keeps_a_small_ensemble_on_the_ring_which_is_lost_without():
    numbers = {"ensemble_size": 24, "rotations": 1}
    rows = [Published("etkf", numbers | {"adaptive_inflation": number}, 0.18) for number in (0.0, 0.1)]
    lost, kept = benchmark.against_published(lorenz96.problem, lorenz96.model, rows)(range(4), lambda row: None)
    assert kept.ours.value < 0.2 < 1.0 < lost.ours.value


def row_of_page(table, first_cells):
    """The numbers of a row of a table of docs/benchmarks.md, or of one that no script computes."""
    page = (Path(__file__).parents[3] / "docs" / "benchmarks.md").read_text()
    part = page.partition(f"<!-- table {table} -->")[2].partition("<!-- end -->")[0] or page
    (line,) = [line for line in part.splitlines() if line.startswith(f"| {first_cells} |")]
    return [[float(one) for one in re.findall(r"\d+\.\d+", cell)] for cell in line.split("|")[1:-1]]


# A cheap row of each table. States are chaotic, so that rounding of another machine moves single runs.
DENSE = lorenz63.problem, lorenz63.model, lorenz63.BENCHMARK.published
SPARSE = lorenz63.sparse, lorenz63.sparse_model, lorenz63.SPARSE.published
OF_PAGE = {
    "lorenz63": (DENSE, "etkf, N = 3, inflation 1.3"),
    "lorenz63, particles": (DENSE, "pf, N = 100, regularisation 2.48, threshold 0.3"),
    "lorenz63_sparse": (SPARSE, "ensrf, N = 20, inflation 1.01, rotations"),
    "lorenz96": (
        (lorenz96.problem, lorenz96.model, lorenz96.BENCHMARK.published),
        "letkf, N = 7, radius 4, inflation 1.04, rotations",
    ),
}


@pytest.mark.parametrize(
    ("name", "study", "label"),
    [
        pytest.param(name, *one, id=name, marks=[] if name == "lorenz63" else pytest.mark.slow)
        for name, one in OF_PAGE.items()
    ],
)
def test_a_row_of_the_page_is_recomputed(name, study, label):
    problem, model, rows = study
    (published,) = [one for one in rows if one.label == label]
    (row,) = benchmark.against_published(problem, model, [published])(range(benchmark.RUNS), lambda row: None)
    _, theirs, ours, _, median, *_ = row_of_page(name.partition(",")[0], label)
    half = (ours[2] - ours[1]) / 2
    assert theirs == [published.value] and abs(row.ours.value - ours[0]) < half
    assert abs(row.run_median - median[0]) < half


@pytest.mark.slow
def test_a_row_on_the_pendulum_and_on_range_and_bearing_is_recomputed():
    rule = evaluate_held_out(untuned_choice("ekf", pendulum.problem), pendulum.problem, 0).untuned
    _, _, _, theta, omega, nees, nis = row_of_page("pendulum", "ekf | rule of thumb")
    found = [*(part.value for part in rule.rmse), rule.nees.value, rule.nis.value]
    np.testing.assert_allclose(found, [theta[0], omega[0], nees[0], nis[0]], atol=0.006)
    data = range_bearing.problem.data(range(benchmark.RUNS))
    ekf = make_filter("ekf", range_bearing.model(range_bearing.SIGMA.start))
    means = run(ekf, data.filter_keys, data.inputs, data.measurements).means
    ours = np.sqrt(range_bearing._squares(means, data).mean())
    assert ours == pytest.approx(row_of_page("range_bearing", "ekf, untuned, sigma_a 2")[2][0], abs=6e-4)


@pytest.mark.slow
def test_the_inflation_that_a_study_found_has_its_score():
    cells = row_of_page("inflation", "etkf | 10")
    numbers = {"ensemble_size": 10, "inflation": cells[2][0], "relaxation": cells[3][0]}
    seeds, rows = held_out_seeds(0, benchmark.RUNS), [Published("etkf", numbers, 0.6)]
    (row,) = benchmark.against_published(lorenz63.problem, lorenz63.model, rows)(seeds, lambda row: None)
    assert abs(row.ours.value - cells[4][0]) < cells[4][2] - cells[4][1]  # a chaotic state


def small(why=""):
    settings = {"steps": 30, "first_scored_step": 5, "scale": [1.0] * 3}
    rows = [Published("ekf", {}, 0.92, {"inflation": 180.0}), Published("ekf", {}, 5.0, why=why)]
    problem = benchmark.noise_free_problem(lorenz63.model(), **settings)
    return lorenz63.BENCHMARK._replace(rows=benchmark.against_published(problem, lorenz63.model, rows))


@pytest.mark.usefixtures("as_python")
class TestReproduce:
    def test_the_command_shows_published_scores_and_why_ours_differ(self, thruster, monkeypatch):
        monkeypatch.setattr("tuning.experiments.benchmark.find_benchmark", lambda name: small("unlike"))
        done = thruster("reproduce", "lorenz63", "--runs", 2, "--json", "-")
        assert done.returncode == 0, done.stderr
        found = json.loads(done.stdout)
        assert found["settings"] == {"runs": 2, "seed": 0} and found["score"] == "rmse.a"
        first, second = found["rows"]
        assert first["label"] == "ekf, inflation 180" and second["why"] == "unlike"
        assert first["ratio"] == pytest.approx(first["ours"][0] / 0.92)
        done = thruster("reproduce", "lorenz63", "--runs", 2)
        assert {"unlike", "ekf,", "180"} <= set(done.stdout.split())  # a narrow terminal parts label and number

    def test_an_unexplained_difference_is_said_to_be_one(self):
        _, row = small().reproduce(2)
        far = row._replace(theirs=row.ours.value + 5.0, run_std=1.0)
        assert far.why == "no reason known to us"
        assert row._replace(theirs=1.04 * row.ours.value).why == "agrees within 5 %"
        near = row._replace(theirs=row.ours.value + 1.9, run_std=1.0)
        assert near.why == "within the scatter of a single run"
        alike = near._replace(run_median=1.01 * near.theirs)
        assert alike.why.startswith("the median run agrees within 5 %")

    def test_a_package_that_is_not_installed_is_asked_for_before_anything_is_compiled(self, monkeypatch):
        monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
        monkeypatch.setattr(range_bearing, "problem", None)  # whose data would be drawn first
        refused("Stone Soup must be installed", range_bearing.BENCHMARK.reproduce, 2)

    def test_range_and_bearing_give_what_stone_soup_gives(self, monkeypatch):
        pytest.importorskip("stonesoup")
        options = {"steps": 30, "first_scored_step": 5, "scale": [1.0] * 4, "dt": range_bearing.DT}
        short = benchmark.ModelProblem(range_bearing.model(), **options)
        monkeypatch.setattr(range_bearing, "problem", short)
        monkeypatch.setattr(range_bearing, "tuned_sigma", lambda: 0.2)
        rows = range_bearing.BENCHMARK.reproduce(2)
        assert [row.ratio for row in rows] == pytest.approx([1.0] * 4, abs=1e-4)
        assert rows[2].ours.value < 0.9 * rows[0].ours.value


def test_every_benchmark_is_found_and_its_problem_is_one():
    for name, path in BENCHMARKS.items():
        assert benchmark.find_benchmark(name).name == name
        problem = f"{path.partition(':')[0]}:{'sparse' if 'sparse' in name else 'problem'}"
        assert find_problem(problem).name == problem
    for other in ("faded", "jittered"):
        (parameter,) = find_problem(f"tuning.experiments.lorenz63:{other}").parameters
        assert parameter.name in ("inflation", "jitter")
    refused("benchmark must be one of lorenz63", benchmark.find_benchmark, "lorenz84")


@pytest.mark.slow
def test_a_study_finds_the_acceleration_of_a_target():
    assert 0.1 < range_bearing.tuned_sigma(trials=8) < 0.4  # 0.2 is true, and 2 the guess that it starts from


@pytest.mark.slow
def test_a_study_tunes_inflation_and_nothing_else():
    short = benchmark.noise_free_problem(lorenz63.model(), steps=40, first_scored_step=10, scale=[1.0] * 3)
    choice = benchmark.run_in_memory(Plan("etkf", (short,), hold_r=True), 3).choice
    errors, _ = benchmark.analysis_errors(choice.filter(short), short.data(short.held_out_seeds(0, 4)))
    assert set(choice.numbers) == {"ensemble_size", "inflation", "relaxation"} and 1 <= choice.numbers["inflation"]
    assert choice.model["process_noise_cov"] == (0.0, 0.0, 0.0)
    assert 0.2 < benchmark.mean_of_roots(errors).mean() < 1.5


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_the_pendulum_goes_from_a_file_to_a_filter_around_the_env(tmp_path, thruster):
    plan = Plan("ekf", (checked_problem(find_problem("tuning.experiments.pendulum:problem")),))
    result = run_study(open_study("pendulum", plan, optuna.storages.InMemoryStorage()), plan, 4)
    path, comparison = tmp_path / "pendulum.json", evaluate_held_out(result.choice, plan.scenarios[0], 0, 4)
    assert comparison.tuned.score.value < comparison.untuned.score.value
    write_tuned(path, plan, result, [comparison], "pendulum")
    done = thruster("report", path, "--problem", "tuning.experiments.pendulum:problem")
    assert done.returncode == 0, done.stderr
    env = EstimateState(gym.make("Pendulum-v1"), tuned=path, model=pendulum.model())
    env.reset(seed=3)
    for _ in range(50):
        info = env.step(np.array([1.0], dtype=np.float32))[-1]
    wrong = np.array(info["estimate"]) - env.unwrapped.state
    assert abs(np.angle(np.exp(1j * wrong[0]))) < 0.2 and abs(wrong[1]) < 0.5
