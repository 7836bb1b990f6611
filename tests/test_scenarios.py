import dataclasses

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the env
from filters import EstimateState, run
from tuning.scenarios import (
    SCENARIOS,
    find_scenario,
    held_out_seeds,
    training_seeds,
)
from tuning.space import untuned_choice


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
        parameter_factors=dict(scenario.parameter_factors),
        **choice.model,
    )
    _, info = env.reset(seed=8)
    for k in range(scenario.steps):
        np.testing.assert_allclose(info["measurement"], data.measurements[1, k], rtol=1e-12, atol=1e-12)
        np.testing.assert_allclose(info["estimate"], estimates.means[1, k], rtol=1e-12, atol=1e-12)
        # float64 actions: a float32 would round the voltage
        _, _, _, _, info = env.step(data.inputs[1, k])
    np.testing.assert_allclose(info["state"], data.states[1, -1], rtol=1e-12, atol=1e-12)


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


@pytest.mark.parametrize("name", ["nominal", "published_noise"])
def test_the_stored_scale_is_the_bound(name):
    scenario = find_scenario(name)
    bound = scenario.bound(scenario.data(range(120)), truths=50)
    np.testing.assert_allclose(bound, scenario.scale, rtol=0.03)


def test_mismatch_shares_the_scale_of_its_gaussian_core():
    assert SCENARIOS["mismatch"].scale == SCENARIOS["nominal"].scale
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
    with pytest.raises(ValueError, match="read-only"):
        scenario.data([1]).states[0, 0, 0] = 1.0


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
