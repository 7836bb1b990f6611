"""Classical controllers as policies: PI with feed-forward on the measured thrust, LQR on the true state.

Both know the plant's nominal parameters. Both have Stable-Baselines3's `predict(observation, state, episode_start,
deterministic) -> (action, state)`, for one observation (d,) or one of each env (n, d). Actions are voltages [V],
(1,) or (n, 1). A controller's memory is `state`, (k,) or (n, k): pass None at first, then the state that the last
call returned. Rows where `episode_start` is true forget. (Where a vector env resets on the next step, an episode
starts one step after the last one was done.)
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import at_least, finite, positive
from thruster_env.core.compiled import is_interpreting
from thruster_env.env.model_env import remembered
from thruster_env.graphs.loops import Loops
from thruster_env.thruster.dynamics import (
    Constants,
    driven_substep,
    substep,
    thrust_and_torque,
    thrust_and_torque_tangent,
)
from thruster_env.thruster.equations import step_cost
from thruster_env.thruster.linear import OperatingPoints, operating_points, sampled_plant, slopes, thrust_of
from thruster_env.thruster.plant import Plant, Task, thrust_scale


def lambda_gains(
    plant: Plant, operating_voltage: float | None = None, time_constant: float | None = None
) -> tuple[float, float]:
    """Gains K_p [V/N] and K_i [V/(N s)] of a PI controller for a closed-loop time constant lambda.

        K_p = (1 - exp(-dt/lambda))/(C B_d),    K_i dt = K_p (1 - p)

    C B_d is the thrust [N] that one volt adds within a sample time, p the faster eigenvalue of A_d, the motor's.
    This is Dahlin's controller for the lag C B_d/(z - p), and the loop is (1 - exp(-dt/lambda))/(z - 1).

    The lag leaves out the flow, on purpose: thrust comes with the motor's speed, then the flow takes part of it
    away. That is a zero slower than the flow's pole, beyond which the plant has several times its steady gain
    (`tunnel` three times). The steady gain and the flow's time constant would make the gains far too large.

    Args:
        plant: the plant.
        operating_voltage: where the plant is linearised [V]; half of max_voltage by default. The loop gain grows
            with the voltage, at most in proportion: at max_voltage it is then 0.79 or less, where 2 is unstable.
        time_constant: lambda [s]; by default that of the motor, or two sample times if these are longer.

    Raises:
        ValueError: if an argument is wrong, or the plant is unstable or its thrust has no slope there.

    Source: E. B. Dahlin (1968), "Designing and tuning digital controllers", Instruments and Control Systems 41(6);
    for zeros, S. Skogestad (2003), "Simple analytic rules for model reduction and PID controller tuning",
    J. Process Control 13(4), 291-309.
    """
    half = plant.max_voltage / 2
    voltage = half if operating_voltage is None else finite("operating_voltage", operating_voltage)
    a_d, b_d, c = sampled_plant(plant, voltage)
    moduli, slope = np.abs(np.linalg.eigvals(a_d)), float((c @ b_d).item())
    if moduli.max() >= 1 or slope == 0:
        rule = "operating_voltage must be such that the plant is stable and its thrust has a slope"
        raise ValueError(f"{rule}, but got {voltage}")
    motor = float(moduli.min())
    if time_constant is None:
        time_constant = max(2 * plant.dt, -plant.dt / math.log(motor))
    proportional = -math.expm1(-plant.dt / positive("time_constant", time_constant)) / slope
    return proportional, proportional * (1 - motor) / plant.dt


def quadratic_problem(plant: Plant, task: Task, voltage: float) -> tuple[np.ndarray, ...]:
    """A (3, 3), B (3, 1), Q (3, 3), R (1, 1) and S (3, 1) of what a task costs about a steady state.

        J = sum_k  tracking (dT_{k+1}/T_max)^2 + energy (dV_k/V_max)^2 + voltage_rate ((dV_k - dV_{k-1})/V_max)^2

    for deviations dx, dT = C dx and dV from the steady state of a voltage [V]. With s_k = (dx_k, dV_{k-1}) that is

        s_{k+1} = A s_k + B dV_k,    A = [[A_d, 0], [0, 0]],    B = [B_d; 1]
        J = sum_k  s_k' Q s_k + 2 s_k' S dV_k + R dV_k^2
        Q = diag(tracking C'C/T_max^2, voltage_rate/V_max^2)
        S = (0, 0, -voltage_rate/V_max^2)',    R = (energy + voltage_rate)/V_max^2

    except for the cost of dT_0, which no voltage changes. Of the energy only the deviation counts; the energy that
    holds the thrust itself would move the operating point.
    """
    a_d, b_d, c = sampled_plant(plant, voltage)
    tracking, energy, rate = task.weights
    per_volt = 1.0 / plant.max_voltage**2
    a, q = np.zeros((3, 3)), np.zeros((3, 3))
    a[:2, :2] = a_d
    q[:2, :2] = tracking / thrust_scale(plant) ** 2 * c.T @ c
    q[2, 2] = rate * per_volt
    s = np.array([[0.0], [0.0], [-rate * per_volt]])
    return a, np.vstack([b_d, [[1.0]]]), q, np.array([[(energy + rate) * per_volt]]), s


def quadratic_gain(plant: Plant, task: Task, voltage: float) -> np.ndarray:
    """The gain K (3,) of dV_k = -K s_k that minimises the cost of `quadratic_problem`.

        K = (R + B'PB)^-1 (B'PA + S'),    P = Q + A'PA - (A'PB + S) K

    Units are V s/rad, V s/m and 1.

    Raises:
        ValueError: if the task has no weight on tracking, or thrust at that voltage does not depend on the state.
    """
    from scipy.linalg import solve_discrete_are

    positive("tracking_weight", task.weights[0])
    a, b, q, r, s = quadratic_problem(plant, task, voltage)
    try:
        p = solve_discrete_are(a, b, q, r, s=s)
        return np.linalg.solve(r + b.T @ p @ b, b.T @ p @ a + s.T)[0]
    except np.linalg.LinAlgError as error:
        raise ValueError(
            f"voltage must be such that feedback has an effect, but got {voltage:g} V: {error}"
        ) from None


@dataclass(frozen=True, eq=False)
class PIController:
    """Follow a reference thrust by the measured one.

        V_k = V*(r_{k+1}) + K_p e_k + I_k,    cut off at the voltage range
        e_k = r_k - z_k,                      I_{k+1} = I_k + K_i dt e_k

    V*(r) is the voltage whose steady thrust is r, or the last one within the range: feed-forward. The measurement
    z_k is compared with the reference of its own time (with r_1 at the start), because a step of the reference to
    which the thrust cannot have responded yet is not an error. With both gains zero the controller is feed-forward
    alone.

    Against windup the integral is clamped: it stands still while the voltage is cut off and the error drives it
    further out. Source: K. J. Astrom, L. Rundqwist (1989), "Integrator windup and how to avoid it", American
    Control Conference, 1693-1698 (conditional integration).

    A missing measurement is taken as the env repeats it.
    """

    plant: Plant
    points: OperatingPoints
    proportional_gain: float  # K_p [V/N]
    integral_gain: float  # K_i [V/(N s)]
    thrust_entry: int = 0  # of the observation: the measured thrust
    reference: float | None = None  # [N]; None where the observation ends with it

    @classmethod
    def for_env(
        cls,
        env,
        proportional_gain: float | None = None,
        integral_gain: float | None = None,
        operating_voltage: float | None = None,
        time_constant: float | None = None,
    ) -> PIController:
        """A controller for a bow thruster env or vector env that shows its measurement and takes volts.

        Args:
            env: the env, wrapped or not.
            proportional_gain: K_p [V/N]; that of `lambda_gains` if None.
            integral_gain: K_i [V/(N s)]; that of `lambda_gains` if None.
            operating_voltage: where `lambda_gains` linearises [V].
            time_constant: closed-loop time constant for `lambda_gains` [s].

        Raises:
            ValueError: if the env does not measure its thrust, an argument is wrong, or the rule finds no gains.
        """
        plant = env.unwrapped.plant
        if "thrust" not in plant.channels:
            raise ValueError(f"sensors must include the thrust, but the env has {', '.join(plant.channels)}")
        if proportional_gain is None or integral_gain is None:
            gains = lambda_gains(plant, operating_voltage, time_constant)
            proportional_gain = gains[0] if proportional_gain is None else proportional_gain
            integral_gain = gains[1] if integral_gain is None else integral_gain
        return cls(
            plant,
            operating_points(plant),
            finite("proportional_gain", proportional_gain),
            finite("integral_gain", integral_gain),
            plant.channels.index("thrust"),
            constant_reference(env),
        )

    def predict(self, observation, state=None, episode_start=None, deterministic: bool = True):
        """Voltage (..., 1) for an observation (..., d), and state (..., 2): I_{k+1} [V] and r_{k+1} [N]."""
        observation, reference = read(observation, self.reference)
        at_start = np.stack([np.zeros_like(reference), reference], axis=-1)
        integral, present_reference = np.moveaxis(remembered(state, episode_start, at_start), -1, 0)
        error = present_reference - observation[..., self.thrust_entry]
        steady = self.points.interpolate(self.points.voltage, reference)
        wanted = steady + self.proportional_gain * error + integral
        voltage = np.clip(wanted, -self.plant.max_voltage, self.plant.max_voltage)
        change = self.integral_gain * self.plant.dt * error
        integral = integral + np.where(change * (wanted - voltage) > 0, 0.0, change)
        return voltage[..., None].astype(np.float32), np.stack([integral, reference], axis=-1)


@dataclass(frozen=True, eq=False)
class LQRController:
    """Follow a reference thrust by the true state, with the feedback that is optimal for the reward.

        V_k = V* - K_T (T(x_k) - r) - K_U (U_a - U_a*) - K_V (V_{k-1} - V*),    cut off at the voltage range

    V* and U_a* belong to the steady state whose thrust is the reference r_{k+1}, or to the last one within the
    range; K is the gain of `gains.quadratic_gain` there. So the gain changes with the reference (gain scheduling).
    The last voltage is in it because the reward counts its change.

    The deviation of the motor speed is written as one of the thrust. With dT = C_omega domega_m + C_U dU_a the
    feedback K_1 domega_m + K_2 dU_a is K_T dT + K_U dU_a, where K_T = K_1/C_omega and K_U = K_2 - K_T C_U, to
    first order. But thrust is quadratic in the state: far from the operating point C dx is wrong, and T(x) - r is
    not. (On `tunnel`, whose flow lags far behind, the three tasks cost 0.4 to 0.6 of their cost with domega_m.)

    There is no integral: where the thruster is not the nominal one, an error stays. Observations begin with
    omega_m and U_a, true (see `thruster_env.env.env.ObserveState`) or estimated.
    """

    plant: Plant
    points: OperatingPoints
    gains: np.ndarray  # (3, n): K_T [V/N], K_U [V s/m] and K_V [-] of every point
    reference: float | None = None  # [N]; None where the observation ends with it

    @classmethod
    def for_env(cls, env) -> LQRController:
        """A controller for a bow thruster env or vector env, from its plant and the weights of its reward.

        Raises:
            ValueError: if `quadratic_gain` finds no gain.
        """
        plant, task = env.unwrapped.plant, env.unwrapped.task
        points = operating_points(plant)
        by_speed, by_flow, by_voltage = np.array([quadratic_gain(plant, task, v) for v in points.voltage]).T
        of_speed, of_flow = np.array([slopes(plant, v)[2][0] for v in points.voltage]).T
        by_thrust = by_speed / of_speed
        gains = np.stack([by_thrust, by_flow - by_thrust * of_flow, by_voltage])
        return cls(plant, points, gains, constant_reference(env))

    def predict(self, observation, state=None, episode_start=None, deterministic: bool = True):
        """Voltage (..., 1) for an observation (..., d), and state (..., 1): the same voltage, V_k [V].

        Raises ValueError for an observation that is too short to hold the state.
        """
        observation, reference = read(observation, self.reference)
        states = read_state(observation, self.reference)
        last_voltage = remembered(state, episode_start, np.zeros((*reference.shape, 1)))[..., 0]
        thrust, voltage, flow = (self.points.interpolate(values, reference) for values in self.points)
        by_thrust, by_flow, by_voltage = (self.points.interpolate(gain, reference) for gain in self.gains)
        wanted = (
            voltage
            - by_thrust * (thrust_of(self.plant, states) - thrust)
            - by_flow * (states[..., 1] - flow)
            - by_voltage * (last_voltage - voltage)
        )
        voltage = np.clip(wanted, -self.plant.max_voltage, self.plant.max_voltage)[..., None]
        return voltage.astype(np.float32), voltage


def constant_reference(env) -> float | None:
    """The reference [N] of an env that does not observe it; None if it does."""
    base = env.unwrapped
    if getattr(base, "single_env", base).observes_reference:
        return None
    return float(base.task.reference[0].thrust)


def read(observation, reference: float | None) -> tuple[np.ndarray, np.ndarray]:
    """Observation (..., d) in float64 and the reference (...) [N]."""
    observation = np.asarray(observation, dtype=np.float64)
    if reference is None:
        return observation, observation[..., -1]
    return observation, np.full(observation.shape[:-1], reference)


def read_state(observation: np.ndarray, reference: float | None) -> np.ndarray:
    """The state (..., 2) that an observation (..., d) begins with; ValueError if it is too short to hold one."""
    if observation.shape[-1] < 2 + (reference is None):
        rule = "an observation must begin with the state"
        raise ValueError(f"{rule}, but has {observation.shape[-1]} entries: see thruster_env.env.env.ObserveState")
    return observation[..., :2]


# Optimal voltages over the next steps by the equations of motion: a grid search, and Gauss-Newton's method.
#
# The cost is the env's own, `step_cost`, of the thrust that the model predicts. Compiled, copy by copy.
#
# They have the `predict` of `controllers` and the inputs of the LQR there: state, true or estimated, and the
# reference of the next step. They plan with a thruster's nominal equations, without noise, dead bands, a changing
# flow or a changing reference.


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


def predicted_cost(x, voltage, last, reference, problem):
    """Cost of the next step under a voltage [V] after the last one, and the state x after it, without noise."""
    c, top = problem.constants, problem.max_voltage
    for _ in range(problem.substeps):
        x = substep(x, (voltage, c.ambient_velocity), c)
    error = (thrust_and_torque(x, c)[0] - reference) / problem.thrust_scale
    weights = problem.tracking, problem.energy, problem.rate
    return step_cost(error, voltage / top, (voltage - last) / top, *weights), x


def _cost_of_plan(x, plan, last, reference, problem):
    total = 0.0
    for voltage in plan:
        cost, x = predicted_cost(x, voltage, last, reference, problem)
        total += cost
        last = voltage
    return total


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


def _hold_at_bounds(plan, gradient, hessian, top):
    """Leave out voltages at the end of the range that would go on beyond it."""
    for j in range(len(plan)):
        if (plan[j] >= top and gradient[j] < 0.0) or (plan[j] <= -top and gradient[j] > 0.0):
            gradient[j] = 0.0
            hessian[j, :] = 0.0
            hessian[:, j] = 0.0
            hessian[j, j] = 1.0


def _divide(x, a):
    """Change x into A^-1 x of a positive definite A, by elimination, which changes A."""
    for i in range(len(x)):
        for j in range(i + 1, len(x)):
            factor = a[j, i] / a[i, i]
            x[j] -= factor * x[i]
            for k in range(i, len(x)):
                a[j, k] -= factor * a[i, k]
    for i in range(len(x) - 1, -1, -1):
        for j in range(i + 1, len(x)):
            x[i] -= a[i, j] * x[j]
        x[i] /= a[i, i]


def _improve(states, last, references, plans, problem):
    horizon, top = plans.shape[1], problem.max_voltage
    changes, slopes = np.zeros((horizon, 2)), np.zeros(horizon)
    step, trial = np.zeros(horizon), np.zeros(horizon)
    gradient, hessian = np.zeros(horizon), np.zeros((horizon, horizon))
    for i in range(len(states)):
        x, plan = (states[i, 0], states[i, 1]), plans[i]
        cost = _cost_of_plan(x, plan, last[i], references[i], problem)
        for _ in range(ITERATIONS):
            _expand(x, plan, last[i], references[i], problem, changes, slopes, gradient, hessian)
            _hold_at_bounds(plan, gradient, hessian, top)
            step[:], before = gradient, cost
            _divide(step, hessian)
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
def _build(interpreting: bool) -> tuple[Loops, Loops]:
    return Loops(_search), Loops(_improve)


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


HORIZON = 5  # steps; more change no digit of a return
HORIZONS = {"one-step": 1, "mpc": HORIZON}  # by the names that commands and tables use


@dataclass(frozen=True, eq=False)
class PredictiveController:
    """Follow a reference thrust by the state and the model, with the voltages that cost least by the reward.

        V_k, .. = argmin sum_{i=0}^{H-1} c(T(x_{k+i+1}) - r, V_{k+i}, V_{k+i} - V_{k+i-1}),   |V| <= V_max
        x_{k+i+1} = F(x_{k+i}, V_{k+i}),     c = `step_cost`

    the first of which is applied: model-predictive control. The reference r_{k+1} is held, because the next one is
    unknown. With H = 1, the one-step controller, V_k is the best voltage of a grid, refined once, which no local
    minimum can trap. Beyond, Gauss-Newton's method starts from it and the last plan (`improve_plans`).

    There is no integral: where the thruster is not the model, an error stays. On an estimate this is certainty
    equivalence. Observations begin with omega_m and U_a, true (see `thruster_env.env.env.ObserveState`) or
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
