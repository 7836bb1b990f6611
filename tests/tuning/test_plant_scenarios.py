"""Scenarios of every plant by one contract: data are an env's, values are immutable, files and names find them."""

import dataclasses
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path

import gymnasium as gym
import numpy as np
import optuna
import pytest

import thruster_env  # noqa: F401 - registers the envs
import thruster_env.auv  # noqa: F401 - registers the vehicle's
from filters import EstimateState, run
from filters.bounds import riccati_covariances
from tests.cart_scenarios import SCENARIOS as CARTS
from tests.filters.checks import refused
from tests.slow import slow_but
from tests.tuned_files import write_untuned
from thruster_env.core.streams import episode_keys
from thruster_env.thruster.model import model_of_plant
from tuning.api.verify import verify
from tuning.evaluation.evaluate import evaluate
from tuning.evaluation.held_out import evaluate_held_out
from tuning.evaluation.tuned import read_tuned, write_tuned
from tuning.plants.auv import SAILING
from tuning.plants.auv import SCENARIOS as VEHICLES
from tuning.plants.thruster import SCENARIOS, Scenario, is_stable
from tuning.problems import find
from tuning.problems.check import checked_problem
from tuning.problems.data import held_out_seeds, training_seeds
from tuning.problems.find import find_problem, plant_packages, scenario_of
from tuning.problems.scenario import print_scales
from tuning.search.plan import Plan
from tuning.search.space import untuned_choice
from tuning.search.study import open_study, run_study

ALL = {**SCENARIOS, **VEHICLES, **CARTS}
SHORT = {"steps": 60, "first_scored_step": 10}
QUICK = [*SCENARIOS, "auv:papers"]  # others of the vehicle are compiled for seconds
NOMINAL = SCENARIOS["nominal"]


@pytest.fixture
def file(tmp_path, monkeypatch):
    """Write a scenario file in the working folder and read it."""
    monkeypatch.chdir(tmp_path)

    def write(text):
        (tmp_path / "my.toml").write_text(text)
        return find_problem("my.toml")

    return write


@pytest.fixture
def brought(monkeypatch):
    """Bring modules of plants by entry points."""

    def bring(**modules):
        points = [EntryPoint(name, module, find.PLANTS) for name, module in modules.items()]
        monkeypatch.setattr(find, "entry_points", lambda group: points)
        plant_packages.cache_clear()

    yield bring
    plant_packages.cache_clear()


@pytest.mark.parametrize(
    "name", slow_but([*SCENARIOS, "auv:dvl_dropout", "auv:estimated_current", "auv:loop", "auv:papers"], QUICK)
)
def test_data_are_those_of_an_env_of_the_plant_with_the_same_seed(name):
    scenario = ALL[name].replace(**SHORT)
    data = scenario.data([5, 11])
    env = scenario.make_env()
    assert env.spec.max_episode_steps == scenario.steps
    _, info = env.reset(seed=11)
    for k, action in enumerate([*data.inputs[1], None]):
        measured = np.where(info.get("measurement_valid", True), info["measurement"], np.nan)
        np.testing.assert_allclose(data.measurements[1, k], measured, rtol=1e-14, atol=1e-14)
        state = np.append(info["state"], info.get("current", []))
        np.testing.assert_allclose(data.states[1, k], state[: data.states.shape[-1]], rtol=1e-14, atol=1e-14)
        if "T" in data.outputs:
            np.testing.assert_allclose(info["thrust"], data.outputs["T"][1, k], rtol=1e-14, atol=1e-14)
        if action is not None:
            *_, info = env.step(action)


@pytest.mark.parametrize("name", ALL)
def test_a_scenario_is_an_immutable_value_that_fits_its_model_and_that_files_store(name, brought):
    brought(cart="tests.cart_scenarios")
    scenario = ALL[name]
    if name not in SCENARIOS:  # of which each has its env's data above
        checked_problem(scenario.replace(**SHORT))
    again = scenario_of(scenario.as_mapping(), name, "a.json")
    assert find_problem(name) == again == scenario and hash(again) == hash(scenario) and again is not scenario
    assert again.digest == scenario.digest == scenario.replace(name="x", about="y").digest
    assert scenario.replace(scale=[part * (1 + 1e-12) for part in scenario.scale]).digest == scenario.digest
    with pytest.raises(dataclasses.FrozenInstanceError):
        scenario.steps = 3
    with pytest.raises(TypeError):
        scenario.parameter_factors["area"] = 2.0


def test_no_two_scenarios_are_equal_and_every_field_but_name_and_about_is_in_the_digest():
    assert len(set(ALL.values())) == len({scenario.digest for scenario in ALL.values()}) == len(ALL)
    changes = {
        "process_noise_cov": (2.0, 4e-4), "measurement_noise_cov": 1.0, "scale": (1.0, 1.0), "steps": 400,
        "parameter_factors": {"area": 1.1}, "excitation": {"name": "prbs"}, "first_scored_step": 7, "dt": 0.02,
        "preset": "t200", "max_voltage": 12.0, "ambient_velocity": 0.1, "initial_state": [0.0, 0.0],
        "sensors": ["speed"], "flow": [{"name": "gusts"}], "amplifier": [{"name": "dead-band", "width": 1.0}],
        "uncertainty": {"load_gain": {"name": "log-normal", "std": 0.1}}, "system": "tunnel",
    }  # fmt: skip
    digests = {NOMINAL.replace(**{name: value}).digest for name, value in changes.items()}
    assert set(changes) == {entry.name for entry in dataclasses.fields(NOMINAL)} - {"name", "about"}
    assert len(digests) == len(changes) and NOMINAL.digest not in digests


def test_numbers_of_seeds_that_cannot_be_are_refused():
    refused("seed must be a whole number of at least 0, but got -1", training_seeds, -1, 5)
    refused("held-out seeds must be a whole number of at least 2, but got 1", held_out_seeds, 0, 1)


def test_scenarios_of_another_package_are_found_by_name_by_file_and_in_tuned_files(
    brought, file, as_python, monkeypatch
):
    monkeypatch.setattr(find, "FILE_SEQUENCES", 1)  # a scale takes a hundred truths a sequence
    refused("problem must be one of", find_problem, "cart")
    brought(cart="tests.cart_scenarios")
    scenario = find_problem("cart")
    assert scenario.untuned["process_noise_cov"] == pytest.approx((4e-4, 4e-4, 1.6e-3))
    assert scenario.plant_data == {"mass": 2.0} and scenario.plant_arguments == {"mass": 2.0, "dt": 0.1}
    heavy = file('plant = "cart"\nmass = 4.0\nparameter_factors = {mass = 0.5}\nsteps = 60')
    assert heavy.model().constants == scenario.model().constants and heavy.plant.mass == 4.0
    assert heavy.scale_about == "the scale given with the problem" and np.isfinite(heavy.scale).all()
    with pytest.raises(ValueError, match="plant of a scenario must be one of thruster, auv, cart, but got 'ship'"):
        scenario_of({"plant": "ship"}, "x", "tuned.json")


def test_a_module_that_brings_no_plant_is_left_out_with_a_warning(brought):
    brought(none="tests.small_plant", gone="tests.nowhere", cart="tests.cart_scenarios")
    with pytest.warns(UserWarning, match="must offer Scenario, SCENARIOS and NOMINAL, but tests") as caught:
        assert set(plant_packages()) == {"thruster", "auv", "cart"}
    assert len(caught) == 2


def test_a_file_changes_its_base(file):
    scenario = file("""
        base = "outliers"
        about = "outliers under a binary sequence, with gusts"
        scale = [1.0, 0.05]
        steps = 200
        excitation = {name = "prbs", amplitude = 8, hold = 40}
        flow = [{name = "gusts", std = 0.5}]
        [parameter_factors]
        lift_coefficient = 1.1
    """)
    assert scenario.name == "my.toml" and scenario.about == "outliers under a binary sequence, with gusts"
    assert scenario.excitation.as_mapping() == {"name": "prbs", "amplitude": 8.0, "hold": 40}
    assert scenario.plant.sensors == SCENARIOS["outliers"].plant.sensors and scenario.plant.flow[0].std == 0.5
    assert dict(scenario.parameter_factors) == {"lift_coefficient": 1.1} and scenario.scale == (1.0, 0.05)
    assert scenario == find_problem("my.toml") and scenario.data([1, 2]).states.shape == (2, 201, 2)
    linear = file('base = "published_tunnel"\nscale = [1.0, 1.0]\nmeasurement_noise_cov = 1')
    assert linear.plant.linear is not None and linear.measurement_noise_cov == 1.0


def test_without_base_and_scale_it_is_nominal_and_the_scale_is_computed_and_a_tuned_file_has_it(file):
    scenario = file("measurement_noise_cov = 4.0\nsteps = 60")
    assert scenario.excitation == NOMINAL.excitation and scenario.about == ""
    assert scenario.scale == tuple(scenario.computed_scale(200)) and scenario.scale[1] > NOMINAL.scale[1]
    write_untuned("tuned.json", scenario)
    assert read_tuned("tuned.json") == (untuned_choice("ekf", scenario), scenario, 0)


@pytest.mark.slow
def test_a_file_says_whose_scenario_it_is(file):
    of_vehicle = 'plant = "auv"\nbase = "auv:navigation"\nsteps = 60\nfirst_scored_step = 10\n'
    scenario = file(f"{of_vehicle}current = [0.1, 0.0, 0.0]\n")
    assert scenario.states == "navigation"
    assert 0.3 < scenario.scale[9] / VEHICLES["auv:navigation"].scale[9] < 1
    refused("scenario must be one of nominal, .* but got 'auv:motion'", file, 'base = "auv:motion"')


def test_a_study_and_its_file_do_without_a_bound_and_another_content_of_the_file_is_another_study(file):
    plan = Plan("ekf", (file("process_noise_cov = [1.0, 0.0]\nsteps = 80"),))
    storage = optuna.storages.InMemoryStorage()
    result = run_study(open_study("s", plan, storage), plan, 3)
    write_tuned("t.json", plan, result, [evaluate_held_out(result.choice, plan.scenarios[0], 0, 4)], "s")
    assert "NaN" not in Path("t.json").read_text() and verify("t.json").holds
    text = "scale = [1.0, 0.05]\nsteps = 60\nmeasurement_noise_cov = {}"
    open_study("other", Plan("ekf", (file(text.format(1.0)),)), storage)
    open_study("other", Plan("ekf", (file(text.format(1.0) + "\nabout = 'the same'"),)), storage)
    rule = "'other' exists here for another model or other logs: give it another name"
    refused(rule, open_study, "other", Plan("ekf", (file(text.format(2.0)),)), storage)


BAD = {
    "colour = 1": r"keys of a scenario must be among plant, base, about, .*, but my.toml has \['colour'\]",
    "name = 'x'": r"keys of a scenario must be among .*, but my.toml has \['name'\]",
    "plant = 'kite'": r"plant of a scenario must be one of thruster.*, but got 'kite' \(in my.toml\)",
    "a = [": "a scenario file must be TOML, but my.toml is not: ",
    "base = 'none'": r"scenario must be one of nominal, .*, but got 'none' \(in my.toml\)",
    "scale = [1.0, 0.0]": r"scale must be positive in every state, but got \[1.0, 0.0\] \(in my.toml\)",
    "scale = 1.0": r"scale must be 2 finite numbers, but got 1.0 \(in my.toml\)",
    "steps = 50": r"steps must be a whole number of at least 51, but got 50 \(in my.toml\)",
    "process_noise_cov = [0.0, 0.0]\ninitial_state = [0.0, 0.0]": "the RMSE of the open loop is",
    "base = 'published_open_bladed'\nprocess_noise_cov = [1.0, 0.0]": "needs a bound or a stable open loop",
    "measurement_noise_cov = 'small'": r"measurement_noise_cov must be a finite number, but got 'small'",
    "excitation = {name = 'steps', height = 3}": "arguments of 'steps' must be among amplitude, hold",
    "excitation = 'prbs'": "each entry of excitation must be a mapping whose name is one of steps",
    "sensors = ['thrust', 'speed']": "measurement_noise_cov must be 2 finite numbers, but got 0.25",
    "sensors = ['current']": r"channels that a model of the state can predict must be .* \(in my.toml\)",
    "sensors = 3": r"sensors of a scenario must be one channel or several, but got 3 \(in my.toml\)",
    "flow = [{name = 'tide'}]": "each entry of flow must be a mapping whose name is one of",
    "preset = 'none'": "preset must be one of",
    "system = 'none'": "system must be one of tunnel, open_bladed, but got 'none'",
    "parameter_factors = {colour = 2}": "parameter_factors must name fields of",
    "parameter_factors = 2": r"parameter_factors must be a mapping, but got 2 \(in my.toml\)",
    "about = 2": r"about must be text, but got 2 \(in my.toml\)",
    "dt = -1": r"dt must be positive, but got -1 \(in my.toml\)",
    "initial_state = 'rest'": "initial_state must be",
    "uncertainty = 3": "uncertainty must be",
    'plant = "auv"\nstates = "motion"\nscale = 1': "scale must be 8 finite numbers",
    'plant = "auv"\nstates = "all"': "states must be one of velocities, motion, .*, but got 'all'",
    'plant = "auv"\nmeasurement_noise_cov = 1.0': "measurement_noise_cov must be 1 to 20 variances, one for each",
    'plant = "auv"\npreset = "titanic"': "preset must be",
    'plant = "auv"\nexcitation = {name = "manoeuvre", path = "V"}': "path must be one of I, II, III, IV, dynamic",
    'plant = "auv"\nbase = "auv:navigation"\nstates = "motion"\nscale = [1, 1, 1, 1, 1, 1, 1, 1]': (
        "sensors of a model of 8 states must measure u, v, .*, but got psi, z"
    ),
}


@pytest.mark.parametrize(("text", "line"), BAD.items(), ids=list(BAD))
def test_what_is_wrong_with_a_file_is_one_clear_line(text, line, file):
    refused(line, file, text)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nominal", "published_noise", "speed_magnitude", "reversal", "bias", "mixed"])
def test_the_stored_scale_of_a_thruster_is_the_bound(name):
    np.testing.assert_allclose(SCENARIOS[name].computed_scale(120, truths=50), SCENARIOS[name].scale, rtol=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["auv:motion", "auv:navigation"])
def test_a_vehicle_s_scale_is_that_of_the_code_and_of_a_consistent_extended_filter(name):
    scenario = VEHICLES[name]
    np.testing.assert_allclose(scenario.computed_scale(6), scenario.scale, rtol=0.08)
    filter_ = untuned_choice("ekf", scenario)._replace(model=scenario.true).filter(scenario)
    evaluation, n = evaluate(filter_, scenario.data(range(24)), scenario.scale), scenario.count
    assert evaluation.nees.low - 0.1 < n < evaluation.nees.high + 0.1 and abs(evaluation.nees.value - n) < 0.08 * n
    assert evaluation.nis.low - 0.05 < evaluation.expected_nis < evaluation.nis.high + 0.05
    assert [rmse.value for rmse in evaluation.rmse[:8]] == pytest.approx(scenario.scale[:8], rel=0.05)
    assert evaluation.divergences == 0


@pytest.mark.parametrize("name", ["published_tunnel", "published_open_bladed"])
def test_the_scale_of_a_linear_scenario_is_riccatis(name):
    _, posterior = riccati_covariances(SCENARIOS[name].model())
    np.testing.assert_allclose(SCENARIOS[name].scale, np.sqrt(np.diag(posterior)), rtol=1e-3)


def test_anyone_can_compute_a_scale_anew_and_that_of_the_published_tunnel_is_the_papers(capsys, monkeypatch):
    monkeypatch.setattr(Scenario, "scale_sequences", 2)  # on which a linear bound does not depend
    print_scales(SCENARIOS, ["published_tunnel"])
    assert capsys.readouterr().out == "published_tunnel: (0.8066, 0.1457), stored (0.8066, 0.1457)\n"


def test_scales_are_shared_where_the_core_is_and_untuned_is_one_per_cent_of_each_range():
    for name in ("mismatch", "ambient", "outliers", "dropout"):
        assert SCENARIOS[name].scale == NOMINAL.scale
    assert SCENARIOS["deadband"].scale == SCENARIOS["quantised"].scale
    assert dict(SCENARIOS["mismatch"].parameter_factors) == {"lift_coefficient": 1.15, "voltage_gain": 0.95}
    # 24 V: 387.515 rad/s and 7.347 m/s, so the ranges over +-24 V are twice that
    np.testing.assert_allclose(np.sqrt(NOMINAL.untuned["process_noise_cov"]), [7.7503, 0.14694], rtol=1e-4)
    assert NOMINAL.untuned["measurement_noise_cov"] == 0.25


def test_where_q_is_singular_a_score_is_skill_against_the_open_loop_that_knows_the_plant(file):
    scenario = file("process_noise_cov = [1.0, 0.0]\nsteps = 120")
    assert not scenario.has_bound and np.isnan(scenario.bound(scenario.data([1, 2]))).all()
    data, choice = scenario.data(range(200)), untuned_choice("ekf", scenario)
    open_loop = evaluate(untuned_choice("open-loop", scenario).filter(scenario), data, scenario.scale)
    assert open_loop.score.value == pytest.approx(1.0, rel=1e-9)
    oracle = choice._replace(model={**scenario.true})
    assert evaluate(oracle.filter(scenario), data, scenario.scale).score.value < 1.0
    mismatched = scenario.replace(parameter_factors={"voltage_gain": 0.9})
    assert tuple(mismatched.computed_scale(200)) == scenario.scale
    assert {name for name, other in SCENARIOS.items() if not is_stable(other.plant)} == {"published_open_bladed"}


def test_a_bound_is_computed_once_for_the_same_inputs(monkeypatch):
    from tuning.problems import model_problem as module

    monkeypatch.setattr(module, "_known", {})
    monkeypatch.setattr("thruster_env.graphs.loops.Loops.folder", None)  # nothing on the disk
    asked, computed = [], module.posterior_variances
    monkeypatch.setattr(
        module, "posterior_variances", lambda *arguments, **named: asked.append(1) or computed(*arguments, **named)
    )
    first, other = NOMINAL.data([1]), NOMINAL.data([2])
    bound = NOMINAL.bound(first, truths=3)
    before = bound.copy()
    bound[:] = 0.0  # of the caller alone
    assert np.array_equal(NOMINAL.bound(first, truths=3), before) and len(asked) == 1
    assert not np.array_equal(NOMINAL.bound(other, truths=3), before) and len(asked) == 2
    rounded = first._replace(inputs=np.round(first.inputs))  # whatever type its numbers are of
    of_integers = rounded._replace(inputs=rounded.inputs.astype(np.int64))
    assert np.array_equal(NOMINAL.bound(of_integers, truths=3), NOMINAL.bound(rounded, truths=3))
    noisier = NOMINAL.replace(process_noise_cov=(4.0, 1.6e-3))
    assert (noisier.bound(first, truths=3) > before).all() and len(asked) == 4
    assert not np.array_equal(NOMINAL.bound(first._replace(first_scored=400), truths=3), before)


def test_estimates_in_an_env_with_a_scenarios_voltages_are_those_on_its_data():
    scenario = SCENARIOS["mismatch"].replace(steps=120)
    data, choice = scenario.data([7, 8]), untuned_choice("ekf", scenario)
    estimates = run(choice.filter(scenario), data.filter_keys, data.inputs, data.measurements)
    assumed = {**scenario.held, **choice.model}
    env = EstimateState(scenario.make_env(), filter="ekf", model_arguments=assumed)
    _, info = env.reset(seed=8)
    for k in range(scenario.steps):
        np.testing.assert_allclose(info["estimate"], estimates.means[1, k], rtol=1e-12, atol=1e-12)
        *_, info = env.step(data.inputs[1, k])  # float64 actions: a float32 would round the voltage


def test_what_a_scenario_is_named_for_is_in_its_data():
    nominal, *others = (SCENARIOS[name].data(range(20)) for name in ("nominal", "outliers", "dropout", "mismatch"))
    for data in others:  # the same truth, whatever spoils the sensor or the model
        np.testing.assert_array_equal(data.states, nominal.states)
    outliers, dropout, _ = others
    assert 0.02 < (np.abs(outliers.measurements[..., 0] - nominal.outputs["T"]) > 4.0).mean() < 0.08
    assert 0.3 < np.isnan(dropout.measurements).mean() < 0.7
    names = "bias", "quantised", "startup", "deadband", "ambient", "speed_magnitude", "mixed"
    data = {name: SCENARIOS[name].data(range(20)) for name in names}
    offsets = (data["bias"].measurements[..., 0] - data["bias"].outputs["T"]).mean(axis=1)
    assert 1.0 < offsets.std() < 2.5 and (data["quantised"].measurements % 4.0 == 0).all()
    assert np.abs(data["startup"].states[:, 0]).mean(axis=0)[0] > 40.0
    assert data["deadband"].states[:, 100:, 0].std() / data["quantised"].states[:, 100:, 0].std() < 0.9
    assert (data["ambient"].states[:, 300:, 1] - nominal.states[:, 300:, 1]).mean(axis=1).std() > 0.1
    assert (data["speed_magnitude"].measurements > -4.0).all()
    assert np.abs(data["mixed"].inputs).max() > 12.0 and np.isnan(data["mixed"].measurements).any()
    with pytest.raises(ValueError, match="read-only"):
        nominal.states[0, 0, 0] = 1.0


def test_voltages_hold_their_level_fill_the_range_and_are_cut_off_as_the_env_does():
    levels = NOMINAL.data(range(40)).inputs[:, :, 0].reshape(40, 20, 25)
    assert (levels == levels[:, :, :1]).all() and np.abs(levels).max() < 12.0
    # 800 uniform draws on +-12: standard error of the mean 0.245, of the mean square 0.107 * 144 / sqrt(800/...)
    assert abs(levels[:, :, 0].mean()) < 5 * 0.245
    assert abs((levels[:, :, 0] ** 2).mean() - 48.0) < 5 * 48.0 * np.sqrt(0.8 / 800)
    assert np.abs(NOMINAL.replace(max_voltage=6.0).data(range(3)).inputs).max() == 6.0


@pytest.mark.parametrize("name", ["mismatch", "published_tunnel", "deadband"])
def test_a_model_of_another_q_and_r_is_the_one_that_is_made_of_them(name):
    scenario = SCENARIOS[name]
    noise = {"process_noise_cov": (0.3, 1e-3), "measurement_noise_cov": 0.7}
    direct = model_of_plant(scenario.plant, parameter_factors=dict(scenario.parameter_factors), **noise)
    model = scenario.model(**noise)
    assert model.digest == direct.digest and np.array_equal(model.numbers, direct.numbers)
    assert model.functions == direct.functions and model.shape == direct.shape
    assert scenario.model().process_noise_cov == pytest.approx(np.diag(scenario.process_noise_cov))
    for wrong in ({"process_noise_cov": (1.0, -1.0)}, {"measurement_noise_cov": 0.0}):
        refused(f"{next(iter(wrong))} must be positive", scenario.model, **wrong)
    model.prior_mean[:] = model.measurement_noise_cov[:] = 7.0  # of the caller alone
    assert np.array_equal(scenario.model(**noise).numbers, direct.numbers)


def test_what_one_instrument_of_a_vehicle_measures_is_lost_together():
    lost = np.isnan(VEHICLES["auv:dvl_dropout"].data(range(3)).measurements)
    assert (lost[..., 0] == lost[..., 1]).all() and (lost[..., 0] == lost[..., 2]).all()
    assert 0.8 < lost[..., 0].mean() < 0.95 and not lost[..., 3:9].any()  # every fourth, and half of these
    sensors = {name: [{"name": "dropout", "probability": 0.5}] for name in ("u", "p")}
    apart = VEHICLES["auv:motion"].replace(sensors=sensors, measurement_noise_cov=[1e-4, 1e-4])
    lost = np.isnan(apart.data([0]).measurements[0])
    assert 0.4 < (lost[:, 0] != lost[:, 1]).mean() < 0.6


def test_levels_are_held_as_long_as_is_said():
    inputs = SAILING.inputs(episode_keys(range(40)), 1200, 0.05, 3)
    for i, (low, high) in enumerate(zip(SAILING.low, SAILING.high, strict=True)):
        assert low <= inputs[..., i].min() < low + 0.02 * (high - low) and inputs[..., i].max() <= high
    spans = [np.diff(np.flatnonzero(np.diff(row, prepend=np.nan))) for row in inputs[..., 1]]
    lengths = np.concatenate(spans)
    assert lengths.min() >= 60 and lengths.max() <= 160 and abs(lengths.mean() - 110) < 4  # sd 29, 400 of them
    make = type(SAILING)
    for call, line in (
        (partial(make, low=2.0, high=1.0), "low must be at most high, 1.0, but got 2.0"),
        (partial(make, shortest=60, longest=30), "longest must be a whole number of at least 60, but got 30"),
    ):
        refused(line, call)


@pytest.mark.slow
def test_a_tuned_file_keeps_which_states_its_model_has_and_goes_on_an_env(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scenario = VEHICLES["auv:motion"].replace(name="mine.toml", **SHORT)
    write_untuned("tuned.json", scenario)
    choice, again, _ = read_tuned("tuned.json")
    assert again == scenario and choice.filter(again).model.n == 8
    env = EstimateState(gym.make("SegorogeniAUV-v0", sensors="motion"), tuned="tuned.json")
    assert env.reset(seed=1)[1]["estimate"].shape == (8,)
    others = {"sensors": {"sensors": "default"}, "dt": {"dt": 0.1}, "preset": {"preset": "remus100"}}
    for rule, other in others.items():
        line = f"must be for the plant it is used with, but .* was tuned for {rule}"
        with pytest.raises(ValueError, match=line):
            EstimateState(gym.make("SegorogeniAUV-v0", **{"sensors": "motion", **other}), tuned="tuned.json")
    refused("a plant's data must have", EstimateState, gym.make("BowThruster-v0"), tuned="tuned.json")


@pytest.mark.slow
def test_a_filter_that_estimates_the_current_is_consistent_where_one_without_it_is_lost():
    nees = []
    for name in ("auv:current", "auv:estimated_current"):
        scenario = VEHICLES[name].replace(steps=300, first_scored_step=10)
        data, choice = scenario.data(range(8)), untuned_choice("ekf", scenario)._replace(model=scenario.true)
        estimates = run(choice.filter(scenario), data.filter_keys, data.inputs, data.measurements)
        error = (estimates.means - data.states)[:, 10:, :8]
        inverse = np.linalg.inv(estimates.covs[:, 10:, :8, :8])
        nees.append(np.einsum("bki,bkij,bkj->bk", error, inverse, error).mean())
    assert nees[0] > 100.0
    assert nees[1] == pytest.approx(8.0, abs=1.0)
