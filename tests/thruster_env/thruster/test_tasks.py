"""The registered tasks: the published linear systems against print and theory, and what all of them share."""

import itertools
import json
import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from scipy import stats
from scipy.linalg import expm

from filters import KalmanFilter, run
from filters.consistency.nees import normalized_squares
from thruster_env.core.streams import episode_keys
from thruster_env.effects.effects import Sinusoid
from thruster_env.effects.sensors import Dropout
from thruster_env.thruster.effects import LogNormal
from thruster_env.thruster.env import BowThrusterLinearEnv
from thruster_env.thruster.equations import simulate
from thruster_env.thruster.linear import PUBLISHED, make_linear_plant
from thruster_env.thruster.parameters import TUNNEL_PHYSICAL

SURELY = 1e-4  # the probability with which a right program fails such a test, once for all seeds
IDS = ["BowThruster-v0", "BowThrusterTracking-v0", "BowThrusterReversal-v0", "BowThrusterLinear-v0"]
every_system = pytest.mark.parametrize("system", PUBLISHED)
WAVES = [{"name": "sinusoid", "amplitude": 3.0, "period": 0.5}]


def sampled(system, dt=0.01):
    """A_d and B_d by the exponential of the block matrix, and C."""
    model = PUBLISHED[system]
    block = np.zeros((4, 4))
    block[:2] = np.hstack([model.a, model.b])
    power = expm(block * dt)
    return power[:2, :2], power[:2, 2:], np.array(model.c)[0]


def trajectories(system, copies=300, steps=60, **arguments):
    voltages = np.random.default_rng(8).uniform(-24, 24, (copies, steps))
    plant = make_linear_plant(system, **arguments)
    return simulate(plant, episode_keys(range(copies)), voltages), voltages


@every_system
@pytest.mark.parametrize("dt", [0.01, 0.003])
def test_without_noise_a_linear_system_moves_by_its_matrices(system, dt):
    arguments = {"dt": dt, "process_noise_cov": [0, 0], "measurement_noise_cov": 0, "flow": WAVES}
    env = BowThrusterLinearEnv(system, ambient_velocity=0.4, initial_state=[3.0, -2.0], **arguments)
    x = env.reset(seed=0)[1]["state"]
    a_d, b_d, c = sampled(system, dt)
    printed_a, printed_b = (np.array(m) for m in (PUBLISHED[system].printed_a_d, PUBLISHED[system].printed_b_d))
    for voltage in np.random.default_rng(0).uniform(-30, 30, 50):
        observation, _, _, _, info = env.step([voltage])
        u = np.array([np.clip(voltage, -24, 24), info["ambient_velocity"]])
        np.testing.assert_allclose(info["state"], a_d @ x + b_d @ u, rtol=1e-12, atol=1e-12)
        if dt == 0.01:  # at which the papers print them, with four decimals
            digits = 0.51e-4 * (np.abs(x).sum() + np.abs(u).sum())
            assert (np.abs(info["state"] - printed_a @ x - printed_b @ u) <= digits).all()
        x = info["state"]
        assert info["thrust"] == pytest.approx(c @ x, rel=1e-12, abs=1e-12)
        assert observation[0] == np.float32(info["thrust"]) == np.float32(info["measurement"][0])


@every_system
@pytest.mark.parametrize(("q", "r"), [([[0.5, 0.0], [0.0, 0.5]], None), ([[0.3, -0.2], [-0.2, 0.4]], 2.0)])
def test_noise_of_a_linear_system_has_covariances_q_and_r(system, q, r):
    result, voltages = trajectories(system, process_noise_cov=q, measurement_noise_cov=r)
    a_d, b_d, c = sampled(system)
    x = result.states
    w = x[:, 1:] - x[:, :-1] @ a_d.T - voltages[..., None] * b_d[:, 0]
    white = w.reshape(-1, 2) @ np.linalg.inv(np.linalg.cholesky(q)).T
    v = (result.measurements[..., 0] - x @ c) / math.sqrt(0.5 if r is None else r)
    for values in (white[:, 0], white[:, 1], v.ravel()):
        assert stats.kstest(values, stats.norm.cdf).pvalue > SURELY
    pairs = [(white[:, 0], white[:, 1]), (white[:, 0], v[:, 1:].ravel()), (v[:, 1:].ravel(), v[:, :-1].ravel())]
    for one, other in pairs:
        assert abs(np.corrcoef(one, other)[0, 1]) < 4 / math.sqrt(len(one))


def test_published_noise_is_a_half_everywhere():
    env = BowThrusterLinearEnv(sensors=["thrust", "speed"])
    np.testing.assert_array_equal(env.plant.process_noise_cov, 0.5 * np.eye(2))
    np.testing.assert_array_equal(env.plant.measurement_noise_cov, 0.5 * np.eye(2))
    given = BowThrusterLinearEnv(sensors=["thrust", "speed"], measurement_noise_cov=[2.0, 3.0])
    np.testing.assert_array_equal(given.plant.measurement_noise_cov, np.diag([2.0, 3.0]))


def test_a_linear_env_is_the_simulated_plant():
    noise = {"process_noise_cov": [0.1, 0.2], "measurement_noise_cov": 2.0}
    result, voltages = trajectories("tunnel", copies=2, **noise)
    env = gym.make("BowThrusterLinear-v0", **noise)
    for b in range(2):
        infos = [env.reset(seed=b)[1]] + [env.step([voltage])[4] for voltage in voltages[b]]
        np.testing.assert_allclose([info["state"] for info in infos], result.states[b], rtol=1e-12, atol=1e-12)
        found = [info["measurement"] for info in infos]
        np.testing.assert_allclose(found, result.measurements[b], rtol=1e-12, atol=1e-12)


@every_system
@pytest.mark.parametrize("sensors", [["thrust"], ["speed", "thrust"]], ids=", ".join)
def test_on_a_linear_env_the_kalman_filter_is_consistent(system, sensors):
    env = gym.make("BowThrusterLinear-v0", system=system, sensors=sensors, ambient_velocity=0.5)
    model, copies, steps = env.unwrapped.state_space_model(), 200, 120
    keys = episode_keys(range(copies))
    voltages = np.random.default_rng(2).uniform(-24, 24, (copies, steps))
    truth = simulate(env.unwrapped.plant, keys, voltages)
    estimates = run(KalmanFilter(model=model), keys, voltages[..., None], truth.measurements)
    m = len(sensors)
    nees = normalized_squares(truth.states - estimates.means, estimates.covs)
    nis = normalized_squares(estimates.innovations, estimates.innovation_covs)
    for squares, freedom in ((nees, 2 * copies), (nis, m * copies)):
        sums = squares.sum(axis=0)  # over seeds: chi-squared at every step
        low, high = stats.chi2.interval(0.95, freedom)
        assert np.mean((sums > low) & (sums < high)) > 0.85
        low, high = stats.chi2.interval(1 - SURELY / len(sums), freedom)
        assert ((sums > low) & (sums < high)).all()
    # Innovations are white, so their squares add up over steps, too.
    low, high = stats.chi2.interval(1 - SURELY, nis.size * m)
    assert low < nis.sum() < high


@every_system
def test_scales_are_those_of_the_equilibrium(system):
    env = BowThrusterLinearEnv(system, tracking_weight=1.0, voltage_rate_weight=0.0)
    model = PUBLISHED[system]
    gain = (-np.array(model.c) @ np.linalg.solve(model.a, np.array(model.b)[:, 0])).item()
    assert env.thrust_scale == pytest.approx(abs(24 * gain), rel=1e-12)
    _, info = env.reset(seed=0)
    assert info["reference"] == pytest.approx(12 * gain, rel=1e-12)
    _, reward, _, _, info = env.step([0.0])
    assert reward == pytest.approx(-(((info["thrust"] - 12 * gain) / (24 * gain)) ** 2), rel=1e-12)


def lengths(system, count=20, top=24.0):
    env = gym.make("BowThrusterLinear-v0", system=system)
    voltages, found = np.random.default_rng(0), []
    for seed in range(count):
        env.reset(seed=seed)
        ends = (any(env.step([voltages.uniform(-top, top)])[2:4]) for _ in itertools.count())
        found.append(next(k for k, end in enumerate(ends, 1) if end))
    return found


def test_the_stable_linear_system_runs_to_the_time_limit():
    assert lengths("tunnel") == [500] * 20


def test_the_unstable_linear_system_runs_on_until_it_has_grown():
    """Its mode grows by exp(0.0319) a step, from the noise's size a hundredfold in 145 steps."""
    assert np.median(lengths("open_bladed")) > 100


def test_linear_systems_lack_a_current_and_other_systems():
    with pytest.raises(ValueError, match="linear systems must be measured by other channels than the current"):
        BowThrusterLinearEnv(sensors=["current"])
    with pytest.raises(ValueError, match="system must be one of tunnel, open_bladed, but got 'canoe'"):
        BowThrusterLinearEnv("canoe")
    with pytest.raises(ValueError, match="measurement_noise_cov must be 1 variances"):
        BowThrusterLinearEnv(measurement_noise_cov=[1.0, 2.0])


OBJECTS = {
    "sensors": {"thrust": [Dropout(0.2)], "speed": []},
    "flow": Sinusoid(0.1),
    "amplifier": [{"name": "sag", "fraction": 0.1}],
}


@pytest.mark.parametrize("name", IDS)
def test_every_id_has_a_time_limit_and_survives_json_with_all_disturbances(name):
    arguments = dict(OBJECTS)
    if "Linear" not in name:
        arguments |= {"uncertainty": {"load_gain": LogNormal(0.1)}, "preset": TUNNEL_PHYSICAL}
    env = gym.make(name, **arguments)
    text = env.spec.to_json()
    assert json.loads(text)["kwargs"]["flow"] == {"name": "sinusoid", **vars(Sinusoid(0.1))}
    again = gym.make(EnvSpec.from_json(text))
    assert EnvSpec.from_json(again.spec.to_json()) == EnvSpec.from_json(text)
    assert env.spec.max_episode_steps == 500
    env.reset(seed=1), again.reset(seed=1)
    for _ in range(500):
        one, other = env.step([5.0]), again.step([5.0])
        np.testing.assert_array_equal(one[0], other[0])
        assert one[1:4] == other[1:4]
    assert one[2:4] == (False, True)


@pytest.mark.parametrize("name", IDS[1:3])
def test_observation_spaces_end_with_flags_and_reference(name):
    env = gym.make(name, sensors={"speed": [Dropout(0.2)], "thrust": []})
    assert env.observation_space.shape == (4,) and env.unwrapped.appended_entries == 2
    assert gym.make(name).observation_space.shape == (2,)
    assert gym.make("BowThruster-v0", sensors=["speed", "thrust"]).observation_space.shape == (2,)


@pytest.mark.parametrize("name", IDS)
def test_an_episode_may_start_where_options_say(name):
    env = gym.make(name)
    info = env.reset(seed=3, options={"state": [30.0, -0.5]})[1]
    assert tuple(info["state"]) == (30.0, -0.5)
    for wrong in ([1.0], [1.0, math.nan], "rest"):
        with pytest.raises(ValueError, match="the state of options must be 2 finite numbers"):
            env.reset(options={"state": wrong})
    plain = gym.make(name)
    for seed, options in ((3, {}), (None, None), (None, {"state": None})):
        found, expected = env.reset(seed=seed, options=options)[1], plain.reset(seed=seed)[1]
        np.testing.assert_array_equal(found["state"], expected["state"])
