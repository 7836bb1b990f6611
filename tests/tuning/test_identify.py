"""Parameters by maximum likelihood over innovations: values, standard errors, and what data do not determine."""

import math
import pickle
import signal
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from filters import ExtendedKalmanFilter, run
from tests.filters.checks import refused
from tests.filters.test_sensitivity import pendulum
from thruster_env.core.parallel import task_map
from thruster_env.core.streams import episode_keys, filter_keys
from thruster_env.logs.log import Log
from thruster_env.model import simulate
from tuning.api.identify import fall_sentence, with_ranges
from tuning.likelihood.identify import identify, profile_figure, profiles, validate
from tuning.likelihood.parametric import ModelFamily
from tuning.likelihood.recorded import runs_of
from tuning.likelihood.result import covariance, read_values, with_values, write_values
from tuning.problems.data import Data
from tuning.problems.problem import Parameter

TRUTH = {"stiffness": 11.0, "damping": 0.5, "offset": -0.3, "q": 0.02, "r": 0.03}
FREE = (
    Parameter("stiffness", 1.0, 50.0, default=7.0),
    Parameter("damping", 0.0, 2.0, log=False, default=0.1),
    Parameter("offset", -1.0, 1.0, log=False, default=0.0),
    Parameter("q", 1e-4, 1.0, default=0.1),
    Parameter("r", 1e-4, 1.0, default=0.1),
)


def recorded(count=8, steps=150, first=0, **changes):
    rng = np.random.default_rng(first)
    model = pendulum(**{**TRUTH, **changes})
    inputs = np.repeat(rng.uniform(-3, 3, size=(count, -(-steps // 10), 1)), 10, axis=1)[:, :steps]
    seeds = tuple(range(first, first + count))
    drawn = simulate.simulate(model, episode_keys(seeds), inputs).measurements
    return Data(seeds, inputs, drawn, filter_keys(seeds), 0)


@pytest.fixture(scope="module")
def data():
    return recorded()


@pytest.fixture(scope="module")
def found(data):
    return identify(data, pendulum, FREE, starts=3)


@pytest.mark.slow
def test_constants_and_noise_are_found_together_within_their_standard_errors(found):
    for name, truth in TRUTH.items():
        assert abs(found.values[name] - truth) < 3 * found.standard_errors[name], name
        assert found.determined[name] and not found.at_end[name]
    assert found.standard_errors["stiffness"] < 0.3 and found.standard_errors["offset"] < 0.05
    assert found.agreement == 3 and all(one.converged for one in found.optima)
    assert len({one.start["stiffness"] for one in found.optima}) == 3
    assert found.log_likelihood > found.start_log_likelihood + 100
    assert "determine every free parameter" in found.sentences()[0]


@pytest.mark.slow
def test_an_end_at_zero_is_not_to_be_widened(found):
    first, second = found.objective.coordinates.free[:2]
    coordinates = SimpleNamespace(free=(replace(first, low=0.0, log=False, default=None), second))
    ends = found._replace(
        objective=SimpleNamespace(coordinates=coordinates),
        values={**found.values, first.name: 0.0},
        at_end={**found.at_end, first.name: True, second.name: True},
    )
    assert ends._end_sentences() == [
        f"At zero, where the range ends: {first.name}. The data require none of them.",
        f"At an end of the range: {second.name}. A wider one may fit better.",
    ]
    assert found._end_sentences() == []


@pytest.mark.slow
def test_standard_errors_are_the_scatter_of_estimates(found, data):
    some = [identify(recorded(8, first=100 * i), pendulum, FREE, start=TRUTH, starts=1) for i in range(1, 9)]
    for name in TRUTH:
        scatter = np.std([one.values[name] for one in some], ddof=1)
        assert 0.45 < scatter / found.standard_errors[name] < 2.0, name  # chi with 7 degrees of freedom


@pytest.mark.slow
def test_the_same_numbers_come_from_any_executor(data, found):
    with ThreadPoolExecutor(1) as pool, task_map(pool) as tasks:
        again = identify(data, pendulum, FREE, starts=3, tasks=tasks)
    assert again.values == found.values and again.standard_errors == found.standard_errors
    assert again.optima == found.optima and again.evaluations == found.evaluations


def test_what_stands_in_a_product_alone_trades_off_and_is_not_determined(data):
    def model(first, second, **values):
        return pendulum(**{**TRUTH, **values, "drive": first * second})

    pair = (Parameter("first", 0.1, 10.0, default=1.0), Parameter("second", 0.1, 10.0, default=1.5))
    found = identify(data, model, (*pair, FREE[1]), starts=1)
    product = found.values["first"] * found.values["second"]
    assert product == pytest.approx(2.0, rel=0.1)
    assert found.determined == {"first": False, "second": False, "damping": True}
    assert found.traded[0][:2] == ("first", "second") and found.traded[0][2] < -0.95
    assert found.least_determined.keys() == {"first", "second"}
    assert np.prod(np.sign(list(found.least_determined.values()))) == -1
    said = " ".join(found.sentences())
    assert "do not determine first, second" in said and "trade off" in said


def test_a_parameter_that_moves_the_data_is_found_as_one_of_the_model(data, found):
    def moved(offset):
        return data._replace(measurements=data.measurements - np.array([0.0, offset]))

    def model(**values):
        return pendulum(offset=0.0, **values)

    again = identify(moved, model, FREE, start=found.values, starts=1)
    for name in TRUTH:
        assert again.values[name] == pytest.approx(found.values[name], abs=0.05 * found.standard_errors[name])
        assert again.standard_errors[name] == pytest.approx(found.standard_errors[name], rel=0.2)


def test_a_single_run_has_standard_errors_from_its_blocks():
    found = identify(recorded(1, 800), pendulum, FREE, starts=1)
    for name, truth in TRUTH.items():
        assert 0 < found.standard_errors[name] < math.inf
        assert abs(found.values[name] - truth) < 3.5 * found.standard_errors[name], name


@pytest.mark.slow
def test_outliers_beyond_a_gate_are_left_out(data, found):
    rng, spoilt = np.random.default_rng(0), data.measurements.copy()
    outliers = rng.random(spoilt.shape) < 0.02
    spoilt[outliers] += 3.0
    spoilt = data._replace(measurements=spoilt)
    options = {"start": TRUTH, "starts": 1}
    normal, gated = (identify(spoilt, pendulum, FREE, gate=gate, **options) for gate in (math.inf, 4.5))
    left_out = gated.objective.parts[0].data.outliers
    assert (left_out & outliers).sum() > 0.97 * outliers.sum() and (left_out & ~outliers).sum() < 5
    for name in ("offset", "r"):
        assert abs(normal.values[name] - found.values[name]) > 3 * found.standard_errors[name]
        assert abs(gated.values[name] - found.values[name]) < 0.5 * found.standard_errors[name]


def test_ctrl_c_keeps_the_best_so_far(data):
    rises = []

    def tell(number, value, values):
        rises.append((value, values))
        if len(rises) == 3:
            signal.raise_signal(signal.SIGINT)

    found = identify(data, pendulum, FREE, starts=3, simulation_first=False, progress=tell)
    assert found.interrupted and len(found.optima) == 1
    assert found.log_likelihood >= rises[2][0] and "Interrupted" in found.sentences()[-1]


def test_ctrl_c_before_any_start_is_an_interrupt_not_an_error_of_the_starts(data, monkeypatch):
    def interrupted(objective, *_):
        signal.raise_signal(signal.SIGINT)
        return objective

    monkeypatch.setattr("tuning.likelihood.identify._with_starts", interrupted)
    with pytest.raises(KeyboardInterrupt):
        identify(data, pendulum, FREE, starts=2)


def test_a_profile_falls_as_the_standard_error_says(found, tmp_path):
    (one,) = profiles(found, ["stiffness"])
    low, high = one.interval
    width = 1.96 * found.standard_errors["stiffness"]
    assert low < found.values["stiffness"] < high
    assert (high - low) / (2 * width) == pytest.approx(1.0, abs=0.25)
    assert one.log_likelihoods.max() == pytest.approx(found.log_likelihood, abs=1e-2)
    assert len(profile_figure(found, [one]).axes) == 1


def test_held_out_runs_prove_the_model(found):
    checked = validate(found, recorded(4, first=50))
    assert checked["identified"].log_likelihood > checked["start"].log_likelihood + 50
    assert fall_sentence(checked) == []
    (said,) = fall_sentence({"start": checked["identified"], "identified": checked["start"]})
    assert said.startswith("On the held-out runs the log-likelihood fell by ")
    assert checked["identified"].nis == pytest.approx(1.0, abs=0.1)
    assert checked["identified"].one_step["w"] < checked["start"].one_step["w"]
    assert set(checked["identified"].fit) == {"a", "w"}


def test_logs_of_different_lengths_are_one_batch(data, found):
    model = pendulum()
    logs = [
        Log(str(b), 0.1, u[:end], z[: end + 1], model.input_quantities, model.measurements)
        for b, (u, z, end) in enumerate(zip(data.inputs, data.measurements, [150] * 7 + [90], strict=True))
    ]
    runs = runs_of(logs)
    assert runs.inputs.shape == (8, 150, 1) and np.isnan(runs.measurements[7, 91:]).all()
    again = identify(logs, pendulum, FREE, starts=1)
    assert again.values["stiffness"] == pytest.approx(found.values["stiffness"], rel=0.03)
    with pytest.raises(ValueError, match="must have the same sample time, but"):
        runs_of([logs[0], replace(logs[0], name="b", dt=0.2)])
    refused("data must be some of Log or Data", runs_of, [1.0])


def test_a_family_knows_arguments_constants_and_noise():
    family = ModelFamily(pendulum, ["stiffness", "q"])
    assert [one.name for one in family.free] == ["stiffness", "q", "Q11", "Q22", "R11", "R22"]
    changed = family.model(stiffness=4.0, Q11=5.0, R22=7.0)
    assert changed.constants.stiffness == 4.0
    assert np.diag(changed.process_noise_cov).tolist() == [5.0, 0.01]
    assert np.diag(changed.measurement_noise_cov).tolist() == pytest.approx([0.05, 7.0])
    of_model = ModelFamily(pendulum(), ["damping"], noise=False)
    assert of_model.model(damping=0.9).constants == pendulum(damping=0.9).constants
    refused("must be of stiffness, damping, .*, but got 'mass'", ModelFamily, pendulum, ["mass"])
    (changed,) = with_ranges(of_model.free, {"damping": (-1.0, 3.0)}, {"damping": 0.5})
    assert (changed.low, changed.high, changed.log, changed.start) == (-1.0, 3.0, False, 0.5)
    with pytest.raises(ValueError, match="the start of damping must be within 0.03 and 3, but got 4"):
        with_ranges(of_model.free, {}, {"damping": 4.0})


def test_wrong_arguments_are_refused(data):
    with pytest.raises(ValueError, match="the start of stiffness must be within 1 and 50, but got 60"):
        identify(data, pendulum, FREE, start={"stiffness": 60.0})
    with pytest.raises(ValueError, match="a start must name free parameters, .*, but got .'mass'"):
        identify(data, pendulum, FREE, start={"mass": 1.0})
    refused("each named once", identify, data, pendulum, [FREE[0], FREE[0]])
    with pytest.raises(ValueError, match="1 inputs and 2 measurements, but got"):
        identify(data._replace(measurements=data.measurements[..., :1]), pendulum, FREE)


def test_the_covariance_is_the_sandwich_or_the_information_where_scatter_says_less():
    rng = np.random.default_rng(0)
    information, width = np.array([[40.0, 10.0], [10.0, 20.0]]), np.array([1e3, 1e3])
    scores = rng.multivariate_normal([0, 0], 4 * information / 500, size=500)
    scores -= scores.mean(axis=0)
    inverse = np.linalg.inv(information)
    sandwich = inverse @ (scores.T @ scores * 500 / 499) @ inverse
    np.testing.assert_allclose(covariance(information, scores, width), sandwich, rtol=1e-4)
    np.testing.assert_allclose(covariance(information, 0.01 * scores, width), inverse, rtol=1e-4)
    np.testing.assert_allclose(covariance(information, scores[:0], width), inverse, rtol=1e-4)
    unknown = covariance(np.diag([40.0, 0.0]), scores[:0], np.array([1.0, 2.0]))
    np.testing.assert_allclose(np.diag(unknown), [1 / 40, 12 * 4.0], rtol=1e-6)


def test_a_predicted_channel_is_learnt_from_but_never_seen(data):
    free = [one for one in FREE if one.name in ("stiffness", "offset", "r")]
    found = identify(data, pendulum, free, start={"r": 0.05}, starts=1, predicted=["w"])
    for name in ("stiffness", "offset"):
        assert abs(found.values[name] - TRUTH[name]) < 4 * found.standard_errors[name], name
    blind = data._replace(measurements=data.measurements.copy())
    blind.measurements[..., 1] = np.nan
    model = found.objective.model_at(found.at)
    estimates = run(ExtendedKalmanFilter(model=model), blind.filter_keys, blind.inputs, blind.measurements)
    errors = data.measurements[..., 1] - estimates.means[..., 1] - model.constants.offset
    checked = validate(found)
    assert checked["identified"].one_step["w"] == pytest.approx(np.sqrt((errors**2).mean()), rel=1e-12)
    assert checked["identified"].one_step["w"] < 0.9 * checked["start"].one_step["w"]
    with pytest.raises(ValueError, match="a filter must see some channel, but a, w are only predicted"):
        identify(data, pendulum, free, predicted=["a", "w"])
    with pytest.raises(ValueError, match="a predicted channel must be one of a, w, but got 'x'"):
        identify(data, pendulum, free, predicted=["x"])


def test_values_of_a_model_go_into_a_file_and_back(found, tmp_path):
    write_values(tmp_path / "mine.toml", found, ["a/run1.csv"])
    assert read_values(tmp_path / "mine.toml") == found.values
    made = with_values(pendulum, tmp_path / "mine.toml")
    assert made(0.1).constants == pendulum(**found.values).constants
    np.testing.assert_array_equal(made(0.1).process_noise_cov, pendulum(**found.values).process_noise_cov)
    assert pickle.loads(pickle.dumps(made))(0.1).constants == made(0.1).constants
    for text, rule in [
        ("x = ", "must be TOML"),
        ("[values]\nmass = 1.0", "free parameters must be of stiffness, .*mass"),
        ("[values]\nstiffness = 'big'", "stiffness in .* must be a finite number"),
        ("[thruster]\nlift = 1.0", r"must have the table \[values\]"),
    ]:
        (tmp_path / "bad.toml").write_text(text, encoding="utf-8")
        refused(rule, with_values, pendulum, tmp_path / "bad.toml")
    refused("must be readable, but .*none.toml is not", read_values, tmp_path / "none.toml")
    refused("must end in .toml", write_values, tmp_path / "mine.json", found, [])
