"""Policies that correct a controller: what they see, what is applied, and that they start as the controller."""
# ruff: noqa: F811 - fixtures come by import and go by name

from dataclasses import replace

import numpy as np
import pytest

pytest.importorskip("sb3_contrib")

from tests.learners import COPIES, LIMIT, learn, setup_of, short_episodes  # noqa: F401 - some are fixtures
from tuning.policies.environments import make_environments
from tuning.policies.saved import classical_policy, configuration_from_json, find_saved, load, score
from tuning.problems.data import held_out_seeds

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
    with pytest.raises(ValueError, match="controller must be one of one-step, mpc, but got 'pi'"):
        setup_of("ekf", controller="pi")
    with pytest.raises(ValueError, match="mpc must observe a state, but got observe='raw'"):
        setup_of("raw", controller="mpc")
    with pytest.raises(ValueError, match="share must be"):
        setup_of("ekf", controller="mpc", share=0.0)
