"""A stirred tank reactor with a cooling jacket: concentration from the temperature alone.

    C' = q/V (C_f - C) - k C,   T' = q/V (T_f - T) + J k C + h (T_c - T),   k = k_0 exp(-E/T)

What I had: the equations of the textbook, a thermometer taken for twice as bad as it is, and a Q by feel. In the
plant the jacket is fouled, so it takes away a tenth less heat than the equations say, and the feed fluctuates a
little.

Source: D. E. Seborg, T. F. Edgar, D. A. Mellichamp (2004), Process Dynamics and Control, 2nd ed., example 2.5;
its minutes are seconds here.
"""

import math
from typing import NamedTuple

from filters import StateSpaceModel
from thruster_env.core.derivatives import runge_kutta
from tuning.problems.model_problem import ModelProblem

DT = 6.0  # [s]


class Constants(NamedTuple):
    """Numbers of the reactor."""

    substep: float = DT / 2  # of the integration [s]
    exchange: float = 1.0 / 60.0  # feed over volume, q/V [1/s]
    feed: float = 1.0  # concentration of the feed, C_f [mol/L]
    feed_temperature: float = 350.0  # T_f [K]
    rate: float = 7.2e10 / 60.0  # k_0 [1/s]
    activation: float = 8750.0  # E/R [K]
    heating: float = 5e4 / 239.0  # J, by how much a mol/L heats [K L/mol]
    jacket: float = 5e4 / (100.0 * 239.0) / 60.0  # h [1/s]


def rates(x, u, c):
    """(C', T') at a concentration [mol/L], a temperature [K] and a jacket of temperature u [K]."""
    concentration, temperature = x
    reacting = c.rate * math.exp(-c.activation / temperature) * concentration
    return (
        c.exchange * (c.feed - concentration) - reacting,
        c.exchange * (c.feed_temperature - temperature) + c.heating * reacting + c.jacket * (u[0] - temperature),
    )


def look(x, c):
    """The thermometer."""
    return (x[1],)


def model(constants, deviations, thermometer):
    """The reactor with noise of some deviations a step [mol/L, K], and a thermometer of some deviation [K]."""
    return StateSpaceModel(
        transition=move,
        observe=look,
        constants=constants,
        substeps=2,
        process_noise_cov=[one**2 for one in deviations],
        measurement_noise_cov=[thermometer**2],
        prior_mean=[0.87, 325.0],
        prior_cov=[0.05**2, 3.0**2],
        state_low=[0.0, 300.0],
        state_high=[1.0, 400.0],
        states=[("concentration", "C", "mol/L"), ("temperature", "T", "K")],
        input_quantities=[("jacket temperature", "T_c", "K")],
        measurements=[("thermometer", "z", "K")],
    )


move = runge_kutta(rates, 2)
FOULED = Constants()._replace(jacket=0.9 * Constants().jacket)
problem = ModelProblem(
    model(FOULED, deviations=(1e-3, 0.15), thermometer=0.5),
    model(Constants(), deviations=(5e-3, 0.3), thermometer=1.0),
    inputs={"name": "levels", "low": 285.0, "high": 297.0, "shortest": 20, "longest": 60},
    steps=300,
    dt=DT,
    name="reactor",
    about="concentration and temperature of a stirred tank whose jacket is fouled",
)
