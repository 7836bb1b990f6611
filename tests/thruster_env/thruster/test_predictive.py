"""Predictive controllers: they pay least by the env's own reward; derivatives are those of the plan's cost."""

from functools import cache

import gymnasium as gym
import numpy as np
import pytest
from scipy.optimize import minimize

import thruster_env  # noqa: F401 - registers the envs
from thruster_env.core.compiled import interpreted
from thruster_env.thruster import controllers
from thruster_env.thruster.controllers import HORIZONS, PredictiveController, Problem, best_voltages, improve_plans
from thruster_env.thruster.parameters import preset_parameters
from thruster_env.thruster.plant import make_plant

WEIGHTS = {"tracking_weight": 1.0, "energy_weight": 0.05, "voltage_rate_weight": 0.1}  # so that each one counts
QUIET = {"process_noise_cov": (0.0, 0.0), "measurement_noise_cov": 0.0}
GENERATOR = np.random.default_rng(5)
COUNT = 16
STATES = GENERATOR.normal(size=(COUNT, 2)) * [100.0, 2.0]
REFERENCES = GENERATOR.uniform(-30.0, 30.0, COUNT)
LAST = GENERATOR.uniform(-24.0, 24.0, COUNT)


@cache
def controller(horizon, preset="tunnel"):
    env = gym.make("BowThrusterTracking-v0", preset=preset, **WEIGHTS)
    return PredictiveController.for_env(env, horizon)


def rewards(voltages):
    """The env's own rewards (COUNT,) of a step from each state; where the episode starts the last voltage is 0."""
    env = gym.make("BowThruster-v0", **QUIET, **WEIGHTS)
    found = []
    for state, reference, voltage in zip(STATES, REFERENCES, voltages, strict=True):
        env.unwrapped.__init__(reference=reference, **QUIET, **WEIGHTS)
        env.reset(seed=0, options={"state": state})
        found.append(env.step([voltage])[1])
    return np.array(found)


def cost(plan, i, problem):
    with interpreted():
        return controllers._cost_of_plan(tuple(STATES[i]), plan, LAST[i], REFERENCES[i], problem)


def test_one_step_pays_least_by_the_envs_own_reward():
    observations = np.column_stack([STATES, REFERENCES])
    voltages, plans = controller(1).predict(observations)
    np.testing.assert_allclose(plans[:, 0], voltages[:, 0], rtol=1e-6)
    best = rewards(plans[:, 0])
    for voltage in np.linspace(-24.0, 24.0, 17):
        assert (best >= rewards(np.full(COUNT, voltage)) - 1e-12).all()
    for change in (-0.05, 0.05):  # beyond the spacing of the finer grid, 1/24 V
        nearby = np.clip(plans[:, 0] + change, -24.0, 24.0)
        assert (best >= rewards(nearby) - 1e-12).all()


@pytest.mark.parametrize("horizon", [1, 4])
def test_gradient_and_hessian_are_those_of_the_plans_cost(horizon):
    problem = controller(horizon).problem
    room = np.zeros((horizon, 2)), np.zeros(horizon), np.zeros(horizon), np.zeros((horizon, horizon))
    for i in range(4):
        plan = np.random.default_rng(i).uniform(-20.0, 20.0, horizon)
        with interpreted():
            controllers._expand(tuple(STATES[i]), plan, LAST[i], REFERENCES[i], problem, *room)
        _, _, gradient, hessian = room
        steps = 1e-4 * np.eye(horizon)
        slopes = [(cost(plan + s, i, problem) - cost(plan - s, i, problem)) / 2e-4 / 2 for s in steps]
        np.testing.assert_allclose(gradient, slopes, rtol=1e-5, atol=1e-9)
        np.testing.assert_array_equal(hessian, hessian.T)
        assert np.linalg.eigvalsh(hessian).min() > 0


def test_a_plan_costs_what_a_general_optimiser_finds():
    policy = controller(4)
    observations = np.column_stack([STATES, REFERENCES])
    _, plans = policy.predict(observations, np.repeat(LAST[:, None], 4, axis=1))
    for i in range(0, COUNT, 4):
        found = [
            minimize(cost, start, (i, policy.problem), "L-BFGS-B", bounds=[(-24.0, 24.0)] * 4, tol=1e-14).fun
            for start in (plans[i], np.zeros(4), np.full(4, LAST[i]))
        ]
        assert cost(plans[i], i, policy.problem) <= min(found) + 1e-7


def test_an_improved_plan_never_costs_more_and_stays_in_range():
    problem = controller(3).problem
    plans = np.random.default_rng(2).uniform(-24.0, 24.0, (COUNT, 3))
    before = [cost(plan, i, problem) for i, plan in enumerate(plans)]
    improve_plans(STATES, LAST, REFERENCES, plans, problem)
    after = [cost(plan, i, problem) for i, plan in enumerate(plans)]
    assert (np.array(after) <= before).all() and np.mean(after) < 0.8 * np.mean(before)
    assert abs(plans).max() <= 24.0


def test_compiled_and_interpreted_give_the_same():
    problem = controller(1).problem
    found = best_voltages(STATES, LAST, REFERENCES, problem)
    plans = np.repeat(found[:, None], 3, axis=1)
    others = plans[:5].copy()
    improve_plans(STATES, LAST, REFERENCES, plans, problem)
    with interpreted():
        same = best_voltages(STATES[:5], LAST[:5], REFERENCES[:5], problem)
        improve_plans(STATES[:5], LAST[:5], REFERENCES[:5], others, problem)
    np.testing.assert_allclose(same, found[:5], rtol=1e-9)
    np.testing.assert_allclose(others, plans[:5], rtol=1e-6, atol=1e-6)


def test_it_believes_in_the_thruster_that_it_is_told():
    """With a weaker motor than there is, it asks for more voltage."""
    env = gym.make("BowThrusterTracking-v0", **WEIGHTS)
    parameters = preset_parameters("tunnel")
    weaker = make_plant(parameters._replace(voltage_gain=0.8 * parameters.voltage_gain)).constants
    seen = [100.0, 2.0, 12.0]
    told, nominal = (PredictiveController.for_env(env, 1, c).predict(seen)[0] for c in (weaker, None))
    assert told[0] > nominal[0] > 0


def test_the_names_and_what_is_refused():
    assert list(HORIZONS) == ["one-step", "mpc"] and HORIZONS["one-step"] == 1
    assert isinstance(controller(1).problem, Problem)
    with pytest.raises(ValueError, match="horizon must be"):
        PredictiveController.for_env(gym.make("BowThruster-v0"), 0)
    with pytest.raises(ValueError, match="must have a thruster's equations, but the env is linear"):
        PredictiveController.for_env(gym.make("BowThrusterLinear-v0"))
    with pytest.raises(ValueError, match="an observation must begin with the state, but has 2 entries"):
        controller(1).predict([1.0, 2.0])
