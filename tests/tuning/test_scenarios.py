import dataclasses

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the env
from filters import EstimateState, run
from filters.bounds import riccati_covariances
from thruster_env.thruster.model import model_of_plant
from tuning.problems.data import held_out_seeds, training_seeds
from tuning.problems.scenario import print_scales
from tuning.search.space import untuned_choice
from tuning.thruster.scenario import SCENARIOS, Scenario, find_scenario


def test_an_env_stepped_with_a_scenarios_voltages_makes_the_scenarios_data_and_estimates():
    scenario = find_scenario("mismatch")
    data = scenario.data([7, 8])
    choice = untuned_choice("ekf", scenario)
    estimates = run(choice.filter(scenario), data.filter_keys, data.inputs, data.measurements)
    env = EstimateState(
        gym.make(
            "BowThruster-v0",
            process_noise_cov=scenario.process_noise_cov,
            measurement_noise_cov=scenario.measurement_noise_cov,
        ),
        filter="ekf",
        model_arguments={"parameter_factors": dict(scenario.parameter_factors), **choice.model},
    )
    _, info = env.reset(seed=8)
    for k in range(scenario.steps):
        np.testing.assert_allclose(info["measurement"], data.measurements[1, k], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(info["estimate"], estimates.means[1, k], rtol=1e-12, atol=1e-12)
        # float64 actions: a float32 would round the voltage
        _, _, _, _, info = env.step(data.inputs[1, k])
    np.testing.assert_allclose(info["state"], data.states[1, -1], rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("name", SCENARIOS)
def test_every_scenario_s_data_are_those_of_an_env_of_its_plant(name):
    scenario = SCENARIOS[name].replace(steps=60)
    data = scenario.data([5, 11])
    env = gym.make(
        "BowThruster-v0" if scenario.system is None else "BowThrusterLinear-v0", **scenario.plant_arguments
    )
    _, info = env.reset(seed=11)
    for k in range(60):
        valid = info.get("measurement_valid", [True])[0]
        assert np.isnan(data.measurements[1, k, 0]) == (not valid)
        if valid:
            assert info["measurement"][0] == data.measurements[1, k, 0]
        np.testing.assert_array_equal(info["state"], data.states[1, k])
        assert info["thrust"] == data.outputs["T"][1, k]
        _, _, _, _, info = env.step(data.inputs[1, k])


def test_what_a_scenario_is_named_for_is_in_its_data():
    def data(name):
        return find_scenario(name).data(range(20))

    nominal = data("nominal")
    for name in ("outliers", "dropout", "mismatch"):  # the same truth, whatever spoils the sensor or the model
        np.testing.assert_array_equal(data(name).states, nominal.states)
    errors = np.abs(data("outliers").measurements[..., 0] - nominal.outputs["T"])
    assert 0.02 < (errors > 4.0).mean() < 0.08
    assert 0.3 < np.isnan(data("dropout").measurements).mean() < 0.7
    biased = data("bias")
    offsets = (biased.measurements[..., 0] - biased.outputs["T"]).mean(axis=1)
    assert 1.0 < offsets.std() < 2.5
    assert (data("quantised").measurements % 4.0 == 0).all()
    assert np.abs(data("startup").states[:, 0]).mean(axis=0)[0] > 40.0
    swallowed = data("deadband").states[:, 100:, 0].std() / data("quantised").states[:, 100:, 0].std()
    assert swallowed < 0.9
    flows = data("ambient").states[:, 300:, 1] - nominal.states[:, 300:, 1]
    assert flows.mean(axis=1).std() > 0.1
    assert (data("speed_magnitude").measurements > -4.0).all()
    mixed = data("mixed")
    assert np.abs(mixed.inputs).max() > 12.0 and np.isnan(mixed.measurements).any()


def test_training_and_held_out_seeds_never_meet():
    for seed in range(3):
        assert not set(training_seeds(seed, 1000)) & set(held_out_seeds(seed, 1000))
    assert not set(held_out_seeds(0, 1000)) & set(training_seeds(1, 1000))


def test_voltages_hold_their_level_and_fill_the_range():
    data = find_scenario("nominal").data(range(40))
    levels = data.inputs[:, :, 0].reshape(40, 20, 25)
    assert (levels == levels[:, :, :1]).all()
    assert np.abs(levels).max() < 12.0
    # 800 uniform draws on +-12: standard error of the mean 0.245, of the mean square 0.107 * 144 / sqrt(800/...)
    assert abs(levels[:, :, 0].mean()) < 5 * 0.245
    assert abs((levels[:, :, 0] ** 2).mean() - 48.0) < 5 * 48.0 * np.sqrt(0.8 / 800)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["nominal", "published_noise", "speed_magnitude", "reversal", "bias", "mixed"])
def test_the_stored_scale_is_the_bound(name):
    scenario = find_scenario(name)
    np.testing.assert_allclose(scenario.computed_scale(120, truths=50), scenario.scale, rtol=0.03)


@pytest.mark.parametrize("name", ["published_tunnel", "published_open_bladed"])
def test_the_scale_of_a_linear_scenario_is_riccatis(name):
    scenario = find_scenario(name)
    _, posterior = riccati_covariances(scenario.model())
    np.testing.assert_allclose(scenario.scale, np.sqrt(np.diag(posterior)), rtol=1e-3)


def test_the_scale_of_the_published_tunnel_is_the_optimum_of_the_papers_runs():
    assert find_scenario("published_tunnel").scale == (0.8066, 0.1457)


def test_anyone_can_compute_a_scale_anew(capsys, monkeypatch):
    monkeypatch.setattr(Scenario, "scale_sequences", 2)  # on which a linear bound does not depend
    print_scales(SCENARIOS, ["published_tunnel"])
    assert capsys.readouterr().out == "published_tunnel: (0.8066, 0.1457), stored (0.8066, 0.1457)\n"


def test_scenarios_with_the_same_gaussian_core_share_its_scale():
    for name in ("mismatch", "ambient", "outliers", "dropout"):
        assert SCENARIOS[name].scale == SCENARIOS["nominal"].scale
    assert SCENARIOS["deadband"].scale == SCENARIOS["quantised"].scale
    assert dict(SCENARIOS["mismatch"].parameter_factors) == {"lift_coefficient": 1.15, "voltage_gain": 0.95}


def test_untuned_is_one_per_cent_of_each_range_and_the_sheets_noise():
    untuned = find_scenario("nominal").untuned
    # 24 V: 387.515 rad/s and 7.347 m/s, so the ranges over +-24 V are twice that
    np.testing.assert_allclose(np.sqrt(untuned["process_noise_cov"]), [7.7503, 0.14694], rtol=1e-4)
    assert untuned["measurement_noise_cov"] == 0.25


def test_scenarios_and_their_data_cannot_be_changed():
    scenario = find_scenario("nominal")
    with pytest.raises(dataclasses.FrozenInstanceError):
        scenario.steps = 3
    with pytest.raises(TypeError):
        SCENARIOS["mismatch"].parameter_factors["area"] = 2.0
    with pytest.raises(TypeError):
        SCENARIOS["outliers"].sensors["thrust"][0]["std"] = 2.0
    with pytest.raises(ValueError, match="read-only"):
        scenario.data([1]).states[0, 0, 0] = 1.0


def test_scenarios_are_values():
    for scenario in SCENARIOS.values():
        again = scenario.replace()
        assert again == scenario and hash(again) == hash(scenario) and again is not scenario
        assert scenario.replace(amplifier=[{"name": "sag", "fraction": 0.1}]) != scenario
    assert len(set(SCENARIOS.values())) == len(SCENARIOS)


def test_voltages_are_cut_off_as_the_env_does():
    data = find_scenario("nominal").replace(max_voltage=6.0).data(range(3))
    assert np.abs(data.inputs).max() == 6.0


@pytest.mark.parametrize(
    ("call", "rule"),
    [
        (lambda: find_scenario("none"), "scenario must be one of .* but got 'none'"),
        (lambda: training_seeds(-1, 5), "seed must be a whole number of at least 0, but got -1"),
        (lambda: held_out_seeds(0, 1), "held-out seeds must be a whole number of at least 2, but got 1"),
    ],
)
def test_bad_arguments_name_rule_and_value(call, rule):
    with pytest.raises(ValueError, match=rule):
        call()


@pytest.mark.parametrize("name", ["mismatch", "published_tunnel", "deadband"])
def test_a_model_of_another_q_and_r_is_the_one_that_is_made_of_them(name):
    scenario = find_scenario(name)
    noise = {"process_noise_cov": (0.3, 1e-3), "measurement_noise_cov": 0.7}
    made = model_of_plant(scenario.plant, parameter_factors=dict(scenario.parameter_factors), **noise)
    found = scenario.model(**noise)
    assert found.digest == made.digest and np.array_equal(found.numbers, made.numbers)
    assert found.functions == made.functions and found.shape == made.shape
    assert scenario.model().process_noise_cov == pytest.approx(np.diag(scenario.process_noise_cov))
    for wrong in ({"process_noise_cov": (1.0, -1.0)}, {"measurement_noise_cov": 0.0}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} must be positive"):
            scenario.model(**wrong)
    found.prior_mean[:] = found.measurement_noise_cov[:] = 7.0  # of the caller alone
    assert np.array_equal(scenario.model(**noise).numbers, made.numbers)


def test_a_bound_is_computed_once_for_the_same_inputs(monkeypatch):
    import tuning.problems.model_problem as module

    monkeypatch.setattr("tuning.problems.model_problem._known", {})
    monkeypatch.setattr("thruster_env.graphs.loops.Loops.folder", None)  # nothing on the disk
    asked, computed = [], module.posterior_variances
    monkeypatch.setattr(
        module, "posterior_variances", lambda *given, **named: asked.append(1) or computed(*given, **named)
    )
    scenario = find_scenario("nominal").replace(about="a plant of this test")
    one, other = scenario.data([1]), scenario.data([2])
    first = scenario.bound(one, truths=3)
    kept = first.copy()
    first[:] = 0.0  # of the caller alone
    assert np.array_equal(scenario.bound(one, truths=3), kept) and len(asked) == 1
    assert not np.array_equal(scenario.bound(other, truths=3), kept) and len(asked) == 2
    whole = one._replace(inputs=np.round(one.inputs))  # whatever type its numbers are of
    of_integers = whole._replace(inputs=whole.inputs.astype(np.int64))
    assert np.array_equal(scenario.bound(of_integers, truths=3), scenario.bound(whole, truths=3))
    assert len(asked) == 3
    noisier = scenario.replace(process_noise_cov=(4.0, 1.6e-3))
    assert (noisier.bound(one, truths=3) > kept).all() and len(asked) == 4
