"""Propofol in the body, from an index of the depth of anaesthesia: four compartments, and minutes throughout.

    c_1' = u/V_1 - (k_10 + k_12 + k_13) c_1 + k_12 c_2 + k_13 c_3,
    c_2' = k_21 (c_1 - c_2),   c_3' = k_31 (c_1 - c_3),   c_e' = k_e0 (c_1 - c_e)
    index = 100 / (1 + (c_e/3.4)^2)

What I had: the constants of the population, Q by feel (0.05 ug/mL a step everywhere), R of a quiet patient, 3.
This patient clears the drug at 70 % of the average, the effect comes sooner, and the index scatters by 6.
Concentrations are positive.

Sources: M. White, G. N. Kenny (1990), Anaesthesia 45, 204-209 (the Marsh model, V_1 = 0.228 L/kg, 70 kg; k_e0 of
0.26 per minute); Hill's curve of the bispectral index after T. Bouillon et al. (2004), Anesthesiology 100,
1353-1372.
"""

from typing import NamedTuple

from filters import StateSpaceModel
from thruster_env.core.derivatives import runge_kutta
from tuning.problems.model_problem import ModelProblem

DT = 0.25  # [min]


class Constants(NamedTuple):
    """Numbers of a patient; rates in 1/min."""

    substep: float = DT
    volume: float = 0.228 * 70.0  # V_1 [L]
    k10: float = 0.119
    k12: float = 0.112
    k13: float = 0.0419
    k21: float = 0.055
    k31: float = 0.0033
    ke0: float = 0.26
    half: float = 3.4  # c_e at which the index is 50 [ug/mL]


def rates(x, u, c):
    """Of the four concentrations [ug/mL] under an infusion u [mg/min]."""
    blood, fast, slow, effect = x
    return (
        u[0] / c.volume - (c.k10 + c.k12 + c.k13) * blood + c.k12 * fast + c.k13 * slow,
        c.k21 * (blood - fast),
        c.k31 * (blood - slow),
        c.ke0 * (blood - effect),
    )


def look(x, c):
    """The index: 100 awake, 40 to 60 under anaesthesia."""
    ratio = max(x[3], 0.0) / c.half
    return (100.0 / (1.0 + ratio * ratio),)


def model(constants, deviations, index):
    """A patient with noise of some deviations a step [ug/mL], and an index of some deviation."""
    return StateSpaceModel(
        transition=move,
        observe=look,
        constants=constants,
        process_noise_cov=[one**2 for one in deviations],
        measurement_noise_cov=[index**2],
        prior_mean=[3.0, 2.0, 0.5, 2.5],
        prior_cov=[0.25, 0.1, 0.01, 0.25],
        state_low=[0.0] * 4,
        state_high=[8.0, 6.0, 2.0, 8.0],
        states=[
            ("in blood", "c_1", "ug/mL"),
            ("in muscles", "c_2", "ug/mL"),
            ("in fat", "c_3", "ug/mL"),
            ("at the effect", "c_e", "ug/mL"),
        ],
        input_quantities=[("infusion", "u", "mg/min")],
        measurements=["index"],
    )


move = runge_kutta(rates, 4)
PATIENT = Constants()._replace(k10=0.7 * Constants().k10, ke0=0.4)
problem = ModelProblem(
    model(PATIENT, deviations=(0.03, 0.005, 0.002, 0.01), index=6.0),
    model(Constants(), deviations=(0.05,) * 4, index=3.0),
    inputs={"name": "levels", "low": 2.0, "high": 14.0, "shortest": 20, "longest": 60},
    steps=240,
    dt=DT,
    scale=(0.1,) * 4,  # ug/mL, what a dose is chosen by
    name="compartments",
    about="propofol in a patient who is not the average one; time in minutes",
)
