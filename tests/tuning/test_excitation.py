import dataclasses

import gymnasium as gym
import numpy as np
import pytest

import thruster_env  # noqa: F401 - registers the envs
from thruster_env.core.streams import episode_keys
from thruster_env.thruster.controllers import PIController
from thruster_env.thruster.plant import make_plant
from tuning.plants.thruster import ClosedLoop, find_scenario, voltages_of
from tuning.problems.excitation import EXCITATIONS, BinarySequence, Dwells, MultiSine, Steps

PLANT = make_plant()
KEYS = episode_keys(range(40))
OF_ANY_PLANT = [kind for kind in EXCITATIONS.effects.values() if kind.__module__ != "tuning.plants.auv"]
every_excitation = pytest.mark.parametrize("kind", OF_ANY_PLANT)


@every_excitation
def test_a_seed_s_voltages_depend_on_that_seed_alone(kind):
    together = voltages_of(kind(), PLANT, KEYS, 120)
    assert together.shape == (40, 120) and np.isfinite(together).all()
    np.testing.assert_array_equal(together, voltages_of(kind(), PLANT, KEYS, 120))
    np.testing.assert_array_equal(together[7:9], voltages_of(kind(), PLANT, KEYS[7:9], 120))
    assert len(np.unique(together, axis=0)) > 10, "seeds differ"


@every_excitation
def test_an_excitation_is_a_value_that_json_can_hold(kind):
    one = kind()
    (again,) = EXCITATIONS.make([one.as_mapping()])
    assert again == one and hash(again) == hash(one)
    with pytest.raises(dataclasses.FrozenInstanceError):
        setattr(one, dataclasses.fields(one)[0].name, 1.0)


def test_a_binary_sequence_has_two_levels_with_equal_chance_and_holds_them():
    voltages = voltages_of(BinarySequence(amplitude=5.0, hold=10), PLANT, KEYS, 500)
    levels = voltages.reshape(40, 50, 10)
    assert set(np.unique(voltages)) == {-5.0, 5.0} and (levels == levels[:, :, :1]).all()
    assert abs((levels[:, :, 0] > 0).mean() - 0.5) < 5 * 0.5 / np.sqrt(2000)


def test_sines_have_their_amplitude_offset_and_periods():
    voltages = voltages_of(MultiSine(amplitude=3.0, offset=1.0, periods=(0.5, 0.2)), PLANT, KEYS, 500)
    spectrum = np.abs(np.fft.rfft(voltages, axis=1)) / 500
    expected = np.zeros(251)
    expected[[0, 10, 25]] = 1.0, 1.5, 1.5  # 5 s hold ten and 25 periods
    np.testing.assert_allclose(spectrum, np.broadcast_to(expected, spectrum.shape), atol=1e-9)


def test_dwells_rest_at_zero_half_of_the_time_and_move_slowly_between():
    excitation = Dwells(amplitude=2.0, ramp=50, dwell=25)
    voltages = voltages_of(excitation, PLANT, KEYS, 750)
    assert np.abs(voltages).max() <= 2.0
    assert np.abs(np.diff(voltages)).max() <= 2 * 2.0 / 50 + 1e-12
    rests = voltages.reshape(40, 10, 75)[:, :, :25]
    assert (rests == rests[:, :, :1]).all()
    assert abs((rests[:, :, 0] == 0).mean() - 0.5) < 5 * 0.5 / np.sqrt(400)
    crossed = (voltages[:, :-1] < 0) & (voltages[:, 1:] > 0)
    assert crossed.sum() > 20


@pytest.mark.parametrize("name", ["nominal", "mixed"])
def test_a_closed_loop_is_that_of_the_tracking_env_under_pi(name):
    loop = ClosedLoop(low=-0.4, high=0.6, hold_time=0.3)
    scenario = find_scenario(name).replace(excitation=loop, steps=80)
    data = scenario.data([3, 4])
    env = gym.make(
        "BowThrusterTracking-v0",
        reference=[{"name": "steps", "low": -0.4, "high": 0.6, "hold_time": 0.3}],
        **scenario.plant_arguments,
    )
    controller, state = PIController.for_env(env), None
    observation, info = env.reset(seed=4)
    for k in range(80):
        action, state = controller.predict(observation, state)
        assert action[0] == data.inputs[1, k, 0]
        observation, _, _, _, info = env.step(action)
    np.testing.assert_array_equal(info["state"], data.states[1, -1])


@pytest.mark.parametrize(
    ("make", "rule"),
    [
        (lambda: Steps(amplitude=-1.0), "amplitude must be zero or positive, but got -1.0"),
        (lambda: Steps(hold=0), "hold must be a whole number of at least 1, but got 0"),
        (lambda: MultiSine(periods=(1.0, 0.0)), "periods must be positive, but got 0.0"),
        (lambda: Dwells(zeros=2.0), "zeros must be within plus and minus 1, but got 2.0"),
        (lambda: ClosedLoop(low=1.0, high=0.0), "low must be at most high, but got 1.0 and 0.0"),
        (
            lambda: EXCITATIONS.make([{"name": "noise"}]),
            "each entry of excitation must be a mapping whose name is",
        ),
    ],
)
def test_wrong_arguments_are_refused_with_the_rule_and_the_value(make, rule):
    with pytest.raises(ValueError, match=rule):
        make()


def test_a_closed_loop_needs_the_thrust():
    plant = make_plant(sensors=["speed"])
    with pytest.raises(ValueError, match="a closed loop must measure the thrust, but got speed"):
        ClosedLoop().voltages(plant, KEYS, 10)
