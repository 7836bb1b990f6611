"""Nonlinear controllers: the voltage that costs least by the equations of motion, over one step or a few.

They have the `predict` of `control.controllers` and the inputs of the LQR there: state, true or estimated, and the
reference of the next step. They plan with a thruster's nominal equations, without noise, dead bands, a changing
flow or a changing reference.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from thruster_env.core.checks import at_least
from thruster_env.thruster.control.controllers import constant_reference, read, read_state, remembered
from thruster_env.thruster.control.planning import Problem, best_voltages, improve_plans
from thruster_env.thruster.dynamics import Constants
from thruster_env.thruster.task import thrust_scale

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
    equivalence. Observations begin with omega_m and U_a, true (see `thruster_env.env.observe.ObserveState`) or
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
