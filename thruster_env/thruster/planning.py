"""Optimal voltages over the next steps by the equations of motion: a grid search, and Gauss-Newton's method.

The cost is the env's own, `task.step_cost`, of the thrust that the model predicts. Compiled, copy by copy.

They have the `predict` of `controllers` and the inputs of the LQR there: state, true or estimated, and the
reference of the next step. They plan with a thruster's nominal equations, without noise, dead bands, a changing
flow or a changing reference.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import at_least
from thruster_env.core.compiled import compiled, function_fingerprint, inlined, is_interpreting
from thruster_env.env.model_env import remembered
from thruster_env.thruster.controllers import constant_reference, read, read_state
from thruster_env.thruster.dynamics import (
    Constants,
    driven_substep,
    substep,
    thrust_and_torque,
    thrust_and_torque_tangent,
)
from thruster_env.thruster.task import step_cost, thrust_scale

GRID = 49  # voltages over the range, and as many between the neighbours of the best one
ITERATIONS = 8  # of Gauss-Newton's method, at most; two or three are what it takes
HALVINGS = 6  # of a step that costs more
ENOUGH = 1e-9  # gain in cost by which another iteration is not worth it
REGULARISATION = 1e-9  # where thrust has no slope, at rest


class Problem(NamedTuple):
    """The parameters of plant and task that a plan uses, as plain numbers."""

    constants: Constants
    substeps: int  # of a sample time
    max_voltage: float  # [V]
    thrust_scale: float  # [N]
    tracking: float  # weights
    energy: float
    rate: float


@inlined
def predicted_cost(x, voltage, last, reference, problem):
    """Cost of the next step under a voltage [V] after the last one, and the state x after it, without noise."""
    c, top = problem.constants, problem.max_voltage
    for _ in range(problem.substeps):
        x = substep(x, (voltage, c.ambient_velocity), c)
    error = (thrust_and_torque(x, c)[0] - reference) / problem.thrust_scale
    weights = problem.tracking, problem.energy, problem.rate
    return step_cost(error, voltage / top, (voltage - last) / top, *weights), x


@inlined
def _cost_of_plan(x, plan, last, reference, problem):
    total = 0.0
    for voltage in plan:
        cost, x = predicted_cost(x, voltage, last, reference, problem)
        total += cost
        last = voltage
    return total


@inlined
def _best_of_grid(x, last, reference, middle, half, problem):
    best, least = middle, np.inf
    for i in range(GRID):
        voltage = middle + half * (2.0 * i / (GRID - 1) - 1.0)
        voltage = min(max(voltage, -problem.max_voltage), problem.max_voltage)
        cost, _ = predicted_cost(x, voltage, last, reference, problem)
        if cost < least:
            best, least = voltage, cost
    return best


def _search(states, last, references, out, problem):
    top = problem.max_voltage
    for i in range(len(states)):
        x = states[i, 0], states[i, 1]
        best = _best_of_grid(x, last[i], references[i], 0.0, top, problem)
        out[i] = _best_of_grid(x, last[i], references[i], best, 2.0 * top / (GRID - 1), problem)


@inlined
def _expand(x, plan, last, reference, problem, changes, slopes, gradient, hessian):
    """Gradient (H,) and Gauss-Newton's Hessian (H, H) of half the cost of a plan (H,), a voltage a step.

    `changes` (H, 2) and `slopes` (H,) are room for the derivatives of state and thrust by each voltage so far.
    """
    c, top = problem.constants, problem.max_voltage
    tracking, energy, rate = problem.tracking, problem.energy / top**2, problem.rate / top**2
    gradient[:] = 0.0
    hessian[:] = 0.0
    for k in range(len(plan)):
        u = plan[k], c.ambient_velocity
        after = x
        for j in range(k + 1):
            y = x[0], x[1], changes[j, 0], changes[j, 1], 0.0
            if j == k:
                y = x[0], x[1], 0.0, 0.0, 1.0
            for _ in range(problem.substeps):
                y = driven_substep(y, u, c)
            after = y[0], y[1]
            changes[j, 0], changes[j, 1] = y[2], y[3]
            slopes[j] = thrust_and_torque_tangent(after, (y[2], y[3]), c)[0] / problem.thrust_scale
        x = after
        error = (thrust_and_torque(x, c)[0] - reference) / problem.thrust_scale
        for j in range(k + 1):
            gradient[j] += tracking * error * slopes[j]
            for i in range(k + 1):
                hessian[j, i] += tracking * slopes[j] * slopes[i]
        change = plan[k] - (plan[k - 1] if k > 0 else last)
        gradient[k] += energy * plan[k] + rate * change
        hessian[k, k] += energy + rate + REGULARISATION
        if k > 0:
            gradient[k - 1] -= rate * change
            hessian[k - 1, k - 1] += rate
            hessian[k, k - 1] -= rate
            hessian[k - 1, k] -= rate


@inlined
def _hold_at_bounds(plan, gradient, hessian, top):
    """Leave out voltages at the end of the range that would go on beyond it."""
    for j in range(len(plan)):
        if (plan[j] >= top and gradient[j] < 0.0) or (plan[j] <= -top and gradient[j] > 0.0):
            gradient[j] = 0.0
            hessian[j, :] = 0.0
            hessian[:, j] = 0.0
            hessian[j, j] = 1.0


def _improve(states, last, references, plans, problem):
    horizon, top = plans.shape[1], problem.max_voltage
    changes, slopes, trial = np.zeros((horizon, 2)), np.zeros(horizon), np.zeros(horizon)
    gradient, hessian = np.zeros(horizon), np.zeros((horizon, horizon))
    for i in range(len(states)):
        x, plan = (states[i, 0], states[i, 1]), plans[i]
        cost = _cost_of_plan(x, plan, last[i], references[i], problem)
        for _ in range(ITERATIONS):
            _expand(x, plan, last[i], references[i], problem, changes, slopes, gradient, hessian)
            _hold_at_bounds(plan, gradient, hessian, top)
            step, before = np.linalg.solve(hessian, gradient), cost
            for _ in range(HALVINGS):
                for j in range(horizon):
                    trial[j] = min(max(plan[j] - step[j], -top), top)
                new = _cost_of_plan(x, trial, last[i], references[i], problem)
                if new < cost:
                    plan[:] = trial
                    cost = new
                    break
                step *= 0.5
            if not cost < before - ENOUGH:
                break


@cache
def _build(interpreting: bool):
    fingerprint = function_fingerprint(within=__name__)

    def search(states, last, references, out, problem):
        fingerprint  # noqa: B018 - part of the cache's key
        _search(states, last, references, out, problem)

    def improve(states, last, references, plans, problem):
        fingerprint  # noqa: B018 - part of the cache's key
        _improve(states, last, references, plans, problem)

    inlined(_search), inlined(_improve)
    return compiled(search), compiled(improve)


def best_voltages(states, last, references, problem: Problem) -> np.ndarray:
    """The voltage (n,) [V] of least cost in the next step: on a grid, then on a finer one about the best.

    Args:
        states: (n, 2).
        last: voltages (n,) of the step before [V].
        references: (n,) [N].
        problem: plant and task.
    """
    out = np.empty(len(states))
    _build(is_interpreting())[0](*_arrays(states, last, references), out, problem)
    return out


def improve_plans(states, last, references, plans: np.ndarray, problem: Problem) -> None:
    """Change plans (n, H) [V], a voltage for each of the next H steps, into ones of least cost nearby, in place.

        min over V_0 .. V_{H-1} within the range of  sum_k step_cost(T_{k+1} - r, V_k, V_k - V_{k-1})

    by Gauss-Newton's method with derivatives of the equations of motion, projected onto the range; a step that
    costs more is halved. The reference r is held, because the next one is unknown.

    Source: D. P. Bertsekas (1982), "Projected Newton methods for optimization problems with simple constraints",
    SIAM J. Control and Optimization 20(2), 221-246.
    """
    _build(is_interpreting())[1](*_arrays(states, last, references), plans, problem)


def _arrays(*arrays):
    return tuple(np.ascontiguousarray(array, dtype=np.float64) for array in arrays)


# Nonlinear controllers: the voltage that costs least by the equations of motion, over one step or a few.


HORIZON = 5  # steps; more change no digit of a return
HORIZONS = {"one-step": 1, "mpc": HORIZON}  # by the names that commands and tables use


@dataclass(frozen=True, eq=False)
class PredictiveController:
    """Follow a reference thrust by the state and the model, with the voltages that cost least by the reward.

        V_k, .. = argmin sum_{i=0}^{H-1} c(T(x_{k+i+1}) - r, V_{k+i}, V_{k+i} - V_{k+i-1}),   |V| <= V_max
        x_{k+i+1} = F(x_{k+i}, V_{k+i}),     c = `task.step_cost`

    the first of which is applied: model-predictive control. The reference r_{k+1} is held, because the next one is
    unknown. With H = 1, the one-step controller, V_k is the best voltage of a grid, refined once, which no local
    minimum can trap. Beyond, Gauss-Newton's method starts from it and the last plan (`planning.improve_plans`).

    There is no integral: where the thruster is not the model, an error stays. On an estimate this is certainty
    equivalence. Observations begin with omega_m and U_a, true (see `thruster_env.env.commands.ObserveState`) or
    estimated.
    """

    problem: Problem
    horizon: int = HORIZON  # H
    reference: float | None = None  # [N]; None where the observation ends with it

    @classmethod
    def for_env(cls, env, horizon: int = HORIZON, constants: Constants | None = None) -> PredictiveController:
        """A controller for a bow thruster env or vector env, from its plant and the weights of its reward.

        Args:
            env: the env, wrapped or not.
            horizon: H, steps that are planned.
            constants: of the thruster that it assumes; the plant's nominal ones if None.

        Raises:
            ValueError: if the env moves by a published linear system, or the horizon is less than 1.
        """
        plant, task = env.unwrapped.plant, env.unwrapped.task
        if plant.linear is not None:
            raise ValueError("a predictive controller must have a thruster's equations, but the env is linear")
        constants = plant.constants if constants is None else constants
        problem = Problem(constants, plant.substeps, plant.max_voltage, thrust_scale(plant), *task.weights)
        return cls(problem, at_least("horizon", horizon, 1), constant_reference(env))

    def predict(self, observation, state=None, episode_start=None, deterministic: bool = True):
        """Voltage (..., 1) for an observation (..., d), and state (..., H): the plan [V], V_k first.

        Raises ValueError for an observation that is too short to hold the state.
        """
        observation, reference = read(observation, self.reference)
        states = read_state(observation, self.reference).reshape(-1, 2)
        before = remembered(state, episode_start, np.zeros((*reference.shape, self.horizon)))
        before, references = before.reshape(-1, self.horizon), reference.ravel()
        first = best_voltages(states, before[:, 0], references, self.problem)
        # What follows starts as it was planned; the last voltage that was, again.
        plans = np.concatenate([first[:, None], before[:, 2:], before[:, -1:]], axis=1)[:, : self.horizon]
        if self.horizon > 1:
            improve_plans(states, before[:, 0], references, plans, self.problem)
        plans = plans.reshape(*reference.shape, self.horizon)
        return plans[..., :1].astype(np.float32), plans
