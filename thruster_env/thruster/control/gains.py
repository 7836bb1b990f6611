"""The gains of classical controllers, from the plant about an operating point."""

from __future__ import annotations

import math

import numpy as np

from thruster_env.core.checks import finite, positive
from thruster_env.thruster.linear.operating import sampled_plant
from thruster_env.thruster.plant import Plant
from thruster_env.thruster.task import Task, thrust_scale


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
