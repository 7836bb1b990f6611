"""The vehicle's scenarios: data are an env's, scales are Riccati's, and an EKF is consistent on them."""

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - as well
import thruster_env.auv  # noqa: F401 - registers the envs
from filters import EstimateState, make_filter, run
from tests.slow import slow_but
from tests.tuned_files import write_untuned
from thruster_env.auv.paths import MANOEUVRES
from thruster_env.core.streams import episode_keys
from tuning.auv.scenario import SAILING, SCENARIOS, find_scenario
from tuning.evaluation.evaluate import evaluate
from tuning.evaluation.tuned import read_tuned
from tuning.problems.check import checked_problem
from tuning.problems.excitation import EXCITATIONS, Levels
from tuning.problems.find import find_problem, scenario_of


def short(name, **changes):
    return find_scenario(name).replace(steps=60, first_scored_step=10, **changes)


@pytest.mark.parametrize(
    "name", slow_but(["auv:dvl_dropout", "auv:estimated_current", "auv:papers"], ["auv:papers"])
)
def test_data_are_those_of_the_env_with_the_same_seed(name):
    scenario = short(name)
    data = scenario.data([5])
    env = gym.make("SegorogeniAUV-v0", **scenario.plant_arguments).unwrapped
    _, info = env.reset(seed=5)
    for k, action in enumerate([*data.inputs[0], None]):
        seen = np.where(info.get("measurement_valid", True), info["measurement"], np.nan)
        whole = np.append(info["state"], info["current"])
        np.testing.assert_array_equal(data.states[0, k], whole[: scenario.count])
        np.testing.assert_array_equal(data.measurements[0, k], seen)
        if action is not None:
            info = env.step(action)[-1]


@pytest.mark.parametrize("name", SCENARIOS)
def test_model_data_names_and_scale_fit(name):
    checked_problem(short(name))
    assert find_problem(name) == SCENARIOS[name]


def test_what_one_instrument_measures_is_lost_together():
    lost = np.isnan(find_scenario("auv:dvl_dropout").data(range(3)).measurements)
    assert (lost[..., 0] == lost[..., 1]).all() and (lost[..., 0] == lost[..., 2]).all()
    assert 0.8 < lost[..., 0].mean() < 0.95 and not lost[..., 3:9].any()  # every fourth, and half of these
    both = find_scenario("auv:motion").replace(
        sensors={name: [{"name": "dropout", "probability": 0.5}] for name in ("u", "p")},
        measurement_noise_cov=[1e-4, 1e-4],
    )
    lost = np.isnan(both.data([0]).measurements[0])
    assert 0.4 < (lost[:, 0] != lost[:, 1]).mean() < 0.6


@pytest.mark.slow
def test_scales_are_those_of_the_code():
    for name in ("auv:motion", "auv:navigation"):
        found = find_scenario(name).computed_scale(6)
        np.testing.assert_allclose(found, find_scenario(name).scale, rtol=0.08)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["auv:motion", "auv:navigation"])
def test_an_extended_filter_is_consistent_and_on_its_scale(name):
    scenario = find_scenario(name)
    found = evaluate(make_filter("ekf", scenario.model(**scenario.true)), scenario.data(range(24)), scenario.scale)
    n = scenario.count
    assert found.nees.low - 0.1 < n < found.nees.high + 0.1 and abs(found.nees.value - n) < 0.08 * n
    assert found.nis.low - 0.05 < found.expected_nis < found.nis.high + 0.05
    assert np.array([rmse.value for rmse in found.rmse[:8]]) == pytest.approx(scenario.scale[:8], rel=0.05)
    assert found.divergences == 0


def test_levels_are_held_as_long_as_is_said():
    made = SAILING.inputs(episode_keys(range(40)), 1200, 0.05, 3)
    for i, (low, high) in enumerate(zip(SAILING.low, SAILING.high, strict=True)):
        assert low <= made[..., i].min() < low + 0.02 * (high - low) and made[..., i].max() <= high
    held = [np.diff(np.flatnonzero(np.diff(one, prepend=np.nan))) for one in made[..., 1]]
    lengths = np.concatenate(held)
    assert lengths.min() >= 60 and lengths.max() <= 160 and abs(lengths.mean() - 110) < 4  # sd 29, 400 of them
    assert EXCITATIONS.make([SAILING.as_mapping()])[0] == SAILING
    with pytest.raises(ValueError, match="low must be at most high, 1.0, but got 2.0"):
        Levels(low=2.0, high=1.0)
    with pytest.raises(ValueError, match="longest must be a whole number of at least 60, but got 30"):
        Levels(shortest=60, longest=30)


def test_manoeuvres_are_those_of_the_plant_with_and_without_a_torque():
    scenario = short("auv:papers", propeller_torque=None)
    inputs = scenario.data([0, 1]).inputs
    np.testing.assert_array_equal(inputs[0], inputs[1])
    np.testing.assert_allclose(inputs[0, 30], MANOEUVRES["IV"].inputs(0.0305))
    assert short("auv:papers").data([0]).inputs.shape[-1] == 3


@pytest.mark.slow
def test_a_file_says_whose_scenario_it_is(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.toml").write_text(
        'plant = "auv"\nbase = "auv:navigation"\nsteps = 60\nfirst_scored_step = 10\ncurrent = [0.1, 0.0, 0.0]\n'
    )
    found = find_problem("my.toml")
    assert found.states == "navigation" and 0.3 < found.scale[9] / SCENARIOS["auv:navigation"].scale[9] < 1
    again = scenario_of(found.as_mapping(), found.name, "a.json")
    assert again == found and again.digest == found.digest
    with pytest.raises(ValueError, match="scenario must be one of nominal, .* but got 'auv:motion'"):
        (tmp_path / "my.toml").write_text('base = "auv:motion"')
        find_problem("my.toml")


@pytest.mark.parametrize(
    ("change", "line"),
    [
        (
            {"states": "motion", "scale": (1.0,) * 8},
            "sensors of a model of 8 states must measure u, v, .*, but got psi, z",
        ),
        ({"states": "all"}, "states must be one of velocities, motion, navigation, current, but got 'all'"),
        ({"scale": (1.0,) * 8}, "scale must be 12 finite numbers"),
        (
            {"measurement_noise_cov": 1.0},
            "measurement_noise_cov must be 1 to 14 variances, one for each channel",
        ),
        ({"preset": "titanic"}, "preset must be"),
        ({"excitation": {"name": "manoeuvre", "path": "V"}}, "path must be one of I, II, III, IV, dynamic"),
    ],
)
def test_what_is_wrong_is_one_clear_line(change, line):
    with pytest.raises(ValueError, match=line) as error:
        scenario = find_scenario("auv:navigation").replace(**change)
        scenario.model()
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_a_tuned_file_keeps_which_states_its_model_has_and_goes_on_an_env(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scenario = short("auv:motion").replace(name="mine.toml")
    write_untuned("tuned.json", scenario)
    choice, found, _ = read_tuned("tuned.json")
    assert found == scenario and choice.filter(found).model.n == 8
    env = EstimateState(gym.make("SegorogeniAUV-v0", sensors="motion"), tuned="tuned.json")
    assert env.reset(seed=1)[1]["estimate"].shape == (8,)
    others = {"sensors": {"sensors": "default"}, "dt": {"dt": 0.1}, "preset": {"preset": "remus100"}}
    for rule, other in others.items():
        with pytest.raises(
            ValueError, match=f"must be for the plant it is used with, but .* was tuned for {rule}"
        ):
            EstimateState(gym.make("SegorogeniAUV-v0", **{"sensors": "motion", **other}), tuned="tuned.json")
    with pytest.raises(ValueError, match="a plant's data must have"):
        EstimateState(gym.make("BowThruster-v0"), tuned="tuned.json")


@pytest.mark.slow
def test_a_filter_that_estimates_the_current_is_consistent_where_one_without_it_is_lost():
    lost, told = (short(name).replace(steps=300) for name in ("auv:current", "auv:estimated_current"))
    nees = []
    for scenario in (lost, told):
        data = scenario.data(range(8))
        found = run(
            make_filter("ekf", scenario.model(**scenario.true)), data.filter_keys, data.inputs, data.measurements
        )
        error = (found.means - data.states)[:, 10:, :8]
        inverse = np.linalg.inv(found.covs[:, 10:, :8, :8])
        nees.append(np.einsum("bki,bkij,bkj->bk", error, inverse, error).mean())
    assert nees[0] > 100.0
    assert nees[1] == pytest.approx(8.0, abs=1.0)
