"""A bench shows what evaluations and studies compute, of scenarios, disturbances and logs; its scenes are so."""

import json
import pickle

import numpy as np
import pytest
from optuna.trial import TrialState

import tuning
from filters.consistency.nees import check_whitened, whitened
from filters.registry import make_filter
from tests.filters.checks import refused
from tests.tuning.test_identify_stamps import DT, recorded, smooth, stamps_of
from thruster_env.logs.read import read_log
from tuning.evaluation.evaluate import check_consistency, evaluate
from tuning.evaluation.tuned import read_tuned
from tuning.exploring.bench import OWN, SCENES, Bench
from tuning.exploring.view import disturbances_of, disturbed
from tuning.logs.problem import log_problem
from tuning.problems.find import find_problem
from tuning.problems.log_problem import LogProblem
from tuning.problems.scenario import plain
from tuning.search.plan import Plan
from tuning.search.storage import quiet_optuna
from tuning.search.study import open_study, run_study


@pytest.fixture(scope="module")
def bench():
    return Bench(find_problem("outliers"))


def figure(view, name):
    return next(one.value for known, one in view.figures.items() if known.startswith(name))


def test_figures_are_those_of_evaluate_on_the_same_seeds(bench):
    found = tuning.evaluate("ekf", "outliers", seeds=5).evaluation
    view = bench.on_held_out().view(seeds=5)
    assert figure(view, "score") == found.score.value
    assert [figure(view, f"RMSE {one.symbol}") for one in bench.states] == [one.value for one in found.rmse]
    names = {"NEES": found.nees.value, "NIS": found.nis.value, "log-likelihood": found.log_likelihood}
    names |= {"log score": found.log_score.value, "restarts": found.divergences}
    assert {name: figure(view, name) for name in names} == names


def test_series_are_those_of_the_filter_on_the_training_seeds(bench):
    problem, values = bench.problem, {**OWN, "correlation_12": 0.5, "P0": 2.0}
    data, view = problem.data(problem.training_seeds(0, 3)), bench.view(values, 3)
    cov = np.array([[1.0, 0.5 * 0.02], [0.5 * 0.02, 4e-4]])
    noise = {"process_noise_cov": cov, "measurement_noise_cov": 0.25}
    filter_ = make_filter("ekf", problem.model(**noise, prior_cov_factor=2.0))
    belief = filter_.init()
    for k in range(60):
        belief, innovation = filter_.update(belief, data.measurements[1, k])
        assert view.estimate[1, k] == pytest.approx(belief.mean, rel=1e-9, abs=1e-9)
        assert view.deviation[1, k] == pytest.approx(np.sqrt(np.diag(belief.cov)), rel=1e-9)
        assert view.innovation[1, k] == pytest.approx(innovation.value, rel=1e-9, abs=1e-9)
        belief = filter_.predict(belief, data.inputs[1, k])
    assert np.array_equal(view.truth, data.states)
    assert view.time[0] == pytest.approx(0.01 * np.arange(501))


def test_consistency_over_time_is_that_of_the_report(bench):
    view, problem = bench.view(OWN, 6), bench.problem
    data = problem.data(problem.training_seeds(0, 6))
    report = check_consistency(bench.choice(OWN).filter(problem), data)
    for squares, band, check in ((view.nees, view.nees_band, report.nees), (view.nis, view.nis_band, report.nis)):
        assert np.isnan(squares[:, :50]).all()
        assert squares[:, 50:].mean(axis=0) == pytest.approx(check.step_means, rel=1e-9)
        assert np.array_equal(np.transpose(band)[50:], check.band)
    assert np.array_equal(view.autocorrelation[0], report.whiteness.correlations[:, 0, 0])
    assert view.autocorrelation_band == report.whiteness.half_widths.max()


def test_a_band_counts_the_measurements_that_there_are():
    view = Bench(find_problem("dropout")).view(seeds=4)
    low, high = view.nis_band
    there = (~np.isnan(view.innovation[..., 0])).sum(axis=0)[50:]
    assert np.array_equal(np.isnan(high[50:]), there == 0)
    errors, covs = np.ones((1, 1, 1)), np.ones((1, 1, 1, 1))
    for end, one in zip((low, high), check_whitened("NIS", whitened(errors, covs)).band[0], strict=True):
        assert end[50:][there == 1] == pytest.approx(one)


def test_a_map_has_what_views_have(bench):
    found = bench.map(OWN, "Q22", "R", 3)
    assert found.score.shape == found.nis.shape == (3, 3)
    for row, column in ((0, 0), (2, 1), (1, 2)):
        view = bench.view({**OWN, "Q22": found.xs[column], "R": found.ys[row]})
        assert found.score[row, column] == pytest.approx(figure(view, "score"), rel=1e-12)
        assert found.nis[row, column] == pytest.approx(figure(view, "NIS"), rel=1e-12)


def test_a_map_of_whole_numbers_and_one_of_a_disturbance():
    bench = Bench(find_problem("nominal"), "enkf")
    assert bench.map(OWN, "N", "outliers", 4, seeds=2).xs.tolist() == [5.0, 17.0, 58.0, 200.0]
    of_two = bench.map({**OWN, "N": 5}, "outliers", "inflation", 2, seeds=2)
    other = figure(bench.view({**OWN, "N": 5, "outliers": 0.5, "inflation": 1.3}, 2), "score")
    assert of_two.score[1, 1] == pytest.approx(other, rel=1e-12)


def test_knobs_mark_the_baselines_within_their_ranges(bench):
    knobs = {knob.name: knob for knob in bench.knobs}
    assert {"rule of thumb", "scaled default", "oracle"} == set(knobs["Q11"].marks)
    assert knobs["Q11"].marks["oracle"] == 1.0 and knobs["R"].unit == "N^2"
    assert all(knob.low <= value <= knob.high for knob in bench.knobs for value in knob.marks.values())
    assert all(knobs[name].checked(value) == value for name, value in bench.start.items())
    choice = bench.choice({"Q11": 6000.0})
    tuned = Bench(bench.problem, "ekf", choice._replace(model={**choice.model, "measurement_noise_cov": 1e4}))
    assert tuned.start["R"] == 1e4 == {knob.name: knob for knob in tuned.knobs}["R"].marks["tuned"]
    assert tuned.with_filter("ukf").start["R"] == 0.25


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"Q11": float("nan")}, "Q11 must be a finite number, but got nan"),
        ({"R": float("inf")}, "R must be a finite number, but got inf"),
        ({"R": -1.0}, "R must be from 0.0025 to 250 N"),
        ({"R": "a"}, "R must be a finite number, but got 'a'"),
        ({"S": 1.0}, "a knob must be one of Q11, Q22"),
    ],
)
def test_a_value_that_a_knob_cannot_have_is_refused_in_one_line(bench, values, message):
    refused(message.replace("(", r"\("), bench.view, values)


def test_other_arguments_are_refused():
    bench = Bench(find_problem("nominal"), "enkf")
    for call, rule in (
        (lambda: bench.view({"N": 7.5}), "N must be a whole number"),
        (lambda: bench.view(seeds=0), "seeds must be a whole number of at least 1"),
        (lambda: bench.map({}, "R", "R"), "x and y must be different"),
        (lambda: bench.map({}, "R", "S"), "y must be one of"),
        (lambda: bench.map({}, "R", "N", 1000), "size must be at most 128"),
        (lambda: bench.with_filter("nought"), "filter must be one of"),
        (lambda: Bench(find_problem("nominal"), "open-loop"), "has a number to change"),
    ):
        refused(rule, call)


def test_a_study_is_that_of_tune_and_stops_where_it_is_closed(bench):
    quiet_optuna()
    trials = list(bench.study(OWN, 6))
    plan = bench.plan(OWN)
    study = open_study("again", plan, None, bench.choice(OWN))
    run_study(study, plan, 6)
    assert [trial.values for trial in trials] == [one.params for one in study.trials]
    assert trials[0].values == OWN
    complete = [one.values[0] for one in study.trials if one.state == TrialState.COMPLETE]
    assert [trial.score for trial in trials if not trial.pruned] == complete
    knobs = {knob.name: knob for knob in bench.knobs}
    assert all(knobs[name].checked(value) for trial in trials for name, value in trial.values.items())
    running = bench.study({}, 10**6)
    assert next(running).values == {name: bench.start[name] for name in OWN}
    running.close()


def test_a_study_minimises_what_it_says(bench):
    first = next(iter(bench.study(OWN, 1)))
    problem = bench.problem
    data = problem.data(problem.training_seeds(0, 32))
    assert first.score == evaluate(bench.choice(OWN).filter(problem), data, problem.scale).score.value
    assert isinstance(bench.plan(), Plan) and not bench.plan().full_q
    assert bench.plan({"correlation_12": 0.2}).full_q


def test_the_tuned_file_has_what_is_seen(bench, tmp_path):
    values = {**OWN, "R": 5.5, "outliers": 0.1}
    file = tmp_path / "tuned.json"
    file.write_text(bench.tuned_file(values))
    choice, problem, seed = read_tuned(file)
    assert (choice.name, seed) == ("ekf", 0)
    assert choice.model == {"process_noise_cov": (1.0, 4e-4), "measurement_noise_cov": 5.5}
    assert problem.digest == bench.problem_at(values).digest != bench.problem.digest
    stored = json.loads(file.read_text())
    assert stored["study"]["method"] == "by hand"
    held_out = tuning.evaluate(file, seeds=4).evaluation
    assert held_out.score.value == figure(bench.on_held_out().view(values, 4), "score")


def test_python_lines_make_the_same_filter(bench):
    values = {**OWN, "correlation_12": 0.3, "dropout": 0.2, "dead_band": 1.0}
    names = {}
    exec(compile(bench.python_lines(values), "lines", "exec"), names)
    assert names["problem"].digest == bench.problem_at(values).digest
    data = names["problem"].data(range(2))
    both = bench.choice(values).filter(bench.problem), names["filter_"]
    ours, theirs = (evaluate(one, data, bench.problem.scale).score.value for one in both)
    assert ours == theirs
    assert bench.command(values) == "thruster evaluate tuned.json"


def test_a_bench_can_be_pickled(bench):
    again = pickle.loads(pickle.dumps(bench))
    assert figure(again.view(OWN, 2), "score") == figure(bench.view(OWN, 2), "score")


def test_an_ekf_halves_the_rule_of_thumbs_error_on_outliers_within_the_knobs(bench):
    rule = figure(bench.view(), "score")
    by_r_alone = bench.map({}, "Q11", "R", 8, seeds=4).score
    assert by_r_alone.min() < 0.5 * rule
    assert figure(bench.view({"R": 5.5}), "score") < 0.5 * rule
    both = bench.view({**OWN, "R": 5.5})
    assert figure(both, "score") < 0.16 * rule and 0.8 < figure(both, "NIS") < 1.25


SEEDS = range(3)


def values_of(problem):
    return {one.name: value for one, value in disturbances_of(problem).items()}


def test_those_of_a_scenario_are_its_own():
    assert values_of(find_problem("outliers"))["outliers"] == 0.05
    assert values_of(find_problem("outliers"))["outlier_size"] == 20.0  # 10 N of 0.5 N
    assert values_of(find_problem("bias"))["bias"] == 3.0
    assert values_of(find_problem("deadband"))["dead_band"] == 1.0
    assert set(values_of(find_problem("nominal")).values()) == {0.0, 20.0}
    assert "dead_band" not in values_of(find_problem("auv:motion"))


@pytest.mark.parametrize("name", ["outliers", "bias", "deadband", "mixed", "auv:motion"])
def test_unchanged_ones_leave_the_problem_as_it_is(name):
    problem = find_problem(name)
    assert disturbed(problem, values_of(problem)) is problem


def test_disturbances_make_a_scenario_of_the_nominal_one_and_that_of_it():
    nominal, calm = find_problem("nominal"), disturbed(find_problem("outliers"), {"outliers": 0.0})
    assert np.array_equal(calm.data(SEEDS).measurements, nominal.data(SEEDS).measurements)
    nominal = find_problem("nominal")
    made = disturbed(nominal, {"outliers": 0.05, "outlier_size": 20.0})
    assert made.name == "nominal (changed)"
    assert plain(made.sensors) == plain(find_problem("outliers").sensors)
    wider = disturbed(nominal, {"dead_band": 1.0})
    assert plain(wider.amplifier) == plain(find_problem("deadband").amplifier)


def test_other_arguments_of_an_effect_stay_and_sizes_are_of_each_channels_noise():
    problem = disturbed(find_problem("mixed"), {"outliers": 0.1, "outlier_size": 40.0})
    outliers, dropout = plain(problem.sensors)["thrust"]
    assert outliers == {"name": "outliers", "std": 20.0, "probability": 0.1}
    assert dropout == {"name": "dropout", "probability": 0.1, "mean_length": 5}
    problem = disturbed(find_problem("auv:motion"), {"bias": 2.0})
    found = {channel: chain[0]["std"] for channel, chain in plain(problem.sensors).items()}
    assert found["u"] == pytest.approx(0.04) and found["phi"] == pytest.approx(0.01)


def test_a_bench_shows_the_redrawn_data():
    bench = Bench(find_problem("nominal"))
    assert np.isnan(bench.view({"dropout": 0.5}, 2).innovation).mean() == pytest.approx(0.5, abs=0.15)
    assert np.array_equal(bench.view({"outliers": 0.3}, 2).truth, bench.view(seeds=2).truth)
    assert not np.array_equal(bench.view({"dead_band": 2.0}, 2).truth, bench.view(seeds=2).truth)


every_scene = pytest.mark.parametrize("scene", SCENES.values(), ids=SCENES)


@every_scene
def test_one_sees_what_a_scene_says(scene):
    before, after = scene.view(0), scene.view(len(scene.steps) - 1)
    for one in scene.seen:
        ratio = after.figures[one.figure].value / before.figures[one.figure].value
        assert one.low <= ratio <= one.high, one.figure


@every_scene
def test_a_scene_moves_knobs_that_there_are(scene):
    knobs = {knob.name for knob in scene.bench().knobs}
    assert set(scene.knobs) <= knobs
    assert scene.state in {state.symbol for state in scene.bench().states}
    first, last = scene.steps[0], scene.steps[-1]
    moved = {name for name in last.values if last.values[name] != first.values.get(name)}
    assert moved <= set(scene.knobs)


def test_there_are_six_scenes_and_along_the_ridge_every_estimate_stays():
    assert list(SCENES) == ["ridge", "lag", "outliers", "tangent", "ensemble", "constant"]
    before, after = (SCENES["ridge"].view(step) for step in (0, 1))
    assert after.estimate[:, 200:] == pytest.approx(before.estimate[:, 200:], rel=0.05, abs=0.2)
    assert after.deviation[:, 200:] == pytest.approx(30**0.5 * before.deviation[:, 200:], rel=0.1)


def test_a_lag_shows_in_the_autocorrelation():
    before, after = (SCENES["lag"].view(step) for step in (0, 1))
    assert before.autocorrelation[0, 0] > 0.5 > 0.1 > abs(after.autocorrelation[0, 0])


def test_a_robust_filter_does_better_than_any_r():
    problem = find_problem("outliers")
    lowest = Bench(problem).map(OWN, "Q22", "R", 12).score.min()
    robust = Bench(problem, "ekf-robust").view(OWN)
    assert robust.figures["score: mean RMSE over bound"].value < 0.95 * lowest


def test_no_q_makes_up_for_a_wrong_constant():
    wrong, right = Bench(find_problem("mismatch")), Bench(find_problem("nominal"))
    lowest = wrong.map(OWN, "Q11", "Q22", 10, seeds=4).score.min()
    assert lowest > 2.5 * right.map(OWN, "Q11", "Q22", 10, seeds=4).score.min()
    errors = SCENES["constant"].view(0)
    off = (errors.estimate - errors.truth)[..., 0]
    fast = abs(errors.truth[..., 0]) > 100.0
    assert (abs(errors.estimate[..., 0]) < abs(errors.truth[..., 0]))[fast].mean() > 0.95  # too slow, either way
    assert abs(off[fast]).mean() > 5.0


def table(seed, steps, *, truth=False):
    data = find_problem("nominal").replace(steps=steps).data([seed])
    columns = {"time": 0.01 * np.arange(steps + 1), "voltage": np.append(data.inputs[0, :, 0], 0.0)}
    columns["thrust"] = data.measurements[0, :, 0]
    if truth:
        columns |= dict(zip(("omega_m", "U_a"), data.states[0].T, strict=True))
    return columns


@pytest.fixture(scope="module")
def logs():
    return {"first": table(1, 900), "second": table(2, 600)}


@pytest.fixture(scope="module")
def of_logs(logs):
    return Bench(log_problem(list(logs.values())))


def test_what_is_drawn_is_what_estimate_gives(of_logs, logs, tmp_path):
    file = tmp_path / "tuned.json"
    file.write_text(of_logs.tuned_file({"R": 1.0}))
    view = of_logs.view({"R": 1.0})
    assert view.estimate.shape == (2, 901, 2) and view.truth is None and view.nees is None
    for run, log in enumerate(logs.values()):
        found, rows = tuning.estimate(log, tuned=file), len(log["time"])
        assert view.estimate[run, :rows] == pytest.approx(found.means, rel=1e-9, abs=1e-9)
        assert view.deviation[run, :rows] == pytest.approx(found.stds, rel=1e-9)
        assert np.isnan(view.estimate[run, rows:]).all()


def test_figures_are_those_of_training_and_held_out_blocks(of_logs):
    problem, view = of_logs.problem, of_logs.view({"R": 1.0})
    filter_ = of_logs.choice({"R": 1.0}).filter(problem)
    for prefix, seeds in (("", problem.training_seeds(0, 1)), ("held-out ", problem.held_out_seeds(0, 1))):
        found = evaluate(filter_, problem.data(seeds), None)
        assert view.figures[f"{prefix}log-likelihood"].value == found.log_likelihood
        assert view.figures[f"{prefix}NIS"].value == found.nis.value
    assert not any(name.startswith("RMSE") for name in view.figures)


def test_a_map_and_a_study_of_logs_minimise_the_negative_log_likelihood(of_logs):
    view, found = of_logs.view({"R": 250.0}), of_logs.map({}, "Q11", "R", 2)
    low = of_logs.knobs[0].low
    expected = -of_logs.view({"R": 250.0, "Q11": low}).figures["log-likelihood"].value
    assert found.score[1, 0] == pytest.approx(expected, rel=1e-12)
    first = next(iter(of_logs.study({"R": 250.0}, 1)))
    assert first.score == pytest.approx(-view.figures["log-likelihood"].value, rel=1e-12)
    assert not any(knob.group == "disturbances" for knob in of_logs.knobs)


def test_a_log_with_truth_has_errors_and_log_scores():
    of_logs = Bench(log_problem(table(3, 700, truth=True)))
    view = of_logs.view()
    assert of_logs.has_truth and view.truth.shape == (1, 701, 2) and view.nees.shape == (1, 701)
    assert {"RMSE omega_m", "NEES", "log score", "held-out NEES", "held-out log score"} <= set(view.figures)


def test_logs_on_their_own_stamps_are_drawn_over_these():
    stamps, model = [stamps_of(rows, rows) for rows in (130, 100)], smooth()
    logs = [read_log(recorded(one, 3), model, grid=False, dt=DT, name=f"{len(one)}") for one in stamps]
    view = Bench(LogProblem(logs, model)).view()
    for run, one in enumerate(stamps):
        measured = ~np.isnan(view.innovation[run, :, 0])
        assert view.time[run, measured] == pytest.approx(one, abs=1e-9)
        assert (np.diff(view.time[run]) >= 0).all()
