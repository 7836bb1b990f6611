"""Policies on the underwater vehicle: the same trainings, and PD beside them on what they see."""

from dataclasses import replace

import gymnasium as gym
import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

import thruster_env.auv  # noqa: F401 - registers the envs
from tests.learners import COPIES, SMALL, learn
from tuning.policies.environments import make_environments, make_single
from tuning.policies.saved import classical_policy, configuration_from_json, find_saved, load, run_episodes, score
from tuning.policies.setup import PLANTS, TASKS, Part, in_scenario, make_configuration, plant_of
from tuning.problems.data import held_out_seeds
from tuning.problems.find import find_problem

LIMIT, SEEDS = 40, held_out_seeds(0, 3)
ENVS = [task.env_id for task in PLANTS["vehicle"].tasks.values()]


@pytest.fixture(autouse=True)
def short_episodes(monkeypatch):
    for name in ENVS:
        monkeypatch.setattr(gym.spec(name), "max_episode_steps", LIMIT)


def setup_of(task="path", observe="ekf", algo="ppo", scenario="auv:navigation", **arguments):
    given = {"num_envs": COPIES, "hyperparameters": SMALL[algo], **arguments}
    return make_configuration(task, find_problem(scenario), observe, algo, 256, **given)


@pytest.mark.parametrize(
    ("task", "observe"),
    [("path", "raw"), pytest.param("depth", "ekf", marks=pytest.mark.slow), ("path", "true"), ("depth", "stack")],
)
def test_a_policy_learns_and_is_scored(task, observe, tmp_path):
    setup = setup_of(task, observe)
    run = learn(setup, tmp_path / "policy")
    found = score(load(find_saved(run.folder), make_environments(setup, SEEDS)), setup, SEEDS)
    assert run.steps == 256 and found.returns.shape == (3,) and (found.returns < 0).all()
    assert list(found.parts) == list(plant_of(task).parts)
    assert all(part.steps.tolist() == [LIMIT] * 3 for part in found.parts.values())
    assert configuration_from_json(setup.as_json(), "setup.json").as_json() == setup.as_json()


@pytest.mark.slow
def test_sac_learns_too(tmp_path):
    assert learn(setup_of("depth", "ekf", "sac"), tmp_path / "policy").steps == 256


@pytest.mark.slow
@pytest.mark.parametrize("observe", ["raw", "ekf", "true"])
def test_pd_in_number_is_pd_on_a_single_env(observe):
    setup = setup_of("depth", observe)
    policy, (low, high) = classical_policy("pd", setup), make_single(setup).unwrapped.plant.input_limits
    returns = score(policy, setup, SEEDS).returns
    for seed, expected in zip(SEEDS, returns, strict=True):
        env, total, state = make_single(setup).env, 0.0, None
        observation, _ = env.reset(seed=seed)
        for _ in range(LIMIT):
            action, state = policy.controller.predict(observation, state)
            assert (action >= low - 1e-6).all() and (action <= high + 1e-6).all()
            observation, reward, *_ = env.step(action)
            total += reward
        assert total == pytest.approx(expected, rel=1e-5)


def test_an_episode_that_ends_early_is_scored_to_its_end():
    setup = setup_of("path", "true")
    nose_up = {"initial_state": [3.0, *[0.0] * 6, 1.38, *[0.0] * 4]}
    climbing = replace(setup, env_arguments={**setup.env_arguments, **nose_up})

    class Climb:
        def predict(self, observation, state=None, episode_start=None, deterministic=True):
            return np.tile([1.0, -1.0, 0.0], (len(observation), 1)), state

    venv, kind = make_environments(climbing, SEEDS, endless=True), plant_of("path")
    returns, recorded, alive = run_episodes(Climb(), venv, LIMIT, kind)
    steps = alive.sum(axis=1)
    assert (steps < LIMIT).all() and (steps > 0).all() and np.isfinite(returns).all()
    parts = kind.parts_of(recorded, alive, venv.unwrapped.env.unwrapped.plant)
    assert parts["vertical"].steps.tolist() == steps.tolist() and isinstance(parts["vertical"], Part)


@pytest.mark.slow
def test_a_filter_goes_on_assuming_the_vehicle_of_training():
    setup = setup_of("path", "ekf")
    met = in_scenario(setup, find_problem("auv:current"))
    assert met.env_arguments["current"] and not met.assumed_plant["current"]
    assert (score(classical_policy("pd", setup), met, SEEDS).returns < 0).all()


def test_what_does_not_fit_is_one_clear_line():
    assert set(TASKS) >= {"tracking", "path", "depth"}
    with pytest.raises(ValueError, match="scenario must be the vehicle's, .* but got 'medium_noise'"):
        setup_of("path", scenario="medium_noise")
    with pytest.raises(ValueError, match="scenario must be the vehicle's, .* but got 'auv:velocities'"):
        setup_of("path", scenario="auv:velocities")
    with pytest.raises(ValueError, match="scenario must be one of the thruster's equations, but 'auv:motion' is"):
        setup_of("tracking", scenario="auv:motion")
    with pytest.raises(ValueError, match="pd must observe measurements or a state, but got observe='stack'"):
        classical_policy("pd", setup_of("path", "stack"))
    with pytest.raises(ValueError, match="controller must be"):
        setup_of("path", controller="mpc")
