"""State of charge of a lithium cell from current and terminal voltage.

    s' = -i/C,   v_1' = i/C_1 - v_1/(R_1 C_1),   v_2' likewise;   z = E(s) - v_1 - v_2 - R_0 i,
    E(s) = -1.031 exp(-35 s) + 3.685 + 0.2156 s - 0.1178 s^2 + 0.3201 s^3

The current of the step before is a fourth state, without noise; h(x, u, c) would need none.

What I had: the published constants, a Q of a tenth of a per cent of charge a step, a voltmeter of 1 mV. The cell
has aged: an eighth of its capacity is gone, R_0 has grown by a third. The current sensor is off by 10 mA and the
voltmeter has 4 mV.

Source: M. Chen, G. A. Rincon-Mora (2006), "Accurate electrical battery model capable of predicting runtime and
I-V performance", IEEE Trans. Energy Conversion 21(2), 504-511 (a cell of 850 mAh; its R_0, R_1, C_1, R_2, C_2
above 20 % charge).
"""

import math
from typing import NamedTuple

from filters import StateSpaceModel
from thruster_env.core.derivatives import runge_kutta
from tuning.problems.model_problem import ModelProblem

DT = 5.0  # [s]


class Constants(NamedTuple):
    """Numbers of a cell and its sensor of current."""

    substep: float = DT
    capacity: float = 0.85 * 3600.0  # C [A s]
    series: float = 0.07446  # R_0 [ohm]
    short: float = 0.04669  # R_1 [ohm]
    short_capacity: float = 703.6  # C_1 [F]
    long: float = 0.04984  # R_2 [ohm]
    long_capacity: float = 4475.0  # C_2 [F]
    offset: float = 0.0  # true current less the measured one [A]


def rates(x, u, c):
    """Of charge [1] and the two overvoltages [V] under a current [A]; see `move` for the fourth state."""
    current = u[0] + c.offset
    return (
        -current / c.capacity,
        current / c.short_capacity - x[1] / (c.short * c.short_capacity),
        current / c.long_capacity - x[2] / (c.long * c.long_capacity),
    )


def move(x, u, c):
    """All four states one step later."""
    charge, short, long = charged((x[0], x[1], x[2]), u, c)
    return (charge, short, long, u[0] + c.offset)


def open_circuit(s):
    """Voltage [V] of a cell at rest by its charge."""
    return -1.031 * math.exp(-35.0 * s) + 3.685 + s * (0.2156 + s * (-0.1178 + s * 0.3201))


def look(x, c):
    """The terminal voltage."""
    return (open_circuit(x[0]) - x[1] - x[2] - c.series * x[3],)


def model(constants, charge, overvoltage, voltmeter):
    """A cell with noise of some deviation a step of charge [1] and overvoltages [V], and a voltmeter's [V]."""
    return StateSpaceModel(
        transition=move,
        observe=look,
        constants=constants,
        process_noise_cov=[charge**2, overvoltage**2, overvoltage**2, 0.0],
        measurement_noise_cov=[voltmeter**2],
        prior_mean=[0.7, 0.0, 0.0, 0.0],
        prior_cov=[0.01, 1e-4, 1e-4, 1e-4],
        state_low=[0.0, -0.05, -0.05, -0.85],
        state_high=[1.0, 0.05, 0.05, 0.85],
        states=[
            ("charge", "s", ""),
            ("short overvoltage", "v_1", "V"),
            ("long overvoltage", "v_2", "V"),
            ("current", "i", "A"),
        ],
        input_quantities=[("measured current", "i_m", "A")],
        measurements=[("terminal voltage", "z", "V")],
    )


charged = runge_kutta(rates, 3)
AGED = Constants()._replace(capacity=0.875 * Constants().capacity, series=4 / 3 * Constants().series, offset=0.01)
problem = ModelProblem(
    model(AGED, charge=1e-4, overvoltage=2e-4, voltmeter=4e-3),
    model(Constants(), charge=1e-3, overvoltage=1e-3, voltmeter=1e-3),
    inputs={"name": "levels", "low": -0.2, "high": 0.8, "shortest": 10, "longest": 40},
    steps=300,
    dt=DT,
    scale=(0.02, 3e-3, 3e-3, math.inf),
    name="battery",
    about="charge of an aged cell, by the constants of a new one",
)
