"""Suites at their rates, satellites at the surface, and the current that the vehicle goes in."""

import math

import gymnasium as gym
import numpy as np
import pytest

from thruster_env.auv.equations import simulate
from thruster_env.auv.plant import CHANNELS, INSTRUMENTS, SUITES, VEHICLE_SENSOR_EFFECTS, make_current, make_plant
from thruster_env.effects.sensors import SENSOR_EFFECTS

pytestmark = pytest.mark.usefixtures("as_python")
QUIET = {"process_noise_cov": [0.0] * 12, "sensors": "motion"}
REST = {"initial_state": {"speed": 0.0}}
KEYS = np.array([[1.0, 2.0]])


def run(actions, count=None, **given):
    inputs = np.broadcast_to(np.asarray(actions, dtype=float), (1, count or len(actions), 3))
    return simulate(make_plant(**QUIET | given), KEYS, inputs)


def test_each_channel_of_a_suite_comes_at_the_rate_of_its_instrument():
    plant = make_plant(sensors="full")
    valid = simulate(plant, KEYS, np.full((1, 80, 3), 0.1)).valid[0]
    for i, name in enumerate(plant.channels):
        instrument = next(one for one in INSTRUMENTS.values() if name in one.channels)
        every = round(20.0 / instrument.rate)
        np.testing.assert_array_equal(valid[:, i], np.arange(81) % every == 0, err_msg=name)
    assert plant.measurement_noise_cov[0, 0] == 0.02**2 and len(plant.channels) == len(CHANNELS)


@pytest.mark.parametrize("dt, every", [(0.05, 4), (0.01, 20), (0.2, 1), (1.0, 1)])
def test_a_rate_is_kept_at_another_sample_time(dt, every):
    chain = make_plant(sensors=["u"], dt=dt, substeps=1).sensors["u"]
    assert [effect.steps for effect in chain] == ([every] if every > 1 else [])


def test_between_samples_the_last_one_is_repeated_and_flagged():
    env = gym.make("SegorogeniAUV-v0", sensors={"u": [{"name": "sample-every", "steps": 3, "first": 1}], "q": []})
    seen = [env.reset(seed=1)[0]] + [env.step([2.845, 0.0, 0.0])[0] for _ in range(9)]
    u, q, valid = np.array(seen).T
    np.testing.assert_array_equal(valid, np.arange(10) % 3 == 1)
    held = [0.0, *np.repeat(u[1::3], 3)][:10]
    np.testing.assert_array_equal(u, held)
    assert len(set(q)) == 10 and len(set(u)) == 4


def test_satellites_are_seen_near_the_surface_only():
    depths = [0.0, 0.9, 1.1, 5.0, -1.0]
    seen = []
    for depth in depths:
        env = gym.make("SegorogeniAUV-v0", sensors="full")
        info = env.reset(seed=1, options={"state": [1.0] + [0.0] * 10 + [depth]})[1]
        seen.append(info["measurement_valid"][-2:].tolist())
        assert info["measurement_valid"][:-2].all() and np.isfinite(info["measurement"]).all()
    assert seen == [[depth < 1.0] * 2 for depth in depths]


def test_every_suite_makes_an_env_and_the_vehicle_has_the_effects_of_all_plants(monkeypatch):
    monkeypatch.setitem(SENSOR_EFFECTS.effects, "frost", SENSOR_EFFECTS.effects["bias"])  # registered later
    for name in SUITES:
        env = gym.make("SegorogeniAUV-v0", sensors=name)
        assert env.reset(seed=0)[0].shape == env.observation_space.shape
    assert set(SENSOR_EFFECTS.effects) < set(VEHICLE_SENSOR_EFFECTS.effects)


def test_a_vehicle_adrift_takes_on_the_velocity_of_the_current():
    """It turns, too, and its drag goes with the square of what is left: the last of that goes slowly."""
    current = np.array([0.3, -0.2, 0.1])
    states = run([0.0, 0.0, 0.0], 1600, current=current, **REST).states[0]
    left = np.linalg.norm(np.diff(states[:, 9:12], axis=0) / 0.05 - current, axis=1)
    assert left[0] == pytest.approx(np.linalg.norm(current), rel=0.01)
    assert left[1599] < 0.1 * left[0] and left[1599] < left[799] < 0.2 * left[0]


def test_adrift_from_the_start_nothing_changes():
    still = [0.3, -0.2, 0.1] + [0.0] * 9  # at rest in the water: body axes are those of the earth
    states = run([0.0, 0.0, 0.0], 40, current=still[:3], initial_state=still).states[0]
    np.testing.assert_allclose(states[:, :9], np.broadcast_to(still[:9], (41, 9)), atol=1e-13)
    np.testing.assert_allclose(states[-1, 9:], np.multiply(2.0, still[:3]), rtol=1e-12)


def test_in_steady_water_the_motion_is_that_of_still_water_carried_along():
    """Galilean invariance: over ground minus the current's way and velocity, with the planes at work."""
    actions = np.random.default_rng(1).uniform([2.0, -0.2, -0.2], [4.0, 0.2, 0.2], (1, 60, 3))
    current, start = np.array([0.4, -0.3, 0.0]), np.zeros(12)
    start[0] = 1.0
    moving = start.copy()
    moving[:3] += current
    given = {"process_noise_cov": [0.0] * 12, "sensors": "motion"}
    still = simulate(make_plant(initial_state=start, **given), KEYS, actions).states[0]
    carried = simulate(make_plant(initial_state=moving, current=current, **given), KEYS, actions).states[0]
    np.testing.assert_allclose(carried[:, 3:9], still[:, 3:9], atol=1e-7)  # the current's step in the body's axes
    way = 0.05 * np.arange(61)[:, None] * current
    np.testing.assert_allclose(carried[:, 9:], still[:, 9:] + way, atol=1e-6)
    assert np.abs(np.diff(still[:, 8])).max() > 1e-3


def test_a_gauss_markov_current_is_stationary_in_the_earths_axes():
    signals = {
        "east": [{"name": "gauss-markov", "std": 0.2, "time_constant": 0.5}, {"name": "constant", "value": 1.0}]
    }
    env = gym.make("SegorogeniAUV-v0", current=signals)
    found = [env.reset(seed=0)[1]["current"]] + [env.step([0.0, 0.0, 0.0])[-1]["current"] for _ in range(1500)]
    north, east, down = np.array(found).T
    assert not north.any() and not down.any()
    assert east.mean() == pytest.approx(1.0, abs=0.1) and east.std() == pytest.approx(0.2, rel=0.2)
    lag = np.corrcoef(east[:-1], east[1:])[0, 1]
    assert lag == pytest.approx(math.exp(-0.1), abs=0.04)


def test_currents_have_one_form():
    assert make_current(None) == {} == make_current([0.0, 0, 0])
    assert make_current({"down": 0.1}) == make_current({"down": [{"name": "constant", "value": 0.1}]})
    assert list(make_current({"east": 0.1, "north": 0.2})) == ["north", "east"]
