"""A filter of six velocities whose attitude an AHRS measures: an input of its model, held for a step."""

import gymnasium as gym
import numpy as np
import pytest

import thruster_env.auv  # noqa: F401
from filters import EstimateState, make_filter
from filters.wrappers.envs import EstimateStates
from thruster_env.auv.model import auv_model
from thruster_env.auv.plant import make_plant

SIX = {"filter": "ekf", "model_arguments": {"states": "velocities"}}
LOST = [{"name": "dropout", "probability": 0.4, "mean_length": 2}]
SENSORS = {"u": [], "phi": LOST, "v": [], "w": [], "p": [], "q": [], "r": [], "theta": LOST}
TOLD, SEEN = [1, 7], [0, 2, 3, 4, 5, 6]


def vehicle(sensors="motion", **arguments):
    return EstimateState(gym.make("SegorogeniAUV-v0", sensors=sensors), **{**SIX, **arguments})


@pytest.mark.usefixtures("as_python")
def test_the_filter_predicts_with_the_attitude_measured_last():
    env, told = vehicle(SENSORS, observation="measurement+estimate"), np.zeros(2)
    session = make_filter("ekf", env.filter.model).session()
    observation, info = env.reset(seed=3)
    missing, before = 0, None
    for k in range(12):
        valid = info["measurement_valid"]
        told = np.where(valid[TOLD], info["measurement"][TOLD], told)
        missing += 2 - valid[TOLD].sum()
        z = info["measurement"][SEEN]
        if k == 0:
            session.start((0, 0), z)
        else:
            session.step([3.0, 0.1, -0.1, *before], z)
        before = told
        np.testing.assert_array_equal(info["estimate"], session.mean)
        np.testing.assert_array_equal(info["innovation"], session.innovation)
        assert observation.shape == (8 + 6 + 2,) and info["innovation_cov"].shape == (6, 6)
        np.testing.assert_array_equal(observation[TOLD], told.astype(np.float32))
        observation, *_, info = env.step([3.0, 0.1, -0.1])
    assert missing > 3


@pytest.mark.usefixtures("as_python")
@pytest.mark.parametrize("mode", ["NextStep", "SameStep", "Disabled"])
def test_copies_equal_single_envs(mode):
    arguments = {"sensors": SENSORS, "max_episode_steps": 3}
    envs = EstimateStates(gym.make_vec("SegorogeniAUV-v0", 2, autoreset_mode=mode, **arguments), **SIX)
    singles = [EstimateState(gym.make("SegorogeniAUV-v0", **arguments), **SIX) for _ in range(2)]
    action, resets = [2.0, 0.1, -0.1], 0
    expected = [env.reset(seed=5 + i) for i, env in enumerate(singles)]
    found, info = envs.reset(seed=5)
    done = np.zeros(2, dtype=bool)
    for _ in range(8):
        for key in ("estimate", "estimate_cov", "innovation"):
            np.testing.assert_array_equal(info[key], [i[key] for _, i in expected])
        np.testing.assert_array_equal(found, [o for o, _ in expected])
        if mode == "Disabled" and done.any():
            found, info = envs.reset(options={"reset_mask": done})
        else:
            found, _, terminated, truncated, info = envs.step([action, action])
        if done.any() and mode != "SameStep":
            expected, done, resets = [env.reset() for env in singles], np.zeros(2, dtype=bool), resets + 1
            continue
        expected = [(o, i) for o, _, _, _, i in (env.step(action) for env in singles)]
        done = terminated | truncated
        if mode == "SameStep" and done.any():
            np.testing.assert_array_equal(info["final_info"]["estimate"], [i["estimate"] for _, i in expected])
            expected, resets = [env.reset() for env in singles], resets + 1
    assert resets == 2


def test_noise_of_the_attitude_is_noise_of_the_rates():
    """A tilt rights itself: in a step the roll rate changes by -z_G W dt / (I_x - K_pd) of it."""
    plant = make_plant(sensors="motion", dt=0.01)
    own, told = (auv_model(states="velocities", attitude=one, dt=0.01) for one in ("level", "measured"))
    added = told.process_noise_cov - own.process_noise_cov
    p = plant.parameters
    rate = p.zG * p.W * plant.dt / (p.Ix - p.Kpd)
    assert added[3, 3] == pytest.approx((0.005 * rate) ** 2, rel=0.15)  # damping and sway take part of it
    assert np.linalg.matrix_rank(added, tol=1e-14) == 2
    given = auv_model(states="velocities", attitude="measured", process_noise_cov=[1e-6] * 6)
    np.testing.assert_array_equal(given.process_noise_cov, 1e-6 * np.eye(6))


@pytest.mark.slow
def test_the_filter_is_consistent():
    """Over 10 runs of 15 s the NEES is 5.87 with planes moving; without the attitude's noise in Q it is 16."""
    env, scores = vehicle(), []
    for seed in range(10):
        env.reset(seed=seed)
        levels = np.random.default_rng(seed).uniform([2.0, -0.1, -0.1], [4.0, 0.1, 0.1], (5, 3))
        for level in np.repeat(levels, 60, axis=0):
            *_, info = env.step(level)
            error = info["estimate"] - info["state"][:6]
            scores.append(error @ np.linalg.solve(info["estimate_cov"], error))
    assert np.mean(scores) == pytest.approx(6.0, abs=0.4)


def test_what_cannot_be_predicted_or_told_is_an_error():
    with pytest.raises(ValueError, match="must measure u, v, w, p, q, r, but got psi, z"):
        vehicle("default")
    with pytest.raises(
        ValueError, match="sensors of a measured attitude must measure phi and theta, but got u, v"
    ):
        vehicle("papers", model_arguments={"states": "velocities", "attitude": "measured"})
    assert vehicle("papers").filter.model.inputs == 3  # level, as nobody tells
