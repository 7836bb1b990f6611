"""A thruster and its speed controller from a bollard table: what a static table determines.

A table of steady states at zero flow determines ratios only. With thrust T and propeller torque Q proportional to
omega_m^2 there, it fixes

    T/omega_m^2 ahead and astern       C_Lmax and the thrust asymmetry e, once blade angle and K4 are given
    K1/K2 and K_h Q/(K2 omega_m^2)     speed from voltage: K2 V_s = K1 omega_m + K_h Q
    Q/omega_m^2                        C_Dmax, if current times K1/K2 is torque (a motor without friction)

It fixes neither K_h and K3, on which all time constants depend, nor blade angle and K4. Those are inferred.

Current is measured at the supply. The motor's current is assumed to be that divided by the throttle.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from thruster_env.thruster.dynamics import thrust_and_torque
from thruster_env.thruster.linear.analysis import steady_state
from thruster_env.thruster.parameters import ThrusterParameters, derive_constants
from tuning.experiments.bollard_table import CENTRE, SPAN, BollardTable

FITTED = ("lift_coefficient", "drag_coefficient", "thrust_asymmetry", "motor_damping", "voltage_gain")
SMALL_ERROR = (
    0.02  # relative; larger errors are errors of the model, and are weighted linearly, not by their square
)
DEAD_BAND = 28.0  # half of the dead band [us]; 24 to 40 in the table of the T200


class PulseWidthMap(NamedTuple):
    """The speed controller: from pulse width and supply voltage V to the V_s of the model.

        throttle = (pulse width - 1500 us)/400 us,  V_s = throttle V (1 - droop V), times astern_gain astern

    The droop represents all losses before the motor: a higher supply raises the speed by less than the motor alone
    would explain, and at part throttle above 16 V not at all. The gain compensates the error of the model's torque
    astern; for the T200 it is 1.01.

    Fitted for supplies of 10 to 20 V, V_s of 8 to 13 V at full throttle.
    """

    droop: float  # [1/V]
    astern_gain: float  # [-]

    def source_voltage(self, pulse_width, supply):
        """V_s [V] for a pulse width [us] and a supply voltage [V], negative astern; arrays allowed."""
        offset = np.asarray(pulse_width, dtype=float) - CENTRE
        throttle = np.where(np.abs(offset) <= DEAD_BAND, 0.0, np.clip(offset / SPAN, -1.0, 1.0))
        left = supply * (1.0 - self.droop * supply)
        return throttle * left * np.where(offset < 0, self.astern_gain, 1.0)


class Identified(NamedTuple):
    """A thruster with its speed controller."""

    thruster: ThrusterParameters
    pulse_widths: PulseWidthMap


class Prediction(NamedTuple):
    """Predictions of a thruster for the rows of a table, arrays (n,)."""

    thrust_from_speed: np.ndarray  # from the measured speed [N]
    current_from_speed: np.ndarray  # from the measured speed and the throttle [A]
    speed: np.ndarray  # from pulse width and supply [rad/s]
    thrust: np.ndarray  # from pulse width and supply [N]


def bollard_forces(p: ThrusterParameters) -> np.ndarray:
    """Steady thrust [N s^2] and torque [N m s^2] over omega_m^2 at U_0 = 0: rows astern and ahead, (2, 2)."""
    c = derive_constants(p)
    states = [steady_state(p, voltage) for voltage in (-1.0, 1.0)]  # the ratio is the same at any voltage
    forces = [thrust_and_torque((s.omega_m, s.U_a), c) for s in states]
    return np.array([np.abs(f) / s.omega_m**2 for f, s in zip(forces, states, strict=True)])


def predict(found: Identified, table: BollardTable) -> Prediction:
    """Steady states of the thruster in every row: K_h Q + K1 omega_m = K2 |V_s|, a quadratic in omega_m."""
    p = found.thruster
    thrust, torque = bollard_forces(p)[table.ahead.astype(int)].T
    drive = p.voltage_gain * np.abs(found.pulse_widths.source_voltage(table.pulse_width, table.supply))
    load = p.load_gain * torque
    speed = 2 * drive / (p.motor_damping + (p.motor_damping**2 + 4 * load * drive) ** 0.5)
    throttle = np.abs(table.pulse_width - CENTRE) / SPAN
    motor_current = torque * table.speed**2 * p.voltage_gain / p.motor_damping
    return Prediction(thrust * table.speed**2, throttle * motor_current, speed, thrust * speed**2)


def identify(table: BollardTable, held_out: Sequence[float], inferred: ThrusterParameters) -> Identified:
    """Fit five parameters of the thruster (FITTED) and two of its speed controller to a table.

    The least squares of three relative errors, in both directions: of thrust from measured speed, of thrust from
    pulse width and supply, and of current from measured speed.

    Args:
        table: rows that `read_table` gives.
        held_out: supply voltages [V] that are held out.
        inferred: the thruster with the other parameters; its gear ratio is 1, as the motor's speed is measured.

    Returns:
        `Identified`.

    Raises:
        ValueError: if a voltage to hold out is not in the table, or too few would be left to fit.
    """
    from scipy.optimize import least_squares

    rows = table.select(~is_held_out(table, held_out))

    def found(numbers) -> Identified:
        values = [float(number) for number in numbers]
        changes: dict[str, Any] = dict(zip(FITTED, values[:5], strict=True))
        thruster = inferred._replace(**changes)
        return Identified(thruster, PulseWidthMap(*values[5:]))

    def errors(numbers):
        guess = predict(found(numbers), rows)
        return np.concatenate(
            [
                np.log(guess.thrust_from_speed / rows.thrust),
                np.log(guess.thrust / rows.thrust),
                np.log(guess.current_from_speed / rows.current),
            ]
        )

    start = np.array([0.5, 0.2, 0.1, 50.0, 2000.0, 0.01, 1.0])
    least = np.array([1e-3, 0.0, -0.9, 1e-3, 1.0, 0.0, 0.1])
    most = np.array([10.0, 10.0, 0.9, 1e5, 1e7, 0.9 / table.supply.max(), 10.0])
    fit = least_squares(
        errors,
        start,
        bounds=(least, most),
        x_scale=start,
        loss="soft_l1",
        f_scale=SMALL_ERROR,
        xtol=1e-12,
        ftol=1e-12,
        gtol=1e-12,
    )
    return found(fit.x)


def is_held_out(table: BollardTable, held_out: Sequence[float]) -> np.ndarray:
    """Which rows (n,) are of held-out voltages; ValueError if those are not in the table."""
    supplies = np.unique(table.supply)
    if not held_out or not set(held_out) <= set(supplies) or len(supplies) - len(set(held_out)) < 2:
        raise ValueError(
            f"held-out voltages must be some of {', '.join(f'{v:g}' for v in supplies)} V that leave at least two "
            f"to fit, but got {', '.join(f'{v:g}' for v in held_out) or 'none'}"
        )
    return np.isin(table.supply, held_out)


def relative_errors(found: Identified, table: BollardTable, held_out: Sequence[float]) -> dict:
    """Median and 90th percentile of relative errors [-], by quantity, then group of rows, then direction."""
    guess, out = predict(found, table), is_held_out(table, held_out)
    ratios = {
        "thrust from measured speed": guess.thrust_from_speed / table.thrust,
        "thrust from pulse width and supply": guess.thrust / table.thrust,
        "speed from pulse width and supply": guess.speed / table.speed,
        "current from measured speed": guess.current_from_speed / table.current,
    }
    groups = {"fitted": ~out, "held out": out}
    directions = {"ahead": table.ahead, "astern": ~table.ahead}
    return {
        quantity: {
            group: {
                direction: {
                    "median": float(np.median(np.abs(ratio[rows & those] - 1))),
                    "90 %": float(np.quantile(np.abs(ratio[rows & those] - 1), 0.9)),
                }
                for direction, those in directions.items()
            }
            for group, rows in groups.items()
        }
        for quantity, ratio in ratios.items()
    }
