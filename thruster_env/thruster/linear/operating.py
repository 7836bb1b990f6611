"""Operating points: the steady state of every voltage, looked up by thrust, and the sampled plant about it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thruster_env.core.matrices import zero_order_hold
from thruster_env.thruster.dynamics import thrust_and_torque
from thruster_env.thruster.linear.analysis import SteadyState, equilibrium, jacobians, steady_state
from thruster_env.thruster.plant import Plant

# T(V_s) is about a parabola, so a straight line between two points errs by T_max/(POINTS - 1)^2, 2.5e-4 of T_max.
# An even number leaves out the thruster at rest, where thrust has no slope and no feedback a gain.
POINTS = 64


class OperatingPoints(NamedTuple):
    """Steady states over the voltage range, in the order of their thrust."""

    thrust: np.ndarray  # (n,) [N], increasing
    voltage: np.ndarray  # (n,) [V]
    flow: np.ndarray  # (n,) U_a [m/s]

    def interpolate(self, values: np.ndarray, thrust):
        """Values (n,), one for each point, between the points where the thrust (...) [N] is; (...).

        A thrust out of range counts as the nearest one within.
        """
        return np.interp(thrust, self.thrust, values)


def operating_points(plant: Plant) -> OperatingPoints:
    """Steady states of `POINTS` voltages from -max_voltage to max_voltage, for the plant's nominal parameters.

    Near zero volts an ambient flow may turn the propeller so that more voltage gives less thrust for a while;
    points that do not add to the thrust are left out. (Against a strong flow the steady thrust may also jump; no
    voltage gives what lies between.)

    Raises:
        ValueError: if a steady state is not found.
    """
    voltage = np.linspace(-plant.max_voltage, plant.max_voltage, POINTS)
    states = np.array([settled(plant, v) for v in voltage])
    if states[0, 2] > states[-1, 2]:  # a published linear system pushes astern with a positive voltage
        voltage, states = voltage[::-1], states[::-1]
    thrust = states[:, 2]
    adds = np.append(True, thrust[1:] > np.maximum.accumulate(thrust)[:-1])
    return OperatingPoints(thrust[adds], voltage[adds], states[adds, 1])


def settled(plant: Plant, voltage: float) -> SteadyState:
    """The steady state of a voltage [V] in the plant's constant ambient flow.

    Raises:
        ValueError: if it is not found.
    """
    if plant.linear is None:
        return steady_state(plant.parameters, float(voltage), plant.ambient_velocity)
    return SteadyState(*map(float, equilibrium(plant.linear, (voltage, plant.ambient_velocity))))


def thrust_of(plant: Plant, states: np.ndarray) -> np.ndarray:
    """Thrust (...) [N] of states (..., 2), for the plant's nominal parameters."""
    if plant.linear is None:
        return thrust_and_torque((states[..., 0], states[..., 1]), plant.constants)[0]
    return states @ plant.linear.c[0]


def slopes(plant: Plant, voltage: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The plant about the steady state of a voltage [V]: A (2, 2), B (2, 1) and C (1, 2) of dx/dt = A dx + B dV.

    These are for small deviations of x = (omega_m [rad/s], U_a [m/s]) and V_s [V]; the thrust's is dT = C dx [N].

    Raises:
        ValueError: if the steady state is not found.
    """
    if plant.linear is not None:
        return plant.linear.a, plant.linear.b[:, :1], plant.linear.c
    return jacobians(plant.parameters, settled(plant, voltage)[:2], voltage, plant.ambient_velocity)


def sampled_plant(plant: Plant, voltage: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A_d (2, 2), B_d (2, 1) and C (1, 2) of dx_{k+1} = A_d dx_k + B_d dV_k: the zero-order hold of `slopes`."""
    a, b, c = slopes(plant, voltage)
    return *zero_order_hold(a, b, plant.dt), c
