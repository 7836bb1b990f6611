"""Training of estimators with a network: loss, variants of runs, the loop, and the command."""

import json

import numpy as np
import pytest
import torch

import tuning
from filters.engine.batch import run
from filters.estimators.foreign import ForeignFilter
from filters.learned.estimator import Track, unit_scales
from filters.learned.filters import LEARNED, read
from tests.filters.checks import refused
from tests.models import plane_model
from tuning import learning
from tuning.evaluation.evaluate import values_of
from tuning.learning import HELD_OUT, LONGER, NOISIER, Loss, Settings
from tuning.plants.thruster import find_scenario
from tuning.problems.check import data_of
from tuning.problems.model_problem import ModelProblem

MODEL = plane_model()


def pushes(seeds, steps):
    """Inputs (B, K, 1) of each seed; the first ones of longer runs are those of shorter ones."""
    return np.array([np.random.default_rng(seed).normal(size=(steps, 1)) for seed in seeds])


PROBLEM = ModelProblem(MODEL, inputs=pushes, steps=40, first_scored_step=5, scale=[1.0, 2.0], name="plane")
SETTINGS = Settings(steps=6, batch=8, window=10, rate=5e-3, checks=3)


@pytest.fixture(scope="module")
def runs():
    """The starting filter, training and validation runs of the plane."""
    data = data_of(PROBLEM, PROBLEM.training_seeds(0, 16))
    return learning.starting_filter(PROBLEM, data, 0)[1], data, data_of(PROBLEM, PROBLEM.validation_seeds(0, 10))


def test_the_loss_is_the_weighted_square_or_the_log_density_of_the_states_that_count():
    mean, truth = np.array([[1.0, 2.0], [3.0, 5.0]]), np.array([[0.5, 1.0], [9.0, np.nan]])
    cov = np.array([[[2.0, 0.5], [0.5, 1.0]]] * 2)
    track = Track(*map(torch.tensor, (mean, cov)), None, None, ())
    given = track, torch.tensor(truth), torch.tensor([True, False])
    scales = unit_scales(MODEL)._replace(error=np.array([0.5, 0.25]))
    found = Loss(LEARNED["kalmannet"](MODEL, scales), [1.0, 2.0])(*given).item()
    assert found == pytest.approx((0.25 / 0.5 + 1.0 / (2.0 * 0.25)) / 2)
    e = (mean - truth)[0]
    density = 0.5 * e @ np.linalg.solve(cov[0], e) + 0.5 * np.log(np.linalg.det(2.0 * np.pi * cov[0]))
    assert Loss(LEARNED["recursive-kalmannet"](MODEL, scales), [1.0, 2.0])(*given).item() == pytest.approx(density)
    indefinite = track._replace(cov=-track.cov)
    assert np.isnan(Loss(LEARNED["recursive-kalmannet"](MODEL, scales), [1.0, 2.0])(indefinite, *given[1:]).item())
    alone = Loss(LEARNED["recursive-kalmannet"](MODEL, scales), [np.inf, 2.0])(*given).item()
    assert alone == pytest.approx(0.5 * e[1] ** 2 / 1.0 + 0.5 * np.log(2.0 * np.pi))


def test_scales_are_sizes_of_the_filter_s_quantities_and_the_gain_is_its_mean_one(runs):
    filter_, data, _ = runs
    found = learning.scales_of(filter_, data)
    estimates = run(filter_, data.filter_keys, data.inputs, data.measurements)
    np.testing.assert_allclose(found.error, np.sqrt(((estimates.means - data.states) ** 2).mean(axis=(0, 1))))
    np.testing.assert_allclose(found.innovation, np.sqrt((estimates.innovations**2).mean(axis=(0, 1))))
    np.testing.assert_allclose(found.measurement, data.measurements.std(axis=(0, 1)))
    p, c, r = estimates.covs[0, -1], MODEL.matrices()[3], filter_.model.measurement_noise_cov
    np.testing.assert_allclose(found.gain, np.linalg.solve(r, c @ p).T, atol=0.02)  # K = P C' R^-1, P that after z


def test_longer_runs_begin_as_the_others_and_larger_noise_has_four_times_r():
    seeds = PROBLEM.held_out_seeds(0, 400)
    data, longer = data_of(PROBLEM, seeds), learning.twice_as_long(PROBLEM, seeds)
    assert longer.steps == 80 and PROBLEM.steps == 40
    np.testing.assert_array_equal(longer.filter_keys, data.filter_keys)
    added = learning.with_larger_noise(PROBLEM, data).measurements - data.measurements
    cov, size = np.cov(added.reshape(-1, 2).T), added.size / 2
    room = 4.5 * np.sqrt(2.0 / size) * 3.0 * np.abs(MODEL.measurement_noise_cov).max()
    np.testing.assert_allclose(cov, 3.0 * MODEL.measurement_noise_cov, atol=room)
    own = data.measurements - data.states @ MODEL.matrices()[3].T
    own -= own.mean(axis=(0, 1))
    assert abs((own * added).mean()) < 4.5 * np.sqrt(own.var() * added.var() / added.size)
    np.testing.assert_array_equal(longer.states[:, :41], data.states)
    nominal = find_scenario("nominal")
    some = nominal.held_out_seeds(0, 2)
    found, known = learning.twice_as_long(nominal, some), nominal.data(some)
    assert found.steps == 2 * known.steps
    fixed = ModelProblem(MODEL, inputs=np.zeros((20, 1)), first_scored_step=5, scale=[1.0, 1.0])
    assert learning.twice_as_long(fixed, range(3)) is None


def test_a_channel_without_measurements_is_refused_and_one_with_few_has_a_scale(runs):
    filter_, data, _ = runs
    measurements = data.measurements.copy()
    measurements[:, 1::2] = np.nan
    found = learning.scales_of(filter_, data._replace(measurements=measurements))
    assert all(np.isfinite(one).all() for one in found)
    np.testing.assert_allclose(found.measured, np.nanstd(measurements, axis=(0, 1)))
    with pytest.raises(ValueError, match="must have measurements of each channel, but .* has none"):
        learning.new_estimator(
            "gru", filter_, data._replace(measurements=np.full_like(measurements, np.nan)), seed=1
        )


def test_training_lowers_the_score_and_the_same_seed_gives_the_same_weights(runs):
    filter_, data, validation = runs
    threads, drawn, found = torch.get_num_threads(), torch.random.get_rng_state(), []
    for _ in range(2):
        estimator = learning.new_estimator("gru", filter_, data, seed=1, width=8)
        checks = learning.train(
            estimator, data, validation, PROBLEM.scale, SETTINGS._replace(steps=60, rate=0.02), seed=3
        )
        found.append((estimator.state_dict(), checks))
    assert torch.get_num_threads() == threads and torch.equal(torch.random.get_rng_state(), drawn)
    (weights, checks), (again, _) = found
    assert all(torch.equal(weights[name], again[name]) for name in weights)
    assert min(one.score for one in checks) < 0.7 * checks[0].score
    best = min(checks, key=lambda one: one.score)
    one = ForeignFilter(model=MODEL, estimator=estimator)
    assert values_of(one, validation, PROBLEM.scale).score.value == pytest.approx(best.score, rel=1e-12)
    assert [one.step for one in checks] == [0, 20, 40, 60]


def test_a_training_that_gets_worse_returns_the_first_weights_and_one_that_is_stopped_the_best(runs):
    filter_, data, validation = runs
    estimator = learning.new_estimator("kalmannet", filter_, data, seed=0)
    before = {name: one.clone() for name, one in estimator.state_dict().items()}
    checks = learning.train(estimator, data, validation, PROBLEM.scale, SETTINGS._replace(rate=10.0))
    assert all(one.score > checks[0].score for one in checks[1:])
    assert all(torch.equal(before[name], one) for name, one in estimator.state_dict().items())
    steps = []
    ends = {"on_step": steps.append, "stopped": lambda: len(steps) == 3}
    checks = learning.train(estimator, data, validation, PROBLEM.scale, SETTINGS, **ends)
    assert steps == [1, 2, 3] and [one.step for one in checks] == [0, 2]


def test_standings_pair_all_filters_on_the_same_runs(runs):
    filter_, data, _ = runs
    rows = learning.standings({"a": filter_, "b": filter_}, PROBLEM, PROBLEM.held_out_seeds(0, 5))
    for name in (HELD_OUT, LONGER, NOISIER):
        assert rows[1].ratio(rows[0], name).value == 1.0
    assert rows[0].evaluations[NOISIER].score.value > rows[0].evaluations[HELD_OUT].score.value


def test_the_function_trains_stores_compares_and_continues(tmp_path, runs):
    path = tmp_path / "mine.safetensors"
    arguments = {"runs": 16, "batch": 8, "window": 10, "seeds": 6}
    training = tuning.train_estimator("recursive-kalmannet", PROBLEM, steps=4, out=path, **arguments)
    assert training.file == path and read(path).about["training"]["problem"] == "plane"
    assert [one.label.split()[0] for one in training.standings] == ["ekf", "ekf", "recursive-kalmannet"]
    assert "recursive-kalmannet" in str(training) and "R x 4" in training._repr_html_()
    frame = training.to_frame()
    assert list(frame["filter"]) == [one.label for one in training.standings] and np.isfinite(frame["NEES"]).all()
    assert training.plot_training().axes[0].get_xlabel() == "updates of the weights"
    page = training.report(tmp_path / "page.html").read_text()
    assert "recursive-kalmannet trained on plane" in page and page.count("<svg") == 2
    refused("must end in .html", training.report, tmp_path / "page.pdf")
    comparison = tuning.compare(["ekf", path], PROBLEM, seeds=6)
    assert comparison.filters == ("ekf", "mine")
    score = comparison.boards[0].rows[1].evaluation.score
    assert score == training.standings[-1].evaluations[HELD_OUT].score
    again = tuning.train_estimator("recursive-kalmannet", PROBLEM, steps=1, start=path, out=path, **arguments)
    assert again.checks[0].score == min(one.score for one in training.checks)
    with pytest.raises(ValueError, match="start must be a kalmannet's file"):
        tuning.train_estimator("kalmannet", PROBLEM, steps=1, start=path, out=path, **arguments)


def test_wrong_arguments_are_refused_before_any_training(tmp_path):
    for arguments, said in (
        ({"kind": "transformer"}, "an estimator must be one of"),
        ({"steps": 0}, "steps must be"),
        ({"out": tmp_path / "mine.json"}, "must end in .safetensors"),
        ({"problem": find_scenario("nominal"), "against": [tmp_path / "none.json"]}, "none.json"),
    ):
        with pytest.raises(ValueError, match=said):
            tuning.train_estimator(**{"problem": PROBLEM, "out": tmp_path / "mine.safetensors", **arguments})


def test_the_command_trains_and_compare_takes_its_file(thruster, tmp_path):
    path = tmp_path / "gain.safetensors"
    of_problem = ["--problem", f"{__name__}:PROBLEM", "--seeds", "6"]
    options = [*of_problem, "--runs", "16", "--batch", "8", "--steps", "2", "--out", str(path), "--json", "-"]
    told = json.loads(thruster("train-estimator", "gru", *options).stdout)
    assert told["file"] == str(path) and [one["filter"] for one in told["standings"]][-1] == "gru"
    found = thruster("compare", str(path), "--filter", "ekf", *of_problem).stdout
    assert "gain" in found and "ekf" in found
