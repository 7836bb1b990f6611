"""A bench on recorded logs: whole logs are drawn, blocks are counted, those held out by themselves."""

import numpy as np
import pytest

import tuning
from tests.tuning.test_identify_stamps import DT, recorded, smooth, stamps_of
from thruster_env.logs.read import read_log
from tuning.evaluation.evaluate import evaluate
from tuning.exploring.bench import Bench
from tuning.logs.problem import log_problem
from tuning.problems.find import find_problem
from tuning.problems.log_problem import LogProblem


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
def bench(logs):
    return Bench(log_problem(list(logs.values())))


def test_what_is_drawn_is_what_estimate_gives(bench, logs, tmp_path):
    file = tmp_path / "tuned.json"
    file.write_text(bench.tuned_file({"R": 1.0}))
    view = bench.view({"R": 1.0})
    assert view.estimate.shape == (2, 901, 2) and view.truth is None and view.nees is None
    for run, log in enumerate(logs.values()):
        found, rows = tuning.estimate(log, tuned=file), len(log["time"])
        assert view.estimate[run, :rows] == pytest.approx(found.means, rel=1e-9, abs=1e-9)
        assert view.deviation[run, :rows] == pytest.approx(found.stds, rel=1e-9)
        assert np.isnan(view.estimate[run, rows:]).all()


def test_figures_are_those_of_training_and_held_out_blocks(bench):
    problem, view = bench.problem, bench.view({"R": 1.0})
    filter_ = bench.choice({"R": 1.0}).filter(problem)
    for prefix, seeds in (("", problem.training_seeds(0, 1)), ("held-out ", problem.held_out_seeds(0, 1))):
        found = evaluate(filter_, problem.data(seeds), None)
        assert view.figures[f"{prefix}log-likelihood"].value == found.log_likelihood
        assert view.figures[f"{prefix}NIS"].value == found.nis.value
    assert not any(name.startswith("RMSE") for name in view.figures)


def test_a_map_and_a_study_minimise_the_negative_log_likelihood(bench):
    view, found = bench.view({"R": 250.0}), bench.map({}, "Q11", "R", 2)
    low = bench.knobs[0].low
    expected = -bench.view({"R": 250.0, "Q11": low}).figures["log-likelihood"].value
    assert found.score[1, 0] == pytest.approx(expected, rel=1e-12)
    first = next(iter(bench.study({"R": 250.0}, 1)))
    assert first.score == pytest.approx(-view.figures["log-likelihood"].value, rel=1e-12)


def test_a_log_with_truth_has_errors_and_log_scores():
    bench = Bench(log_problem(table(3, 700, truth=True)))
    view = bench.view()
    assert bench.has_truth and view.truth.shape == (1, 701, 2) and view.nees.shape == (1, 701)
    assert {"RMSE omega_m", "NEES", "log score", "held-out NEES", "held-out log score"} <= set(view.figures)


def test_a_log_has_no_disturbances(bench):
    assert not any(knob.group == "disturbances" for knob in bench.knobs)


def test_logs_on_their_own_stamps_are_drawn_over_these():
    stamps, model = [stamps_of(rows, rows) for rows in (130, 100)], smooth()
    logs = [read_log(recorded(one, 3), model, grid=False, dt=DT, name=f"{len(one)}") for one in stamps]
    view = Bench(LogProblem(logs, model)).view()
    for run, one in enumerate(stamps):
        measured = ~np.isnan(view.innovation[run, :, 0])
        assert view.time[run, measured] == pytest.approx(one, abs=1e-9)
        assert (np.diff(view.time[run]) >= 0).all()
