"""Uncertain parameters: how they are drawn, that each episode moves by its own, and how exactly."""

import math

import gymnasium as gym
import numpy as np
import pytest
from scipy import stats
from scipy.integrate import solve_ivp

import thruster_env  # noqa: F401 - registers the envs
from tests.thruster_env.thruster.test_robustness import AMPLIFIER, FLOW
from thruster_env.core.streams import episode_keys
from thruster_env.graphs.draws import Draws
from thruster_env.thruster.analysis import (
    required_substeps,
    required_substeps_of_all,
    run_substeps,
    state_range,
    steady_state,
)
from thruster_env.thruster.dynamics import rates, thrust_and_torque
from thruster_env.thruster.effects import UNCERTAIN, LogNormal, Uniform, drawn_parameters
from thruster_env.thruster.equations import copies_of, simulate
from thruster_env.thruster.parameters import PRESETS, TUNNEL, TUNNEL_PHYSICAL, derive_constants
from thruster_env.thruster.plant import Task, extreme_parameters, make_plant, make_uncertainty

SURELY = 1e-4  # the probability with which a right program fails such a test, once for all seeds
UNIFORM, LOG_NORMAL = {"name": "uniform", "low": 0.8, "high": 1.3}, {"name": "log-normal", "std": 0.1}
SOME = {"load_gain": LOG_NORMAL, "motor_damping": UNIFORM, "lift_coefficient": UNIFORM}
EXACT = {"process_noise_cov": [0, 0], "measurement_noise_cov": 0}


def numbers_of(plant):
    return {name: (type(kind), kind.numbers) for name, kind in plant.uncertainty.items()}


def factors(parameter, uncertainty, count=4000):
    """Drawn over nominal values of one parameter for as many episodes."""
    plant = make_plant("tunnel_physical", uncertainty=uncertainty)
    drawn = drawn_parameters(plant.parameters, numbers_of(plant), Draws(tuple(episode_keys(range(count)).T), 0))
    return getattr(drawn, parameter) / getattr(TUNNEL_PHYSICAL, parameter)


def test_every_number_but_the_asymmetry_may_be_uncertain():
    assert set(UNCERTAIN) == set(TUNNEL._fields) - {"angles", "thrust_asymmetry"}


def test_uniform_factors_are_uniform():
    found = factors("motor_damping", {"motor_damping": UNIFORM})
    assert stats.kstest(found, stats.uniform(0.8, 0.5).cdf).pvalue > SURELY
    np.testing.assert_allclose(factors("area", {"area": {"name": "uniform", "low": 1.1, "high": 1.1}}), 1.1)


def test_log_normal_factors_are_log_normal():
    found = factors("load_gain", {"load_gain": LOG_NORMAL})
    assert stats.kstest(np.log(found) / 0.1, stats.norm.cdf).pvalue > SURELY


def test_factors_of_different_parameters_are_independent():
    logs = [np.log(factors(name, {name: LOG_NORMAL})) for name in ("load_gain", "motor_damping", "area")]
    correlations = np.corrcoef(logs)[np.triu_indices(3, 1)]
    assert np.abs(correlations).max() < 4 / math.sqrt(4000)


def test_a_draw_does_not_depend_on_what_else_is_uncertain():
    alone = factors("load_gain", {"load_gain": LOG_NORMAL}, count=20)
    np.testing.assert_array_equal(factors("load_gain", {"area": UNIFORM, **SOME}, count=20), alone)


@pytest.mark.parametrize("disturbed", [{"uncertainty": SOME}, {"flow": FLOW}, {"amplifier": AMPLIFIER}])
def test_what_disturbs_does_not_move_noise_nor_reference(disturbed):
    def told(**disturbances):
        env = gym.make("BowThrusterTracking-v0", **disturbances)
        infos = [env.reset(seed=3)[1]] + [env.step([9.0])[4] for _ in range(20)]
        return [(float(info["measurement"][0]) - info["thrust"], info["reference"]) for info in infos]

    np.testing.assert_allclose(told(**disturbed), told(), rtol=0, atol=1e-12)


@pytest.mark.parametrize("flow", [None, [{"name": "sinusoid", "amplitude": 0.5}]], ids=["still", "flow"])
@pytest.mark.parametrize("preset", PRESETS)
def test_an_episode_moves_by_its_own_parameters(preset, flow):
    env = gym.make("BowThruster-v0", preset=preset, uncertainty=SOME, flow=flow, ambient_velocity=0.1, **EXACT)
    seen = set()
    for seed in (4, None, None):
        x = env.reset(seed=seed)[1]["state"]
        p, plant = env.unwrapped.parameters, env.unwrapped.plant
        seen.add(p)
        certain = [name for name in p._fields if name not in SOME]
        assert all(getattr(p, name) == getattr(PRESETS[preset], name) for name in certain)
        assert all(type(getattr(p, name)) is float for name in SOME)
        for voltage in (24.0, -24.0, 5.0, 5.0):
            info = env.step([voltage])[4]
            moved = run_substeps(tuple(x), (voltage, info["ambient_velocity"]), p, plant.dt, plant.substeps)
            np.testing.assert_allclose(info["state"], moved, rtol=1e-10, atol=1e-12)
            thrust, _ = thrust_and_torque(tuple(info["state"]), derive_constants(p))
            assert info["thrust"] == pytest.approx(thrust, rel=1e-10, abs=1e-12)
            x = info["state"]
    assert len(seen) == 3 and PRESETS[preset] not in seen


def test_substeps_suffice_for_every_extreme():
    corners = extreme_parameters(PRESETS["open_bladed_corrected"], make_uncertainty(SOME))
    cases = [(p, u_0) for p in corners for u_0 in (0.0, 0.5)]
    each = [required_substeps(p, 0.02, 24.0, u_0) for p, u_0 in cases]
    assert min(each) < max(each) == required_substeps_of_all(tuple(cases), 0.02, 24.0)


def test_the_constants_in_memory_are_those_of_the_drawn_parameters():
    plant = make_plant("t200", uncertainty=SOME, ambient_velocity=0.3)
    keys = episode_keys(range(150))
    copies = copies_of(plant, Task(), 150)
    copies.begin(keys)
    stored = copies.memory.transpose(1, 0, 2).reshape(copies.memory.shape[1], -1)
    for i in (0, 1, 127, 128, 149):
        p = drawn_parameters(plant.parameters, numbers_of(plant), Draws(tuple(keys[i]), 0))
        constants = derive_constants(p, 0.3, plant.dt / plant.substeps)
        (first,) = np.flatnonzero(np.isclose(stored[:, i], constants[0], rtol=1e-13, atol=0.0))
        np.testing.assert_allclose(stored[first : first + len(constants), i], constants, rtol=1e-13)


def test_scales_of_reward_and_reference_stay_nominal():
    env = gym.make("BowThruster-v0", uncertainty=SOME)
    _, info = env.reset(seed=1)
    assert info["reference"] == pytest.approx(steady_state(TUNNEL, 12.0).thrust, rel=1e-12)
    _, reward, _, _, info = env.step([0.0])
    error = (info["thrust"] - info["reference"]) / steady_state(TUNNEL, 24.0).thrust
    assert reward == pytest.approx(-(error**2), rel=1e-12)


def test_the_measured_current_follows_from_the_own_parameters():
    env = gym.make("BowThruster-v0", preset="tunnel_physical", sensors=["current"], uncertainty=SOME, **EXACT)
    env.reset(seed=2)
    info, p = env.step([10.0])[4], env.unwrapped.parameters
    back_emf = p.motor_damping * info["state"][0]
    current = p.voltage_gain * (p.voltage_gain * 10.0 - back_emf) / (p.load_gain * p.motor_damping)
    assert info["measurement"][0] == pytest.approx(current, rel=1e-12)


def test_without_uncertainty_the_parameters_are_nominal():
    env = gym.make("BowThruster-v0", preset="t200")
    env.reset(seed=0)
    assert env.unwrapped.parameters == PRESETS["t200"]


@pytest.mark.parametrize("preset", ["tunnel_physical", "t200"])
def test_one_step_maps_are_accurate_at_the_corners_of_the_drawn_region(preset):
    wide = {
        "load_gain": {"name": "uniform", "low": 0.5, "high": 2.0},
        "added_mass": {"name": "log-normal", "std": 0.2},
    }
    plant = make_plant(preset, uncertainty=wide)
    assert plant.substeps > make_plant(preset).substeps
    corners = extreme_parameters(plant.parameters, plant.uncertainty)
    assert len(corners) == 5
    for p in corners:
        top = np.array(steady_state(p, 24.0)[:2])
        x = np.random.default_rng(0).uniform(-1, 1, (30, 2)) * top
        voltages = np.where(np.arange(30) % 2, 24.0, -24.0)
        c = derive_constants(p)

        def slopes(_, y, c=c, voltages=voltages):
            return np.concatenate(rates((y[:30], y[30:]), (voltages, 0.0), c))

        exact = solve_ivp(slopes, (0, 0.01), x.T.ravel(), method="DOP853", rtol=1e-10, atol=1e-13).y[:, -1]
        found = np.array(run_substeps(tuple(x.T), (voltages, 0.0), p, 0.01, plant.substeps))
        error = np.abs(found - exact.reshape(2, 30)).max(axis=1)
        assert (error <= 1e-4 * state_range(p, 24.0)).all()


def test_of_many_uncertain_parameters_corners_are_single_and_common_extremes():
    names = UNCERTAIN[:7]
    corners = extreme_parameters(TUNNEL, dict.fromkeys(names, Uniform(0.9, 1.1)))
    assert len(corners) == 1 + 2 + 2 * 7
    ratios = np.array([[getattr(p, name) / getattr(TUNNEL, name) for name in names] for p in corners])
    assert {tuple(row) for row in np.round(ratios[1:3], 9)} == {(0.9,) * 7, (1.1,) * 7}
    assert (np.sum(np.abs(ratios[3:] - 1) > 0.05, axis=1) == 1).all()


def test_a_run_depends_on_its_own_key_only():
    plant, keys = make_plant(uncertainty=SOME), episode_keys(range(140))
    voltages = np.random.default_rng(1).uniform(-24, 24, (140, 30))
    run = simulate(plant, keys, voltages)
    for i in (0, 131):
        alone = simulate(plant, keys[i : i + 1], voltages[i : i + 1])
        np.testing.assert_allclose(run.measurements[i], alone.measurements[0], rtol=1e-12, atol=1e-12)


WRONG = [
    ("load_gain", "uncertainty must be a mapping from parameters to distributions, but got 'load_gain'"),
    ({"angles": LOG_NORMAL}, "a name in uncertainty must be one of lift_coefficient, .*, but got 'angles'"),
    ({"thrust_asymmetry": LOG_NORMAL}, "a name in uncertainty must be one of lift_coefficient"),
    ({"area": 0.1}, "the distribution of area must be a mapping with arguments and a name out of uniform"),
    ({"area": {"name": "normal", "std": 0.1}}, "the distribution of area must be a mapping .*, but got"),
    ({"area": {"name": ["uniform"]}}, "the distribution of area must be a mapping .*, but got"),
    ({"area": {"name": "uniform", "low": 0.9}}, "the distribution of area must be a mapping .*, but got"),
    ({"area": {"name": "uniform", "low": 1.1, "high": 0.9}}, "low must be at most high, but got 1.1 and 0.9"),
    ({"area": {"name": "uniform", "low": 0.0, "high": 0.9}}, "low must be positive, but got 0.0"),
    ({"area": {"name": "log-normal", "std": -0.1}}, "std must be zero or positive, but got -0.1"),
    ({"blade_angle": {"name": "uniform", "low": 1, "high": 4}}, "blade_angle must allow a steady state"),
]


@pytest.mark.parametrize(("uncertainty", "message"), WRONG)
def test_wrong_uncertainties_are_refused_with_the_rule(uncertainty, message):
    with pytest.raises(ValueError, match=message) as error:
        make_plant(uncertainty=uncertainty)
    assert "\n" not in str(error.value)


def test_distributions_may_be_objects():
    given = {"load_gain": LogNormal(0.1), "area": Uniform(0.8, 1.3)}
    assert make_plant(uncertainty=given).uncertainty == given
    assert make_plant(uncertainty={"load_gain": LOG_NORMAL, "area": UNIFORM}).uncertainty == given
