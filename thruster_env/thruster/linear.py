"""The linear bow thrusters that the papers print, as data.

Two papers print the same two linear models, "tunnel" and "open-bladed", beside the nonlinear equations and the
parameters that `dynamics` and `parameters` hold. They are no linearisation of those. For small deviations from
an operating point the equations give

    A_11 = -K1 - K_h dQ/d omega_m    A_12 = -K_h dQ/dU_a    B_11 = K2
    A_21 = C_1/K3                    A_22 = C_2/K3 - B_22   B_22 = 2 (K4/K3) |U_a - U_0|

with C = (dT/d omega_m, dT/dU_a). So A_11, A_12 and C fix the four slopes of thrust and torque. In every state
(omega_m, U_a), for any area and pair of angles, at least one slope of the model has the opposite sign.

Other open questions of the print:

- Open-bladed: A_22 = -0.13 contradicts C_2/K3 - B_22 = -10.4/4 - 2.73 = -5.33, with which the system would be
  stable. That it is unstable is therefore a slip of the print. (The tunnel's own numbers agree:
  -12.2/0.954 - 1.9 = -14.7 beside -14.8.)
- Tunnel: -C A^-1 B is -4.8 N/V, so its thrust falls as the voltage grows, and A_21 < 0
  makes the water flow against the propeller.
- Open-bladed: its eigenvalue 3.1872 is printed "31872", and its characteristic polynomial has 528.83 where
  the trace gives 523.83.
- Open-bladed: B_11 = 0.65 here; Nurhadi et al. print 0.065, but the printed B_d follows from 0.65 only.
- The tunnel's C serves as measurement matrix in both cases of the papers' runs: see
  `tuning.experiments.thruster_papers`.

Sources: M. Kiki (2020), final project KM184801, Institut Teknologi Sepuluh Nopember, Surabaya (in Indonesian);
H. Nurhadi, M. Kiki, D. Adzkiya, T. Herlambang (2022), IJECE 12(6), 5988-5997,
doi:10.11591/ijece.v12i6.pp5988-5997.

Operating points: the steady state of every voltage, looked up by thrust, and the sampled plant about it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from thruster_env.core.checks import one_of, takes_arguments_of
from thruster_env.core.matrices import zero_order_hold
from thruster_env.thruster.analysis import LinearModel, SteadyState, equilibrium, jacobians, steady_state
from thruster_env.thruster.dynamics import thrust_and_torque
from thruster_env.thruster.plant import Plant, make_plant

SAMPLE_TIME = 0.01  # [s], of the printed zero-order hold

Rows = tuple[tuple[float, ...], ...]


class PublishedLinearModel(NamedTuple):
    """dx/dt = A x + B u, T = C x for x = (omega_m [rad/s], U_a [m/s]), u = (V_s [V], U_0 [m/s]), T in N.

    Matrices are rows of floats. A_d and B_d are the zero-order hold as printed, with four decimals.
    """

    a: Rows  # A (2, 2)
    b: Rows  # B (2, 2)
    c: Rows  # C (1, 2)
    printed_a_d: Rows  # A_d (2, 2) at SAMPLE_TIME
    printed_b_d: Rows  # B_d (2, 2)
    presets: tuple[str, ...]  # presets of the same thruster, beside which the model can be shown
    source: str
    remark: str  # what a reader must know of the print


SOURCE = "Kiki (2020); Nurhadi et al. (2022), IJECE 12(6), 5988-5997"

PUBLISHED: dict[str, PublishedLinearModel] = {
    "tunnel": PublishedLinearModel(
        a=((-70.7, 1.2), (-2.1, -14.8)),
        b=((1133.2, 0.0), (0.0, 1.9)),
        c=((-2.03, -12.2),),
        printed_a_d=((0.4930, 0.0079), (-0.0139, 0.8623)),
        printed_b_d=((8.1241, 0.0001), (-0.0905, 0.0177)),
        presets=("tunnel", "tunnel_physical"),
        source=SOURCE,
        remark="Its A, B and C agree with one another, but its thrust falls as the voltage grows.",
    ),
    "open_bladed": PublishedLinearModel(
        a=((-523.7, -1519.8), (-1.15, -0.13)),
        b=((0.65, 0.0), (0.0, 2.73)),
        c=((-4.62, -10.4),),
        printed_a_d=((0.0116, -2.9445), (-0.0022, 1.0260)),
        printed_b_d=((0.0013, -0.0647), (0.0, 0.0276)),
        presets=("open_bladed", "open_bladed_corrected"),
        source=SOURCE,
        remark="Its A_22 of -0.13 contradicts its B and C, which give -5.33: that it is unstable is a slip.",
    ),
}

NO_LINEARISATION = (
    "The published matrices are kept as data. They are not a linearisation of the equations printed beside "
    "them, in which at least one slope of thrust or torque has the opposite sign in every state."
)


PUBLISHED_NOISE = 0.5  # variance of each state a step, and of the measurement, in the published runs


@takes_arguments_of(make_plant, leaving_out=["preset", "uncertainty", "substeps"])
def make_linear_plant(system: str = "tunnel", **plant_arguments) -> Plant:
    """Make a plant that follows a published linear system instead of the equations of motion.

    Args:
        system: "tunnel" or "open_bladed"; see `published`.
        **plant_arguments: those of `make_plant`, without preset, uncertainty and substeps; measurement_noise_cov
            is the published 0.5 for every channel if None.

    Raises:
        ValueError: if an argument is wrong; the message states the rule and the value.
    """
    model = PUBLISHED[one_of("system", system, tuple(PUBLISHED))]
    plant = make_plant("tunnel", substeps=1, **plant_arguments)
    if "current" in plant.channels:
        raise ValueError("the linear systems must be measured by other channels than the current, which they lack")
    dynamics = LinearModel(*(np.array(matrix) for matrix in (model.a, model.b, model.c)))
    plant = plant._replace(linear=dynamics)
    if plant_arguments["measurement_noise_cov"] is None:
        return plant._replace(measurement_noise_cov=PUBLISHED_NOISE * np.eye(len(plant.channels)))
    return plant


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
