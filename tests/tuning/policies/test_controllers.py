"""Policies that correct a controller, and policies on the underwater vehicle, with PD beside them."""
# ruff: noqa: F811 - fixtures come by import and go by name

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

import gymnasium as gym

import thruster_env.auv  # noqa: F401 - registers the envs
from tests.filters.checks import refused
from tests.learners import COPIES, LIMIT, SMALL, learn, setup_of, short_episodes  # noqa: F401 - some are fixtures
from tuning.policies.environments import make_environments, make_single
from tuning.policies.saved import classical_policy, configuration_from_json, find_saved, load, run_episodes, score
from tuning.policies.setup import PLANTS, TASKS, Part, in_scenario, make_configuration, plant_of
from tuning.problems.data import held_out_seeds
from tuning.problems.find import find_problem

SEEDS = list(range(10, 10 + COPIES))
SHARE = 0.2
NOTHING = np.zeros((COPIES, 1), dtype=np.float32)


class Nothing:
    def predict(self, observation, state=None, episode_start=None, deterministic=True):
        return np.zeros((len(observation), 1), dtype=np.float32), state


@pytest.mark.parametrize("name", ["one-step", "mpc"])
@pytest.mark.parametrize("observe", ["true", "ekf", "belief"])
def test_a_policy_that_corrects_nothing_is_the_controller(name, observe):
    alone = setup_of(observe)
    corrected, seeds = setup_of(observe, controller=name), held_out_seeds(0, 3)
    expected = score(classical_policy(name, alone), alone, seeds)
    np.testing.assert_array_equal(score(Nothing(), corrected, seeds).returns, expected.returns)


def test_what_the_controller_would_do_is_shown_and_what_is_applied_is_clipped():
    venv = make_environments(setup_of("ekf", controller="one-step"), SEEDS)
    seen, generator = venv.reset(), np.random.default_rng(0)
    plain = make_environments(setup_of("ekf"), SEEDS)
    assert seen.shape[1] == plain.reset().shape[1] + 1 == 5
    for _ in range(LIMIT - 2):
        actions = generator.uniform(-1.5, 1.5, (COPIES, 1)).astype(np.float32)
        applied = np.clip(seen[:, -1:] + SHARE * np.clip(actions, -1, 1), -1, 1)
        seen, rewards, *_ = venv.step(actions)
        expected, same, *_ = plain.step(applied)
        np.testing.assert_allclose(seen[:, :-1], expected, rtol=1e-5, atol=1e-5)
        np.testing.assert_allclose(rewards, same, rtol=1e-5)


def test_it_counts_the_voltage_that_was_really_applied():
    """The cost of a change is that from the corrected voltage, so after a correction another one is best."""
    heavy = {"voltage_rate_weight": 10.0}
    setup = setup_of("true", controller="one-step")
    venv = make_environments(replace(setup, env_arguments={**setup.env_arguments, **heavy}), SEEDS)
    proposals = []
    for action in (NOTHING, NOTHING + 1):
        venv.unwrapped._seeds = list(SEEDS)
        venv.reset()
        proposals.append(venv.step(action)[0][:, -1])
    # With so heavy a weight the next voltage is near the last one, which was SHARE higher.
    np.testing.assert_allclose(proposals[1] - proposals[0], SHARE, atol=0.05)


def test_native_and_single_envs_and_the_end_of_an_episode_are_alike():
    setup = setup_of("ekf", controller="mpc")
    ours, theirs = (make_environments(setup, SEEDS, native=native) for native in (True, False))
    np.testing.assert_allclose(ours.reset(), theirs.reset(), rtol=1e-4, atol=1e-4)
    generator, ended = np.random.default_rng(1), 0
    for _ in range(LIMIT + 3):
        actions = generator.uniform(-1, 1, (COPIES, 1)).astype(np.float32)
        mine, expected = ours.step(actions), theirs.step(actions)
        np.testing.assert_allclose(mine[0], expected[0], rtol=1e-3, atol=1e-3)
        for one, other in zip(mine[3], expected[3], strict=True):
            if "terminal_observation" in one:
                last = one["terminal_observation"]
                assert last.shape == (5,) and abs(last[-1]) <= 1
                np.testing.assert_allclose(last, other["terminal_observation"], rtol=1e-3, atol=1e-3)
                ended += 1
    assert ended == COPIES


@pytest.mark.parametrize("algo", ["ppo", "sac"])
def test_a_correction_is_learnt_saved_and_scored(algo, tmp_path):
    setup = setup_of("ekf", algo, controller="one-step")
    run = learn(setup, tmp_path / "policy")
    assert configuration_from_json(setup.as_json(), "setup.json") == setup and setup.controller == "one-step"
    seeds = held_out_seeds(0, 2)
    policy = load(find_saved(run.folder), make_environments(setup, seeds))
    assert (score(policy, setup, seeds).returns < 0).all()
    with pytest.raises(ValueError, match="must see 5 numbers, but the env shows 4"):
        load(find_saved(run.folder), make_environments(setup_of("ekf"), seeds))


def test_what_cannot_be_corrected_is_refused():
    refused("controller must be one of one-step, mpc, but got 'pi'", setup_of, "ekf", controller="pi")
    refused("mpc must observe a state, but got observe='raw'", setup_of, "raw", controller="mpc")
    refused("share must be", setup_of, "ekf", controller="mpc", share=0.0)


ROWS, HELD_OUT = 40, held_out_seeds(0, 3)
ENVS = [task.env_id for task in PLANTS["vehicle"].tasks.values()]


@pytest.fixture(autouse=True)
def short_dives(monkeypatch):
    for name in ENVS:
        monkeypatch.setattr(gym.spec(name), "max_episode_steps", ROWS)


def vehicle_setup(task="path", observe="ekf", algo="ppo", scenario="auv:navigation", **arguments):
    given = {"num_envs": COPIES, "hyperparameters": SMALL[algo], **arguments}
    return make_configuration(task, find_problem(scenario), observe, algo, 256, **given)


@pytest.mark.parametrize(
    ("task", "observe"),
    [("path", "raw"), pytest.param("depth", "ekf", marks=pytest.mark.slow), ("path", "true"), ("depth", "stack")],
)
def test_a_policy_learns_and_is_scored(task, observe, tmp_path):
    setup = vehicle_setup(task, observe)
    run = learn(setup, tmp_path / "policy")
    found = score(load(find_saved(run.folder), make_environments(setup, HELD_OUT)), setup, HELD_OUT)
    assert run.steps == 256 and found.returns.shape == (3,) and (found.returns < 0).all()
    assert list(found.parts) == list(plant_of(task).parts)
    assert all(part.steps.tolist() == [ROWS] * 3 for part in found.parts.values())
    assert configuration_from_json(setup.as_json(), "setup.json").as_json() == setup.as_json()


@pytest.mark.slow
@pytest.mark.parametrize("observe", ["raw", "ekf", "true"])
def test_pd_in_number_is_pd_on_a_single_env(observe):
    setup = vehicle_setup("depth", observe)
    policy, (low, high) = classical_policy("pd", setup), make_single(setup).unwrapped.plant.input_limits
    returns = score(policy, setup, HELD_OUT).returns
    for seed, expected in zip(HELD_OUT, returns, strict=True):
        env, total, state = make_single(setup).env, 0.0, None
        observation, _ = env.reset(seed=seed)
        for _ in range(ROWS):
            action, state = policy.controller.predict(observation, state)
            assert (action >= low - 1e-6).all() and (action <= high + 1e-6).all()
            observation, reward, *_ = env.step(action)
            total += reward
        assert total == pytest.approx(expected, rel=1e-5)


def test_an_episode_that_ends_early_is_scored_to_its_end():
    setup = vehicle_setup("path", "true")
    nose_up = {"initial_state": [3.0, *[0.0] * 6, 1.38, *[0.0] * 4]}
    climbing = replace(setup, env_arguments={**setup.env_arguments, **nose_up})

    class Climb:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.tile([1.0, -1.0, 0.0], (len(observation), 1)), state

    venv, kind = make_environments(climbing, HELD_OUT, endless=True), plant_of("path")
    returns, recorded, alive = run_episodes(Climb(), venv, ROWS, kind)
    steps = alive.sum(axis=1)
    assert (steps < ROWS).all() and (steps > 0).all() and np.isfinite(returns).all()
    parts = kind.parts_of(recorded, alive, venv.unwrapped.env.unwrapped.plant)
    assert parts["vertical"].steps.tolist() == steps.tolist() and isinstance(parts["vertical"], Part)


@pytest.mark.slow
def test_a_filter_goes_on_assuming_the_vehicle_of_training():
    setup = vehicle_setup("path", "ekf")
    met = in_scenario(setup, find_problem("auv:current"))
    assert met.env_arguments["current"] and not met.assumed_plant["current"]
    assert (score(classical_policy("pd", setup), met, HELD_OUT).returns < 0).all()


def test_what_does_not_fit_is_one_clear_line():
    assert set(TASKS) >= {"tracking", "path", "depth"}
    with pytest.raises(ValueError, match="scenario must be the vehicle's, .* but got 'medium_noise'"):
        vehicle_setup("path", scenario="medium_noise")
    with pytest.raises(ValueError, match="scenario must be the vehicle's, .* but got 'auv:velocities'"):
        vehicle_setup("path", scenario="auv:velocities")
    with pytest.raises(ValueError, match="scenario must be one of the thruster's equations, but 'auv:motion' is"):
        vehicle_setup("tracking", scenario="auv:motion")
    with pytest.raises(ValueError, match="pd must observe measurements or a state, but got observe='stack'"):
        classical_policy("pd", vehicle_setup("path", "stack"))
    refused("controller must be", vehicle_setup, "path", controller="mpc")
